"""The ``rod`` backend: our own whisker solver, one source for processors and NVIDIA GPUs."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import pick_device, warp
from brainbench.core.progress import Progress as NamedProgress
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.error_estimates import MORE, MOST
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.protocol import PassiveSweeps, SweepBatch, WhiskerEngine
from brainbench.stimuli.engines.rod.launch import (
    LaunchResult,
    Try,
    WhiskerSolver,
    load_kernels,
    real_type,
    run_with_retries,
    tries_ahead,
)
from brainbench.stimuli.engines.rod.packing import PackedSurface, Track, capacity_for
from brainbench.stimuli.engines.rod.tasks import JobTask, PackedTasks, make_task
from brainbench.stimuli.engines.stepping import silent_trace
from brainbench.stimuli.engines.trust import without_escape
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.objects.solid import Solid

SLICE = 65_536
"""Whiskers of one launch on a GPU: bounds the memory of a run."""


@dataclass(frozen=True)
class RodEngine(WhiskerEngine):
    """Runs whisker jobs in our own solver."""

    device: str = "auto"
    """``cpu`` or ``cuda``; ``auto``: ``cpu``, or ``cuda`` where Warp cannot compile for processors."""
    retry: int = 5

    name = "rod"
    package = "warp-lang"
    devices = ("cpu", "cuda")
    solvers = ("dynamic", "quasistatic")
    twists = True
    yields = True
    surfaces = True
    batches = True

    def prepare(self, lengths: Iterable[float], fidelity: Fidelity, *, progress: NamedProgress | None = None) -> None:
        """Load the kernels for these arc lengths [m]; all that this machine has not compiled yet at once."""
        device = pick_device(self.device)
        if device.is_cuda:  # which kernels are needed depends on what there is to touch
            return
        counts = {fidelity.link_count(length) for length in lengths}
        if self.errors:  # whiskers in contact are simulated with more links too
            counts |= {min(math.ceil(MORE * count), MOST) for count in counts}
        sizes = sorted(set(map(capacity_for, counts)))

        def load(capacity: int) -> None:
            what = f"compiling the whisker solver for {capacity} links (once; it is kept)"
            tell = progress or (lambda done, total, what: None)
            real = real_type(fidelity)
            hinges = 2 + (fidelity.twist is not False)
            load_kernels(
                device, real, capacity, hinges=hinges, compiling=lambda begins: tell(0 if begins else 1, 1, what)
            )

        with ThreadPoolExecutor(max_workers=max(1, len(sizes))) as pool:
            list(pool.map(load, sizes))

    def threads(self, workers: int | None) -> int:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.threads`; one on a GPU."""
        return 1 if pick_device(self.device).is_cuda else super().threads(workers)

    def groups(self, jobs: Sequence[Job], fidelity: Fidelity) -> list[list[int]]:
        """Return jobs with the same readings and capacity together, on a processor one by one."""
        groups: dict[Any, list[int]] = {}
        for index, job in enumerate(jobs):
            links = fidelity.link_count(job.whisker.arc_length)
            key = (capacity_for(links), job.times.tobytes(), job.start, tuple(job.gravity))
            groups.setdefault(key, []).append(index)
        size = SLICE if pick_device(self.device).is_cuda else 1
        return [some[i : i + size] for some in groups.values() for i in range(0, len(some), size)]

    def simulate_group(self, jobs: Sequence[Job], fidelity: Fidelity, *, record_shape: bool) -> list[Trace]:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.simulate_group`: a launch for each kind."""
        traces: dict[int, Trace] = {}
        tasks: dict[Any, dict[int, JobTask]] = {}
        bodies: dict[Any, tuple[NDArray, Track]] = {}
        seconds = np.zeros(len(jobs))
        for index, job in enumerate(jobs):
            started = time.thread_time()
            task = make_task(job, fidelity, bodies)
            seconds[index] = time.thread_time() - started
            if task is None:
                traces[index] = silent_trace(job, fidelity, record_shape, seconds[index])
            else:
                tasks.setdefault(task.kind, {})[index] = task
        for _, alike in sorted(tasks.items()):
            spent = seconds[list(alike)]
            traces |= _simulate(alike, spent, self.retry, fidelity, pick_device(self.device), record_shape)
        return [traces[index] for index in range(len(jobs))]

    def prepare_sweeps(self, scenes: PassiveSweeps, fidelity: Fidelity) -> None:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.prepare_sweeps`."""
        from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

        device = pick_device(self.device)
        if not device.is_cuda:  # its kernel takes a second
            return
        if device.is_mempool_supported:
            # Shards come and go; what went back to the system at every wait would have to be asked for anew.
            warp().set_mempool_release_threshold(device, 0.8)
        SweepLauncher(scenes, fidelity, self.device).free()

    def pack(self, solid: Solid) -> tuple[float, PackedSurface]:
        """See :func:`brainbench.stimuli.engines.rod.sweeps.pack_object`."""
        from brainbench.stimuli.engines.rod.sweeps import pack_object

        return pack_object(solid)

    def run_sweeps(
        self,
        scenes: PassiveSweeps,
        indices: Sequence[int],
        fidelity: Fidelity,
        *,
        workers: int | None = None,
        packed: Mapping[str, Any] | None = None,
        estimated: NDArray[np.bool_] | None = None,
    ) -> SweepBatch:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.run_sweeps`."""
        from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

        launcher = SweepLauncher(scenes, fidelity, self.device, packed=packed)
        batch = launcher.run(indices, self.retry, workers or 1, estimated)
        launcher.free()
        return batch


