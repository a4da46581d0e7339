"""The ``rod`` backend: our own whisker solver, one source for processors and NVIDIA GPUs."""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.devices import pick_device, to_struct, usable_processors, warp
from brainbench.stimuli.engines.job_pool import run_groups
from brainbench.stimuli.engines.protocol import Trace, WhiskerEngine, base_rotation
from brainbench.stimuli.engines.reach import Reach, reachable
from brainbench.stimuli.engines.rod.compilation import load_kernels
from brainbench.stimuli.engines.rod.limits import (
    BENT,
    CROWDED,
    DOUBTFUL,
    FINEST,
    LIGHT,
    LOST,
    OK,
    WIDEST,
    finer_steps,
)
from brainbench.stimuli.engines.rod.packing import KNOT, Chains, Shapes, Tracks, capacity_for, follicle_knots
from brainbench.stimuli.engines.rod.scheduling import make_problems
from brainbench.stimuli.engines.trust import MILLI, check_jobs, step_travel, strongest_force, too_strong
from brainbench.stimuli.whiskers.chain import build_chain

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from brainbench.core.progress import Progress as NamedProgress
    from brainbench.stimuli.engines.fidelity import Fidelity
    from brainbench.stimuli.engines.protocol import Job, Progress
    from brainbench.stimuli.engines.sweep_batch import SweepBatch
    from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes
    from brainbench.stimuli.whiskers.chain import Chain

SLICE = 65_536
"""Whiskers of one launch on a GPU: bounds the memory of a run."""


@dataclass(frozen=True)
class RodEngine(WhiskerEngine):
    """Runs whisker jobs in our own solver.

    Raises:
        UsageError: the device is unknown, or ``cuda`` is asked for where there is none.
        MissingDependencyError: warp-lang is not installed.
    """

    device: str = "auto"
    """``cpu`` or ``cuda``; ``auto``: ``cpu``, or ``cuda`` where Warp cannot compile for processors."""
    retry: int = 5

    name = "rod"
    package = "warp-lang"
    devices = ("cpu", "cuda")
    solvers = ("dynamic", "quasistatic")
    surfaces = True
    retries = True
    batches = True

    def prepare(self, lengths: Iterable[float], fidelity: Fidelity, *, progress: NamedProgress | None = None) -> None:
        """Load the kernels for whiskers of these arc lengths [m]; all that this machine has not compiled yet at once.

        :meth:`run` does so itself. Called in a thread some time before, the compiler works beside everything else.

        Args:
            lengths: arc lengths of the whiskers [m].
            fidelity: as for :meth:`run`.
            progress: called as ``progress(done, total, what)`` when something must be compiled.
        """
        device = pick_device(self.device)
        if device.is_cuda:  # which kernels are needed depends on what there is to touch
            return
        sizes = sorted({capacity_for(fidelity.link_count(length)) for length in lengths})

        def load(capacity: int) -> None:
            def tell(begins: bool) -> None:
                if progress is not None:
                    what = f"compiling the whisker solver for {capacity} links (once; it is kept)"
                    progress(0 if begins else 1, 1, what)

            load_kernels(device, _real(fidelity), capacity, compiling=tell)

        with ThreadPoolExecutor(max_workers=max(1, len(sizes))) as pool:
            list(pool.map(load, sizes))

    def run(
        self,
        jobs: Sequence[Job],
        fidelity: Fidelity,
        *,
        progress: Progress | None = None,
        workers: int | None = None,
        record_shape: bool = False,
    ) -> list[Trace]:
        """Simulate every job; see :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.run`.

        On a GPU ``workers`` means nothing.
        """
        check_jobs(self, jobs, fidelity, workers)
        device = pick_device(self.device)
        groups: dict[Any, list[int]] = {}
        for index, job in enumerate(jobs):
            links = fidelity.link_count(job.whisker.arc_length)
            key = (capacity_for(links), job.times.tobytes(), job.start, tuple(job.gravity))
            groups.setdefault(key, []).append(index)
        size = SLICE if device.is_cuda else 1

        def run(group: Sequence[int]) -> dict[int, Trace]:
            capacity = capacity_for(fidelity.link_count(jobs[group[0]].whisker.arc_length))
            return _trusted({i: jobs[i] for i in group}, self.retry, fidelity, device, capacity, record_shape)

        slices = [some[i : i + size] for some in groups.values() for i in range(0, len(some), size)]
        threads = 1 if device.is_cuda else workers or usable_processors()
        return run_groups(slices, run, threads=threads, progress=progress)

    def run_sweeps(
        self, scenes: SweepScenes, indices: Sequence[int], fidelity: Fidelity, *, workers: int | None = None
    ) -> SweepBatch:
        """Simulate sweeps; see :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.run_sweeps`."""
        from brainbench.stimuli.engines.rod.sweeps import simulate_sweeps

        return simulate_sweeps(
            scenes, indices, fidelity=fidelity, device=self.device, workers=workers, retry=self.retry
        )


