"""One launch of the whisker kernel: packed jobs go in, judged results come out, and who is in doubt is tried again.

Kernels are compiled when a machine first needs them and kept by Warp.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import to_struct, warp
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.limits import (
    CONTACT_BOUNDS,
    DISTANCE_BOUNDS,
    FINEST,
    LIGHT,
    LONGEST_SPAN,
    MESHES,
    NOTHING,
    TO_ROUNDING,
    WIDEST,
    contact_iterations,
)
from brainbench.stimuli.engines.rod.packing import (
    PackedJobs,
    PackedMotions,
    PackedShapes,
    capacity_for,
    pack_chains,
    pack_follicles,
)
from brainbench.stimuli.engines.rod.slices import SceneParts, Slices, allocate, download, lock_of, make_problems
from brainbench.stimuli.engines.trust import (
    BLOW_STRIDE,
    FEWEST_READINGS,
    HARD_BLOW,
    RunFacts,
    Verdict,
    force_change,
    halved,
    judge,
    residual,
    strongest_force,
)
from brainbench.stimuli.motion.jobs import MILLI
from brainbench.stimuli.whiskers.whisker import Chain


def load_kernels(
    device: Any,
    real: type,
    capacity: int,
    needs: int = MESHES,
    *,
    hinges: int = 2,
    recorder: str = "",
    features: tuple[str, ...] = (),
    compiling: Callable[[bool], None] | None = None,
    **options: Any,
) -> Any:
    """Return the kernels for chains of at most ``capacity`` links on a device, ready to be launched.

    On a processor one kernel serves whatever there is to touch: what a scene does not use costs it nothing there, while
    every further kernel would cost its compilation. Threads may ask at once; each kernel is compiled once.

    ``compiling`` is called with True before compiling and with False after it, not at all for kernels that Warp has
    kept. Everything else is as for :func:`brainbench.stimuli.engines.rod.kernels.build_kernels`; of ``options`` a
    processor knows ``sliced`` alone.
    """
    from brainbench.stimuli.engines.rod.kernels import BUILDING, build_kernels

    kind: dict[str, Any] = {"hinges": hinges, "recorder": recorder, "features": features}
    with BUILDING:
        if device.is_cuda:
            kernels = build_kernels(real, capacity, needs, cuda=True, **kind, **options)
        else:
            kernels = build_kernels(real, capacity, sliced=options.get("sliced", False), **kind)
    if device.is_cuda and options.get("sliced"):
        blocks = {**dict.fromkeys((kernels.run, kernels.go_on), options["bounds"][0]), kernels.swap_queues: None}
        blocks[kernels.measure_distances] = DISTANCE_BOUNDS[0]
        blocks |= {kernel: CONTACT_BOUNDS[0] for kernel, _ in kernels.solve_contacts}
        # Those that this machine does not have yet compile side by side.
        with kernels.loading, lock_of(device), ThreadPoolExecutor(len(blocks)) as pool:
            list(pool.map(lambda kernel: kernel.module.load(device, block_dim=blocks[kernel]), blocks))
        return kernels
    if device.is_cuda and options:  # compiled at their launch, for the blocks that it asks for
        return kernels
    block = 1 if device.is_cpu else None
    with kernels.loading:
        module = kernels.run.module
        compiled = Path(warp().config.kernel_cache_dir, module.get_module_identifier(block)).is_dir()
        tell = (lambda begins: None) if compiled or compiling is None else compiling
        tell(True)
        module.load(device, block_dim=block)
        tell(False)
    return kernels


@dataclass(frozen=True, eq=False)
class Approach:
    """How objects come at whiskers, in the words of :class:`brainbench.stimuli.engines.trust.RunFacts`.

    Numbers of one whisker, or arrays [row, column] of those of a launch.
    """

    travel: Any = 0.0
    farthest: Any = math.inf
    fast_at: Any = math.inf
    struck: Any = False

    @classmethod
    def table(cls, approaches: Sequence[Approach]) -> Approach:
        """Return those of jobs as arrays [job, 1]."""
        names = [each.name for each in fields(cls)]
        return cls(**{name: np.array([[getattr(approach, name)] for approach in approaches]) for name in names})


def followed(
    speed: NDArray[np.float64], blow: NDArray[np.float64], step: NDArray[np.float64], radius: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ways (m) of objects in a step (s), and up to which way contact is followed.

    ``speed`` (m/s) is that against any point of the whisker, ``blow`` that against its base while the object is near.
    """
    # The shortest step that contacts may ask for finds them; blows are cut to one way by it, whose force is not right.
    stride = np.multiply(BLOW_STRIDE, radius)
    hard = (blow > HARD_BLOW) & (blow * step > stride)
    return np.where(hard, blow * step, speed * step / FINEST), np.where(hard, stride, WIDEST / MILLI)


