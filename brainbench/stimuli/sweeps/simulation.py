"""The one seam between data generation and physics: indices of sweeps in, their wrenches out."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import UsageError, listing
from brainbench.stimuli.engines import DEFAULT_BACKEND, get_backend
from brainbench.stimuli.explain import Explanation
from brainbench.stimuli.simulation import simulate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.stimuli.engines.fidelity import Fidelity
    from brainbench.stimuli.engines.protocol import Backend, Job, Progress, Trace
    from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes

FAST_PATHS: dict[str, tuple[str, str]] = {"rod": ("brainbench.stimuli.engines.rod.sweeps", "simulate_sweeps")}
"""Backend → module and function that simulates many sweeps at once, without a scene per sweep. The function takes the
arguments of :func:`simulate_sweeps` but the backend, and must give the same whatever the batch and its order."""

_TOGETHER = 16
"""Sweeps whose scenes exist at the same time: bounds the memory of a batch."""


@dataclass(frozen=True, eq=False)
class SweepBatch:
    """What some sweeps gave, in the order in which they were asked for.

    Raises:
        UsageError: the arrays do not fit together.
    """

    wrench: NDArray[np.float32]
    """[sweep, frame, whisker, 6] N and N·m, in the axes that the frames of the grid name; NaN where unstable."""
    contact: NDArray[np.float32]
    """[sweep, whisker] fraction of the frames in which the whisker touched the object."""
    unstable: NDArray[np.bool_]
    """[sweep, whisker] whether the simulation failed; the numbers must not be used."""
    reasons: tuple[str, ...]
    """[sweep] why, in words; empty for a sweep that is ok."""
    steps: int
    """Time steps of single whiskers that were computed."""
    steps_in_full: int
    """Time steps that simulating every whisker of every sweep from start to end takes."""
    retried: int = 0
    """Sweeps with a whisker that was simulated again with finer steps, because it could not be trusted at first."""

    def __post_init__(self) -> None:
        count, _, whiskers, channels = np.shape(self.wrench)
        if channels != 6 or self.contact.shape != (count, whiskers) or self.unstable.shape != (count, whiskers):
            raise UsageError(
                f"A batch of sweeps has wrenches [n, frame, whisker, 6] and [n, whisker] for contact and unstable; "
                f"received {self.wrench.shape}, {self.contact.shape} and {self.unstable.shape}."
            )
        if [bool(reason) for reason in self.reasons] != np.asarray(self.unstable.any(axis=1)).tolist():
            raise UsageError("Every sweep of a batch has a reason, which is empty exactly when no whisker is unstable.")


def simulate_sweeps(
    scenes: SweepScenes,
    indices: Sequence[int],
    *,
    fidelity: Fidelity,
    backend: str = DEFAULT_BACKEND,
    device: str = "cpu",
    workers: int | None = None,
    retry: int = 1,
) -> SweepBatch:
    """Simulate some sweeps.

    Args:
        scenes: a grid of sweeps over some objects.
        indices: which of its scenes; neighbours share their object, so order by object is fastest.
        fidelity: how finely.
        backend: name of the physics engine.
        device: ``cpu`` or ``cuda``.
        workers: threads on the CPU; all usable processors when None.
        retry: divides the time step for whiskers that cannot be trusted, which are then simulated again, and twice as
            much for those that cannot be trusted even then; 1 leaves them. Only ``rod`` does this.

    Raises:
        UsageError: the backend is unknown or does not run on the device.
    """
    engine = check_device(backend, device)
    if backend in FAST_PATHS and scenes.grid.mover == "object":
        module, symbol = FAST_PATHS[backend]
        run = getattr(import_module(module), symbol)
        return run(scenes, indices, fidelity=fidelity, device=device, workers=workers, retry=retry)
    if hasattr(engine, "retry"):
        engine = replace(engine, retry=retry)  # type: ignore[type-var]
    parts = [
        _one_by_one(scenes, indices[first : first + _TOGETHER], fidelity, _Threads(engine, workers))
        for first in range(0, len(indices), _TOGETHER)
    ]
    return join_batches(parts)


def check_device(name: str, device: str) -> Backend:
    """Return the backend called ``name`` on a device.

    Raises:
        UsageError: the backend is unknown or does not run on the device.
    """
    engine = get_backend(name)
    devices = getattr(engine, "devices", ("cpu",))
    if device not in devices:
        raise UsageError(f"The backend {name!r} does not run on {device!r}; it runs on {listing(devices)}.")
    return type(engine)(device=device) if len(devices) > 1 else engine  # type: ignore[call-arg]


def join_batches(parts: Sequence[SweepBatch]) -> SweepBatch:
    """Return several batches as one."""
    if len(parts) == 1:
        return parts[0]
    return SweepBatch(
        wrench=np.concatenate([part.wrench for part in parts]),
        contact=np.concatenate([part.contact for part in parts]),
        unstable=np.concatenate([part.unstable for part in parts]),
        reasons=tuple(reason for part in parts for reason in part.reasons),
        steps=sum(part.steps for part in parts),
        steps_in_full=sum(part.steps_in_full for part in parts),
        retried=sum(part.retried for part in parts),
    )


def _one_by_one(scenes: SweepScenes, indices: Sequence[int], fidelity: Fidelity, engine: Backend) -> SweepBatch:
    """Simulate sweeps as any other scenes."""
    with _unlogged():
        dataset = simulate([scenes[index] for index in indices], fidelity=fidelity, backend=engine, cache=False)
    unstable = dataset["status"].values != "ok"
    told = Explanation.of(dataset)
    names = [str(name) for name in dataset["whisker"].values]
    reasons = []
    for bad, words in zip(unstable, dataset["reason"].values, strict=True):
        first = int(np.argmax(bad))
        more = f" (and {bad.sum() - 1} more whiskers)" if bad.sum() > 1 else ""
        reasons.append(f"{names[first]}: {words[first]}{more}" if bad.any() else "")
    return SweepBatch(
        wrench=dataset["wrench"].values,
        contact=dataset["contact"].values.mean(axis=1).astype(np.float32),
        unstable=unstable,
        reasons=tuple(reasons),
        steps=told.steps,
        steps_in_full=told.steps_in_full,
    )


class _OtherThreads(logging.Filter):
    """Lets through what other threads say than the one that made it."""

    def __init__(self) -> None:
        super().__init__()
        self._thread = threading.get_ident()

    def filter(self, record: logging.LogRecord) -> bool:
        return record.thread != self._thread


@contextlib.contextmanager
def _unlogged() -> Iterator[None]:
    """Keep quiet about each unstable whisker: among millions of sweeps they are marked and counted."""
    logger, quiet = logging.getLogger("brainbench.stimuli.simulation"), _OtherThreads()
    logger.addFilter(quiet)
    try:
        yield
    finally:
        logger.removeFilter(quiet)


@dataclass(frozen=True, eq=False)
class _Threads:
    """A backend with a fixed number of threads."""

    engine: Backend
    workers: int | None

    @property
    def name(self) -> str:
        return self.engine.name

    @property
    def surfaces(self) -> bool:
        return getattr(self.engine, "surfaces", False)

    def run(
        self,
        jobs: Sequence[Job],
        fidelity: Fidelity,
        *,
        progress: Progress | None = None,
        workers: int | None = None,
        **options: Any,
    ) -> list[Trace]:
        return self.engine.run(jobs, fidelity, progress=progress, workers=workers or self.workers, **options)