def _real(fidelity: Fidelity) -> type:
    """Warp's type of the numbers that a simulation calculates with."""
    return warp().float32 if fidelity.precision == "single" else warp().float64


_NUMBERS = ("depth", "failed", "miss", "load")
_COUNTS = ("status", "steps", "touching", "crowded", "unsolved")
"""What a kernel leaves of each lane besides its readings."""


@dataclass
class _Batch:
    """Whiskers that share their readings, gathered for one launch."""

    device: Any
    fidelity: Fidelity
    capacity: int
    start: float
    stop: float
    finer: int = 1
    """Divides the time steps."""
    tracks: Tracks = field(default_factory=Tracks)
    chains: list[Chain] = field(default_factory=list)
    lanes: list[tuple[int, int, int, float]] = field(default_factory=list)
    """(whisker, scene, base, step in ms) of each lane."""
    loads: list[tuple[int, float, NDArray[np.float64], float]] = field(default_factory=list)
    load_first: list[int] = field(default_factory=lambda: [0])
    _whiskers: dict[Any, int] = field(default_factory=dict)
    _scenes: dict[Any, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.shapes = Shapes()

    def add(self, job: Job, reach: Reach) -> Chain:
        """Append one job as a lane; return its chain."""
        if job.whisker not in self._whiskers:
            self._whiskers[job.whisker] = len(self.chains)
            self.chains.append(build_chain(job.whisker, self.fidelity.link_count(job.whisker.arc_length)))
        which = self._whiskers[job.whisker]
        chain = self.chains[which]
        seen = tuple(
            (id(item.motion), item.friction, *map(id, (item.surface, *item.parts))) for item in reach.obstacles
        )
        if seen not in self._scenes:
            self._scenes[seen] = self.shapes.add_scene(reach.obstacles, self.tracks, self.start, self.stop)
        knots, spacing = follicle_knots(job.follicle, self.start, self.stop)
        base = self.tracks.add(knots, self.start * MILLI, spacing)
        step = self.fidelity.step(float(chain.frequencies()[0]) / (2 * np.pi)) * MILLI
        self.lanes.append((which, self._scenes[seen], base, step / self.finer))
        for load in job.loads:
            link = min(max(int(np.searchsorted(chain.nodes, load.arc)) - 1, 0), chain.links - 1)
            share = (load.arc - chain.nodes[link]) / (chain.nodes[link + 1] - chain.nodes[link])
            self.loads.append((link, float(share), np.multiply(load.force, MILLI), load.stop * MILLI))
        self.load_first.append(len(self.loads))
        return chain


def _trusted(
    jobs: dict[int, Job], retry: int, fidelity: Fidelity, device: Any, capacity: int, record_shape: bool
) -> dict[int, Trace]:
    """Run jobs that share their readings; those that finer steps may mend once more, and once more."""
    found = _simulate(jobs, fidelity, device, capacity, record_shape)
    for finer in finer_steps(retry):
        left = {index: jobs[index] for index, (_, mendable) in found.items() if mendable}
        if not left:
            break
        for index, (trace, mendable) in _simulate(left, fidelity, device, capacity, record_shape, finer).items():
            before = found[index][0]
            cost = {"steps": before.steps + trace.steps, "seconds": before.seconds + trace.seconds}
            found[index] = replace(trace, **cost), mendable
    return {index: trace for index, (trace, _) in found.items()}


def _simulate(
    jobs: dict[int, Job], fidelity: Fidelity, device: Any, capacity: int, record_shape: bool, finer: int = 1
) -> dict[int, tuple[Trace, bool]]:
    """Run jobs that share their readings in one launch; return their traces, and whether finer steps may mend them."""
    started = time.thread_time()
    wp = warp()
    first = next(iter(jobs.values()))
    batch = _Batch(device, fidelity, capacity, first.start, float(first.times[-1]), finer)
    found: dict[int, tuple[Trace, bool]] = {}
    lanes: list[tuple[int, Job, Chain, tuple[float, str]]] = []
    seen = np.linspace(first.start, first.times[-1], max(2, math.ceil((first.times[-1] - first.start) / KNOT)))
    for index, job in jobs.items():
        position, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(seen))
        reach = reachable(job.whisker, position, job.obstacles, seen, surfaces=True)
        moves = np.ptp(position, axis=0).any() or np.ptp(euler, axis=0).any()
        if reach or moves or job.loads or np.any(job.gravity):
            lanes.append((index, job, batch.add(job, reach), _too_fast(job, reach, position, euler, seen, fidelity)))
        else:
            found[index] = _silent(job, fidelity, record_shape, started), False
    if not lanes:
        return found
    real = _real(fidelity)
    # Compiling is once; it is no cost of a whisker.
    paused = time.thread_time()
    kernels = load_kernels(device, real, capacity, batch.shapes.needs)
    started += time.thread_time() - paused
    readings = first.times * MILLI
    count, frames = len(lanes), len(readings)
    out = _results(kernels, real, device, (count, frames, capacity), record_shape)
    options = kernels.structs.StepOptions()
    options.start = first.start * MILLI
    options.quasistatic = int(fidelity.solver == "quasistatic")
    weight = LIGHT if options.quasistatic else 1.0
    options.gravity = kernels.structs.vec3(*np.divide(first.gravity, MILLI * weight).tolist())
    options.axes = kernels.structs.mat33(*np.eye(3).ravel().tolist())
    options.shape = int(record_shape)
    wp.launch(
        kernels.run,
        dim=count,
        inputs=[
            *batch_structs(batch, kernels, device),
            options,
            wp.array(readings, dtype=real, device=device),
            out,
            make_problems(kernels, capacity, count, device),
            kernels.structs.PausedWhiskers(),
        ],
        device=device,
    )
    spent = time.thread_time() - started
    results = {name: getattr(out, name).numpy() for name in (*_NUMBERS, *_COUNTS, "wrench", "contact")}
    points, pressed = (out.points.numpy(), out.contact_wrench.numpy()) if record_shape else (None, None)
    for lane, (index, job, chain, missed) in enumerate(lanes):
        shape = None if points is None else points[:, : chain.links + 1, lane].astype(float) / MILLI
        trace, mendable = _trace(results, lane, job, shape, missed, spent / count)
        if pressed is not None:
            sound = np.isfinite(trace.wrench).all(axis=1, keepdims=True)
            felt = pressed[:, :, lane].reshape(frames, 6).astype(float)
            trace = replace(trace, contact_wrench=np.where(sound, felt, np.nan))
        found[index] = trace, mendable
    return found