@dataclass(frozen=True, eq=False)
class Launch:
    """What is simulated in one launch."""

    jobs: PackedJobs
    motions: PackedMotions
    """Of bases and objects."""
    shapes: PackedShapes
    """Of all scenes."""
    readings: NDArray[np.float64]
    """Times (s) at which results are read."""
    size: tuple[int, int]
    """Rows and columns of the results; whiskers that stand in none of them are as if at rest."""
    start: float = 0.0
    """Beginning of the simulation (s)."""
    gravity: Sequence[float] = (0.0, 0.0, 0.0)
    """[3] m/s²."""
    air_flow: Sequence[float] | None = None
    """[3] m/s; given to solvers whose whiskers feel air, and to no others."""
    axes: NDArray[np.float64] | None = None
    """Rotation [3, 3] of the results; none when None."""
    approach: Approach = field(default_factory=Approach)
    record_shape: bool = False
    """Whether shapes and contact wrenches are results too; jobs then stand in their rows in order."""


_COUNTS = ("status", "steps", "touching", "crowded", "unsolved")
"""Counts of each job, of those that its kernel keeps."""


MOST_JOBS, MOST_NUMBERS = 64, 2**16
"""Jobs of a launch, and numbers that go in and out, up to which its memory is kept for the next one."""


@dataclass(frozen=True, eq=False)
class Room:
    """Memory of a launch, which on a processor the next one of the same shapes takes: it costs as much as 50 ms."""

    shapes: list[Any]
    scene: list[Any]
    problems: Any
    results: Any
    launches: list[Any] = field(default_factory=list)
    """The last launch, as Warp has packed it."""

    @cached_property
    def views(self) -> list[dict[str, NDArray]]:
        """What the structures of the scene hold, then contact problems and results: Warp takes long to look it up."""
        parts, kind = (*self.scene, self.problems, self.results), warp().array
        return [{key: array.numpy() for key, array in vars(part).items() if isinstance(array, kind)} for part in parts]

    def refill(self, parts: Mapping[Any, Mapping[str, NDArray]]) -> None:
        """Upload what the structures of the scene hold, and clear those of contact problems and results."""
        for views, part in zip(self.views, parts.values(), strict=False):
            for name, values in part.items():
                if values.size:
                    views[name][...] = values
        for view in (view for views in self.views[len(parts) :] for view in views.values()):
            view.reshape(-1).view(np.uint8).fill(0)  # faster than record by record


