"""Physics engines for whiskers: jobs and a fidelity go in, traces of forces come out (:mod:`.protocol`).

One of the engines ``rod``, ``mujoco`` and, if its folder is there, ``bullet`` simulates them with what each can touch
(:mod:`.reach`); one rule says which results are reliable (:mod:`.trust`).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from brainbench.core.errors import UsageError, listing, unknown_name
from brainbench.core.plugins import load_optional, optional_parts

if TYPE_CHECKING:
    from brainbench.stimuli.engines.protocol import WhiskerEngine

PHYSICS_VERSION = 12
"""Version of the physics, part of the name under which simulations are kept in the cache. To be raised whenever a
change of the code changes what a simulation gives; tests/stimuli/engines/test_golden_wrenches.py says when."""

_ENGINES = {
    "mujoco": ("brainbench.stimuli.engines.mujoco", "MujocoWhiskerEngine"),
    "rod": ("brainbench.stimuli.engines.rod.engine", "RodEngine"),
}
"""Name of each engine, and the module and class that it is; optional engines are entry points of :data:`_GROUP`."""
_GROUP = "brainbench.engines"


def list_engines() -> tuple[str, ...]:
    """Return the names that :func:`get_engine` knows."""
    return tuple(sorted({*_ENGINES, *(name for name, part in optional_parts(_GROUP).items() if part.present)}))


def get_engine(
    name: str, *, device: str | None = None, retry: int | None = None, errors: bool | None = None
) -> WhiskerEngine:
    """Return the engine called ``name``.

    Args:
        name: one of :func:`list_engines`.
        device: ``cpu`` or ``cuda``; the engine's own choice when None.
        retry, errors: as :attr:`WhiskerEngine.retry` and :attr:`WhiskerEngine.errors`; the engine's own choice when
            None.
    """
    if name in _ENGINES:
        module, symbol = _ENGINES[name]
        engine: type[WhiskerEngine] = getattr(import_module(module), symbol)
    elif (optional := load_optional(_GROUP, name, "backend")) is not None:
        engine = optional
    else:
        raise unknown_name("backend", name, list_engines())
    if device is not None and device not in engine.devices:
        raise UsageError(f"The backend {name!r} does not run on {device!r}; it runs on {listing(engine.devices)}.")
    options = {"device": device, "retry": retry, "errors": errors}
    return engine(**{key: value for key, value in options.items() if value is not None})