def _results(kernels: Any, real: Any, device: Any, sizes: tuple[int, int, int], record_shape: bool) -> Any:
    """Room for the results of (lanes, readings, links)."""
    wp = warp()
    count, frames, capacity = sizes
    out = kernels.structs.ResultArrays()
    out.wrench = wp.zeros((count, frames, 1, 6), dtype=real, device=device)
    out.contact = wp.full((count, frames, 1), -1.0, dtype=real, device=device)
    points, pressed = ((frames, capacity + 1, count), (frames, 2, count)) if record_shape else ((1, 1, 1),) * 2
    out.points = wp.zeros(points, dtype=kernels.structs.vec3, device=device)
    out.contact_wrench = wp.zeros(pressed, dtype=kernels.structs.vec3, device=device)
    for names, kind in ((_NUMBERS, real), (_COUNTS, wp.int32)):
        for name in names:
            setattr(out, name, wp.zeros(count, dtype=kind, device=device))
    return out


def batch_structs(batch: _Batch, kernels: Any, device: Any) -> list[Any]:
    """The chains, tracks, shapes and lanes of a batch on the device."""
    lanes = np.array([lane[:3] for lane in batch.lanes], dtype=np.int32).reshape(-1, 3)
    loads = {
        "load_first": np.array(batch.load_first, dtype=np.int32),
        "load_link": np.array([load[0] for load in batch.loads], dtype=np.int32),
        "load_share": np.array([load[1] for load in batch.loads]),
        "load_force": np.array([load[2] for load in batch.loads]).reshape(-1, 3),
        "load_stop": np.minimum([load[3] for load in batch.loads], 1e30),
    }
    return [
        to_struct(
            kernels.structs.ChainArrays,
            Chains(batch.capacity, batch.chains, batch.fidelity.solver == "quasistatic").arrays(),
            device,
        ),
        to_struct(kernels.structs.MotionArrays, batch.tracks.arrays(), device),
        to_struct(kernels.structs.ShapeArrays, batch.shapes.arrays(), device),
        to_struct(
            kernels.structs.JobArrays,
            {
                "whisker": lanes[:, 0],
                "scene": lanes[:, 1],
                "base": lanes[:, 2],
                "step": np.array([lane[3] for lane in batch.lanes]),
                "row": np.arange(len(lanes), dtype=np.int32),
                "column": np.zeros(len(lanes), dtype=np.int32),
                **loads,
            },
            device,
        ),
    ]