@dataclass(eq=False)
class LaunchResult:
    """Results of a launch in a table of jobs, whose rows and columns the launch names."""

    wrench: NDArray[np.floating]
    """[row, reading, column, 6] action of the whisker on its base (N, N·m)."""
    contact: NDArray[np.floating]
    """[row, reading, column] arc of the contact (m), negative without."""
    counts: dict[str, NDArray[np.int32]]
    """[row, column] of each: ``status``, ``steps`` computed, steps ``touching`` anything, steps for some of whose
    contacts there was no room (``crowded``), and steps whose contact forces were not solved to the tolerance
    (``unsolved``)."""
    depth: NDArray[np.floating]
    """[row, column] deepest overlap (m)."""
    residual: NDArray[np.floating]
    """[row, column] as :func:`brainbench.stimuli.engines.trust.residual`."""
    verdict: Verdict
    """[row, column]"""
    divisor: NDArray[np.integer]
    """[row, column] what divided the time steps; 1 unless a whisker was simulated again."""
    displacement: NDArray[np.floating] | None = None
    """[row, reading, column, 6] as :attr:`brainbench.stimuli.motion.jobs.Trace.displacement`; None if all are rigid."""
    points: NDArray[np.floating] | None = None
    """[row, reading, node, 3] joints and tip (m) from the base point, when shapes were asked for."""
    contact_wrench: NDArray[np.floating] | None = None
    """[row, reading, 6] force and moment of all contacts (N, N·m), when shapes were asked for."""
    seconds: float = 0.0
    """Elapsed time of the kernels."""

    @property
    def steps(self) -> NDArray[np.int32]:
        """[row, column] steps computed, in all simulations of the whisker."""
        return self.counts["steps"]

    def split(self, counts: Sequence[int]) -> list[LaunchResult]:
        """Return so many rows of these results each, in order."""
        which = np.repeat(np.arange(len(counts)), counts)
        return [self] if len(counts) == 1 else [self.picked(which == part) for part in range(len(counts))]

    def picked(self, which: NDArray[np.bool_ | np.integer]) -> LaunchResult:
        """Return some rows of these results, by mask or in an order; their steps count for the first who asks."""
        arrays = {name: values[which] for name, values in vars(self).items() if isinstance(values, np.ndarray)}
        counts = {name: values[which] for name, values in self.counts.items()}
        verdict = Verdict(**{name: values[which] for name, values in vars(self.verdict).items()})
        self.counts["steps"][which] = 0
        return replace(self, counts=counts, verdict=verdict, **arrays)

    def replaced(self, which: NDArray[np.bool_], finer: LaunchResult) -> LaunchResult:
        """Return these results with some whiskers [row, column] from a launch of them alone."""
        row, column = np.nonzero(which)
        self.wrench[row, :, column], self.contact[row, :, column] = finer.wrench[:, :, 0], finer.contact[:, :, 0]
        finer.counts["steps"] += self.steps[which][:, None]
        mine, theirs = (
            [*result.counts.values(), *vars(result.verdict).values(), result.depth, result.residual]
            for result in (self, finer)
        )
        for values, new in zip(mine, theirs, strict=True):
            values[which] = new[:, 0]
        if self.displacement is not None and finer.displacement is not None:
            self.displacement[row, :, column] = finer.displacement[:, :, 0]
        if self.points is not None and self.contact_wrench is not None:
            self.points[row], self.contact_wrench[row] = finer.points, finer.contact_wrench
        self.divisor[which] = finer.divisor[:, 0]
        return self

    def compared(self, which: NDArray[np.bool_], half: LaunchResult) -> LaunchResult:
        """Return these results, some whiskers [row, column] judged by a launch of them alone."""
        row, column = np.nonzero(which)
        change = np.full(which.shape, np.nan)
        changes = force_change(self.wrench[row, :, column, None, :3], half.wrench[..., :3])
        change[which] = np.where(half.verdict.unstable, np.nan, changes)[:, 0]
        self.verdict = halved(self.verdict, change, which)
        self.counts["steps"][which] += half.steps[:, 0]
        return self