def _simulate(
    tasks: dict[int, JobTask], seconds: NDArray, retry: int, fidelity: Fidelity, device: Any, record_shape: bool
) -> dict[int, Trace]:
    """Run tasks of one kind in one launch; ``seconds`` [task] is the processor time of each so far."""
    given = list(tasks.values())

    def launch(tries: Sequence[Try]) -> list[LaunchResult]:
        parts = [np.arange(len(given)) if which is None else np.flatnonzero(which[:, 0]) for which, _ in tries]
        rows, counts = np.concatenate(parts), [len(part) for part in parts]
        finer = np.repeat([divisor for _, divisor in tries], counts)
        started = time.thread_time()
        packed = PackedTasks.of([given[row] for row in rows], finer)
        # Compiling is done once; it is no cost of a whisker.
        paused = time.thread_time()
        solver = WhiskerSolver(packed.chains, fidelity, device, packed.shapes.needs, twists=given[0].twists)
        started += time.thread_time() - paused
        result = packed.launch(solver, record_shape=record_shape)
        np.add.at(seconds, rows, (time.thread_time() - started) / len(rows))
        return result.split(counts)

    result = run_with_retries(launch, retry, ahead=lambda: tries_ahead(device))
    traces = (trace_of(result, row, task.job, fidelity, seconds[row]) for row, task in enumerate(given))
    return dict(zip(tasks, traces, strict=True))


def trace_of(result: LaunchResult, row: int, job: Job, fidelity: Fidelity, seconds: float) -> Trace:
    """Return the trace of a job, NaN from where it cannot be trusted."""
    # Readings at the very moment of failure are not trusted either.
    good = job.times < result.verdict.until[row, 0] - 1e-9
    arc = result.contact[row, :, 0].astype(float)
    touching = (arc >= 0) & good
    reason = without_escape(str(result.verdict.reasons[row, 0]), job, float(result.verdict.until[row, 0]))
    shape, felt = result.points, result.contact_wrench
    position, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(job.times))
    displacement = None
    if result.displacement is not None:
        displacement = np.where(good[:, None], result.displacement[row, :, 0].astype(float), np.nan)
        position = position + np.einsum("nij,nj->ni", base_rotation(euler), displacement[:, :3])
    base = position[:, None]
    nodes = fidelity.link_count(job.whisker.arc_length) + 1
    return Trace(
        wrench=np.where(good[:, None], result.wrench[row, :, 0].astype(float), np.nan),
        contact=touching,
        contact_arc=np.where(touching, arc, np.nan),
        penetration=float(result.depth[row, 0]),
        status="unstable" if reason else "ok",
        reason=reason,
        steps=int(result.steps[row, 0]),
        unsolved=int(result.counts["unsolved"][row, 0]),
        displacement=displacement,
        seconds=seconds,
        link_positions=None if shape is None else np.where(good[:, None, None], base + shape[row, :, :nodes], np.nan),
        contact_wrench=None if felt is None else np.where(good[:, None], felt[row], np.nan),
    )