def _silent(job: Job, fidelity: Fidelity, record_shape: bool, started: float) -> Trace:
    count = len(job.times)
    shape = None
    if record_shape:
        chain = build_chain(job.whisker, fidelity.link_count(job.whisker.arc_length))
        position, euler = job.follicle.pose(job.times[:1])
        rest = np.pad(chain.points, ((0, 0), (0, 1))) @ base_rotation(euler)[0].T + position[0]
        shape = np.repeat(rest[None], count, axis=0)
    return Trace(
        wrench=np.zeros((count, 6)),
        contact=np.zeros(count, dtype=bool),
        contact_arc=np.full(count, np.nan),
        seconds=time.thread_time() - started,
        link_positions=shape,
        contact_wrench=np.zeros((count, 6)) if record_shape else None,
    )


def _too_fast(
    job: Job, reach: Reach, position: NDArray, euler: NDArray, times: NDArray, fidelity: Fidelity
) -> tuple[float, str]:
    """When (s) an object first moves further against the whisker than the finest step looks, and that in words."""
    chain = build_chain(job.whisker, 8)
    finest = fidelity.step(float(chain.frequencies()[0]) / (2 * np.pi)) / FINEST
    spans = np.diff(times)
    share = np.divide(finest, spans, out=np.zeros_like(spans), where=spans > 0)
    for obstacle in reach.obstacles:
        travel = step_travel(job.whisker, position, euler, obstacle, times) * share
        if (travel > WIDEST / MILLI).any():
            first = int(np.argmax(travel > WIDEST / MILLI))
            return float(times[first]), (
                f"an object moves by {travel[first] * MILLI:.3g} mm against the whisker in the shortest step at "
                f"{times[first]:.6g} s, further than contacts are looked for; choose a smaller time step"
            )
    return np.inf, ""


def _trace(
    results: dict[str, NDArray],
    lane: int,
    job: Job,
    shape: NDArray | None,
    missed: tuple[float, str],
    seconds: float,
) -> tuple[Trace, bool]:
    """Return the trace of a lane, and whether what is wrong with it is a matter of too long a step."""
    steps, crowded = (int(results[name][lane]) for name in ("steps", "crowded"))
    wrench = results["wrench"][lane, :, 0].astype(float)
    arc = results["contact"][lane, :, 0].astype(float)
    end, reason = _end(int(results["status"][lane]), float(results["failed"][lane]) / MILLI)
    strength = np.linalg.norm(wrench[:, :3], axis=1)
    wild = ~(strength <= strongest_force(job.whisker))
    if wild.any() and job.times[np.argmax(wild)] < end:
        first = int(np.argmax(wild))
        end, reason = (
            float(job.times[first]),
            f"at {job.times[first]:.6g} s " + too_strong(strength[first], job.whisker),
        )
    mendable = bool(reason) and int(results["status"][lane]) == BENT
    if missed[0] < end:
        end, reason, mendable = *missed, False
    doubt = float(np.sqrt(results["miss"][lane] / max(float(results["load"][lane]), 1e-30)))
    if not reason and not doubt <= DOUBTFUL:
        end = -np.inf
        reason, mendable = f"contact forces missed by {doubt:.0%} (root mean square); choose a smaller time step", True
    if not reason and crowded > CROWDED * steps:
        end, mendable = -np.inf, True
        reason = f"more contacts than can be solved together in {crowded} of {steps} steps"
    good = job.times < end - 1e-9
    touching = (arc >= 0) & good
    trace = Trace(
        wrench=np.where(good[:, None], wrench, np.nan),
        contact=touching,
        contact_arc=np.where(touching, arc, np.nan),
        penetration=float(results["depth"][lane]) / MILLI,
        status="unstable" if reason else "ok",
        reason=reason,
        steps=steps,
        seconds=seconds,
        link_positions=None if shape is None else np.where(good[:, None, None], shape, np.nan),
    )
    return trace, mendable


def _end(status: int, failed: float) -> tuple[float, str]:
    """When (s) the numbers of a lane end, and why."""
    if status == OK:
        return np.inf, ""
    what = "a joint bent by more than 1.5 rad, more than a chain of links can represent"
    if status == LOST:
        what = "the state stopped being finite"
    return failed, f"{what}, at {failed:.6g} s; choose more links or a smaller time step"