class WhiskerSolver:
    """Some whiskers on a device with the kernels for them, ready for any number of launches."""

    def __init__(
        self,
        chains: Sequence[Chain],
        fidelity: Fidelity,
        device: Any,
        needs: int,
        *,
        twists: bool | None = None,
        flows: bool = False,
        block: int | None = None,
        sliced: bool = False,
        **options: Any,
    ) -> None:
        """Load kernels.

        Args:
            chains, fidelity: whiskers, with their time step, precision and solver.
            device, needs, options: as for :func:`brainbench.stimuli.engines.rod.launch.load_kernels`.
            twists: False when nothing twists the whiskers: their joints then have two hinges instead of three. As the
                fidelity says when None.
            flows: True when whiskers feel air.
            block: threads of a block on a GPU; Warp's choice when None.
            sliced: True when whiskers pause for distances and contact forces (:class:`.slices.Slices`).
        """
        self.chains, self.device, self.sliced = list(chains), device, sliced
        self.real = real_type(fidelity)
        self.capacity = capacity_for(max(chain.links for chain in chains))
        self.quasistatic = fidelity.solver == "quasistatic"
        self.travel = fidelity.contact_travel * MILLI
        self.iterations = TO_ROUNDING if options.get("recorder") else contact_iterations(fidelity.contact_tolerance)
        hinges = 2 + (fidelity.twist is not False if twists is None else twists)
        if options:
            options["sliced"] = sliced
        self.yields = any(chain.whisker.follicle is not None for chain in self.chains)
        rolls = any(chain.rest_rolls.any() for chain in self.chains)
        self.smooth = smooth = fidelity.contact_line == "rod" and (needs > NOTHING or device.is_cpu)
        uses = {"yields": self.yields, "rolls": rolls, "flows": flows, "smooth": smooth}
        features = tuple(name for name, used in uses.items() if used)
        self.kernels = load_kernels(
            device, self.real, self.capacity, needs, hinges=hinges, features=features, **options
        )
        packed = pack_chains(self.capacity, self.chains, self.quasistatic, hinges, rolls=rolls, smooth=smooth)
        if self.yields:
            packed["follicle"] = pack_follicles(self.chains, self.quasistatic)
        with lock_of(device):
            self.chain_arrays = to_struct(self.kernels.structs.ChainArrays, packed, device, copy=False)
        self.block = {} if block is None else {"block_dim": block}
        self.steps = np.array([fidelity.step_of(chain) * MILLI for chain in self.chains])
        """[whisker] longest time step (ms)."""
        self.strongest = np.array([strongest_force(chain.whisker) for chain in self.chains])
        self.rooms = threading.local()
        """Of each thread the :class:`Room` of its last launch, None unless that was small and on a processor."""
        self.tuning: dict[str, Any] = {}
        """Arguments of :class:`Slices`."""
        self.slices = 0
        """Slices of the last launch."""

    def free(self) -> None:
        """Give back what is on the device; no launch may follow."""
        with lock_of(self.device):
            del self.chain_arrays

    def launch(self, given: Launch) -> LaunchResult:
        """Simulate jobs."""
        device, jobs, size = self.device, given.jobs, given.size
        scene, problems, results, shapes_of = self._upload(given)
        started = time.perf_counter()
        stream = self._take_steps(scene, problems, results, jobs)
        seconds = time.perf_counter() - started
        room = self.rooms.last
        if room is not None and "views" in vars(room):
            # The next launch takes the memory.
            values = {name: room.views[-1][name].copy() for name in shapes_of}
        else:
            values = download({name: getattr(results, name) for name in shapes_of}, stream)
        with lock_of(device):
            # What a GPU holds of this launch is given back under the lock too.
            del scene, problems, results

        def _table(column: NDArray) -> NDArray:
            whole = np.zeros(size, dtype=column.dtype)
            whole[jobs.row, jobs.column] = column
            return whole

        state = values["state"]
        counts = {name: _table(state[name]) for name in _COUNTS}
        wrench, missed = values["wrench"], _table(residual(state["miss"], state["load"]))
        depth = _table(state["depth"].astype(float)) / MILLI
        force = np.sqrt(np.einsum("...d,...d", wrench[..., :3], wrench[..., :3]))
        peak, strongest = force.max(axis=1), _table(self.strongest[jobs.whisker])
        strength, strong_at = _first_beyond(strongest, force, given.readings)
        facts = RunFacts(
            status=counts["status"],
            # Single precision rounds a late time; the reading at it must not pass for one before it.
            failed=given.start + _table(state["failed_at"].astype(float)) * (1 - 2e-7) / MILLI,
            strength=strength,
            strong_at=strong_at,
            strongest=strongest,
            **{name: np.full(size, value) for name, value in vars(given.approach).items()},
            residual=missed,
            crowded=counts["crowded"],
            steps=counts["steps"],
            depth=depth,
            peak=peak,
            third=np.partition(force, -3, axis=1)[:, -3] if len(given.readings) >= FEWEST_READINGS else peak,
        )
        result = LaunchResult(wrench, values["contact"], counts, depth, missed, judge(facts), _table(jobs.finer))
        result.displacement, result.seconds = values.get("displacement"), seconds
        if given.record_shape:
            result.points = np.moveaxis(values["points"].astype(float) / MILLI, 2, 0)
            forces = values["contact_wrench"].astype(float)
            result.contact_wrench = np.moveaxis(forces, 2, 0).reshape(len(jobs), len(given.readings), 6)
        return result

    def _upload(self, given: Launch) -> tuple[SceneParts, Any, Any, dict[str, Any]]:
        """Return scene, contact problems and results on the device, and the shapes of the results."""
        structs, device, jobs = self.kernels.structs, self.device, given.jobs
        size, count, frames = given.size, len(jobs), len(given.readings)
        options = structs.StepOptions()
        options.travel = self.travel
        options.quasistatic = int(self.quasistatic)
        weight = LIGHT if self.quasistatic else 1.0
        # Quasistatic whiskers have masses that are scaled by LIGHT; gravity is scaled back, so that their weight stays.
        options.gravity = structs.vec3(*np.divide(given.gravity, MILLI * weight).tolist())
        if given.air_flow is not None:  # m/s is mm/ms
            options.air_flow = structs.vec3(*given.air_flow)
        options.axes = structs.mat33(*(np.eye(3) if given.axes is None else given.axes).ravel().tolist())
        options.shape = int(given.record_shape)
        # Readings end a step: where they are nearer than a step, a part of it could be the same step once more.
        steps = self.steps[jobs.whisker]
        if (jobs.finer > 1).any():
            between = float(np.median(np.diff(given.readings, prepend=given.start))) * MILLI
            steps = np.where(jobs.finer > 1, np.minimum(steps, max(between, 1e-4)), steps)
        parts = {
            structs.MotionArrays: given.motions.arrays(),
            structs.ShapeArrays: given.shapes.arrays(),
            structs.JobArrays: jobs.arrays(self.chains, steps, given.start),
            structs.ReadingArrays: _readings((given.readings - given.start).tobytes()),
        }
        shapes_of = {
            "state": (count,),
            "wrench": (size[0], frames, size[1], 6),
            "points": (frames, self.capacity + 1, count) if given.record_shape else (1, 1, 1),
            "contact_wrench": (frames, 2, count) if given.record_shape else (1, 1, 1),
            "contact": (size[0], frames, size[1]),
        }
        if self.yields:
            shapes_of["displacement"] = shapes_of["wrench"]
        shapes = [*shapes_of.values(), *(values.shape for part in parts.values() for values in part.values())]
        room = getattr(self.rooms, "last", None)
        with lock_of(device):
            if room is None or room.shapes != shapes:
                small = device.is_cpu and count <= MOST_JOBS and sum(map(math.prod, shapes)) <= MOST_NUMBERS
                room = Room(
                    shapes,
                    [to_struct(kind, values, device, copy=small) for kind, values in parts.items()],
                    make_problems(self.kernels, self.capacity, count, device, self.iterations),
                    allocate(structs.ResultArrays, device, **shapes_of),
                )
                self.rooms.last = room if small else None
            else:
                room.refill(parts)
            room.results.contact.fill_(-1.0)
        return SceneParts._make((self.chain_arrays, *room.scene, options)), room.problems, room.results, shapes_of

    def _take_steps(self, scene: SceneParts, problems: Any, results: Any, jobs: PackedJobs) -> Any:
        """Take all whiskers to their last reading; return the stream in which that is done, None of a processor."""
        wp, device, count = warp(), self.device, len(jobs)
        if self.sliced:
            with lock_of(device):
                # Whiskers that are simulated again go first: others wait for them.
                urgent = bool((jobs.finer > 1).all())
                slices = Slices(self.kernels, self.capacity, count, device, urgent=urgent, **self.tuning)
            self.slices = slices.run(scene, problems, results, self.block["block_dim"])
            return slices.stream
        with lock_of(device):
            launches = [] if self.rooms.last is None else self.rooms.last.launches
            if launches:
                launches[0].set_param_at_index(SceneParts._fields.index("options"), scene.options)
            else:
                inputs = [*scene, problems, self.kernels.structs.PausedWhiskers(), results]
                options = {"device": device, "record_cmd": True, **self.block}
                launches.append(wp.launch(self.kernels.run, count, inputs, **options))
            launches[0].launch()
            wp.synchronize_device(device)
        return None


