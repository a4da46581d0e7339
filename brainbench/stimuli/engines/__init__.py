"""Physics engines for whiskers, found by name with :func:`get_backend`."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from brainbench.core.errors import unknown_name

if TYPE_CHECKING:
    from brainbench.stimuli.engines.protocol import Backend

DEFAULT_BACKEND = "rod"
"""Engine of whatever does not ask for one; it needs no GPU."""

_BACKENDS = {
    "bullet": ("brainbench.stimuli.engines.bullet.engine", "BulletBackend"),
    "mujoco": ("brainbench.stimuli.engines.mujoco.engine", "MujocoBackend"),
    "rod": ("brainbench.stimuli.engines.rod", "RodBackend"),
}


def list_backends() -> tuple[str, ...]:
    """Names that :func:`get_backend` knows."""
    return tuple(sorted(_BACKENDS))


def get_backend(name: str) -> Backend:
    """Return the backend called ``name``.

    Raises:
        UsageError: there is no such backend.
    """
    if name not in _BACKENDS:
        raise unknown_name("backend", name, list_backends())
    module, symbol = _BACKENDS[name]
    return getattr(import_module(module), symbol)()