def real_type(fidelity: Fidelity) -> type:
    """Return Warp's type of the numbers that a simulation calculates with."""
    return warp().float32 if fidelity.precision == "single" else warp().float64


@lru_cache(16)
def _readings(moments: bytes) -> dict[str, NDArray]:
    """Return what the kernel's ``ReadingArrays`` hold, for times (s) since the start, which most launches share."""
    times = np.frombuffer(moments) * MILLI
    before = np.concatenate([[0.0], times[:-1]])
    # Within a span single precision keeps time; longer ones are divided, in equal parts.
    parts = np.maximum(np.ceil((times - before) / LONGEST_SPAN - 1e-9), 1).astype(int)
    which = np.repeat(np.arange(len(times)), parts)
    last = np.cumsum(parts) - 1
    share = (np.arange(len(which)) - last[which]) / parts[which] + 1
    all_times = before[which] + (times - before)[which] * share
    all_times[last] = times
    tick = np.floor(all_times)
    row = np.full(len(which), -1, dtype=np.int32)
    row[last] = np.arange(len(times))
    time = np.zeros(len(which), dtype=[("tick", "i4"), ("part", "f8")])
    time["tick"], time["part"] = tick, all_times - tick
    return {"time": time, "row": row}


def _first_beyond(
    strongest: NDArray[np.float64], strength: NDArray[np.floating], readings: NDArray[np.float64]
) -> tuple[NDArray[np.floating], NDArray[np.float64]]:
    """Return the first force beyond ``strongest``, and its time (s; inf without), [row, column]."""
    # Written as "not at most" so that NaN counts as too strong.
    wild = ~(strength <= strongest[:, None])
    first = wild.argmax(axis=1)
    at = np.where(wild.any(axis=1), readings[first], np.inf)
    return np.take_along_axis(strength, first[:, None], axis=1)[:, 0], at


Try = tuple[NDArray[np.bool_] | None, int]
"""Whiskers to simulate, all when None, and what divides their steps."""


def run_with_retries(simulate: Callable[[Sequence[Try]], Sequence[LaunchResult]], retry: int) -> LaunchResult:
    """Simulate whiskers, and those that finer steps may mend again: with steps over ``retry``, then over twice that.

    After each of these, suspicious whiskers are compared with half the step (:func:`.trust.halved`), at first
    with steps over ``retry`` where they meet a blow.

    Args:
        simulate: gives the results of tries, which may be simulated at the same time; whiskers of a mask are in its
            order, and alone.
        retry: 1 leaves all whiskers as they are.
    """
    (result,) = simulate([(None, 1)])
    if retry == 1:
        return result
    simulated: dict[int, list[tuple[NDArray[np.bool_], LaunchResult]]] = {}

    def run(wanted: Mapping[int, NDArray[np.bool_]]) -> None:
        """Simulate whiskers, by what divides their steps, unless that was done before."""
        tries = []
        for finer, which in wanted.items():
            missing = which & ~np.any([some for some, _ in simulated.setdefault(finer, [])], axis=0)
            if missing.any():
                tries.append((missing, finer))
        for (which, finer), part in zip(tries, simulate(tries) if tries else (), strict=True):
            simulated[finer].append((which, part))

    def parts(which: NDArray[np.bool_], finer: int) -> Iterator[tuple[NDArray[np.bool_], LaunchResult]]:
        """Yield these whiskers in parts with their results."""
        for mask, part in simulated[finer]:
            some = which & mask
            if some.any():
                yield some, part.picked(some[mask])

    left = np.ones_like(result.verdict.retryable)
    for finer in (1, retry, 2 * retry):
        if finer > 1:
            left = result.verdict.retryable.copy()
            run({finer: left})
            for some, part in parts(left, finer):
                result = result.replaced(some, part)
        suspicious = result.verdict.suspicious & left
        doubtful = suspicious | result.verdict.retryable
        if not doubtful.any():
            break
        # Contacts may cut the step of a blow and its half to the same.
        divisors = np.where(result.verdict.struck, max(retry, 2 * finer), 2 * finer)
        compared = {int(divisor): suspicious & (divisors == divisor) for divisor in np.unique(divisors)}
        # Steps over twice ``retry`` are a half for some and a try for others.
        run(compared | ({2 * retry: doubtful} if finer == retry else {}))
        for divisor, which in compared.items():
            for some, half in parts(which, divisor):
                result = result.compared(some, half)
    return result
