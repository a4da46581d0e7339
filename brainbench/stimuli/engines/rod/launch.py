"""One launch of the whisker kernel, for scenes and for sweeps: packed jobs go in, judged results come out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import to_struct, warp
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.compilation import load_kernels
from brainbench.stimuli.engines.rod.limits import LIGHT, LONGEST_SPAN, TO_ROUNDING, contact_iterations
from brainbench.stimuli.engines.rod.packing import PackedJobs, PackedMotions, capacity_for, pack_chains
from brainbench.stimuli.engines.rod.scheduling import Slices, allocate, make_problems
from brainbench.stimuli.engines.rod.shapes import PackedShapes
from brainbench.stimuli.engines.rod.streams import download, turn
from brainbench.stimuli.engines.trust import (
    FEWEST_READINGS,
    RunFacts,
    Verdict,
    force_change,
    halved,
    judge,
    residual,
    strongest_force,
)
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.whiskers.chain import Chain

_NUMBERS = ("depth", "failed", "miss", "load")
_COUNTS = ("status", "steps", "touching", "crowded", "unsolved")
"""Results of each job besides its readings."""


@dataclass(eq=False)
class LaunchResult:
    """Results of a launch, in a table of jobs: rows are the jobs of scenes, or sweeps; columns are whiskers, or one."""

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
    retried: NDArray[np.bool_]
    """[row, column] True where a whisker was simulated again."""
    points: NDArray[np.floating] | None = None
    """[row, reading, node, 3] joints and tip (m) from the base point, when shapes were asked for."""
    contact_wrench: NDArray[np.floating] | None = None
    """[row, reading, 6] force and moment of all contacts (N, N·m), when shapes were asked for."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Elapsed time of ``upload``, ``kernel`` and ``download``."""

    @property
    def steps(self) -> NDArray[np.int32]:
        """[row, column] steps computed, in all simulations of the whisker."""
        return self.counts["steps"]

    def split(self, counts: Sequence[int]) -> list[LaunchResult]:
        """Return so many rows of these results each, in order."""
        which = np.repeat(np.arange(len(counts)), counts)
        return [self] if len(counts) == 1 else [self.picked(which == part) for part in range(len(counts))]

    def picked(self, which: NDArray[np.bool_]) -> LaunchResult:
        """Return some rows [row] of these results; their steps count for the first who asks."""
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
            [*one.counts.values(), *vars(one.verdict).values(), one.depth, one.residual] for one in (self, finer)
        )
        for values, new in zip(mine, theirs, strict=True):
            values[which] = new[:, 0]
        if self.points is not None and self.contact_wrench is not None:
            self.points[row], self.contact_wrench[row] = finer.points, finer.contact_wrench
        self.retried |= which
        return self

    def compared(self, which: NDArray[np.bool_], half: LaunchResult) -> LaunchResult:
        """Return these results, some whiskers [row, column] judged by a launch of them alone."""
        row, column = np.nonzero(which)
        change = np.full(which.shape, np.nan)
        found = force_change(self.wrench[row, :, column, None, :3], half.wrench[..., :3])
        change[which] = np.where(half.verdict.unstable, np.nan, found)[:, 0]
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
        block: int | None = None,
        sliced: bool = False,
        **options: Any,
    ) -> None:
        """Load kernels.

        Args:
            chains, fidelity: whiskers, with their time step, precision and solver.
            device, needs, options: as for :func:`brainbench.stimuli.engines.rod.compilation.load_kernels`.
            twists: False when nothing twists the whiskers: their joints then have two hinges instead of three. As the
                fidelity says when None.
            block: threads of a block on a GPU; Warp's choice when None.
            sliced: True when whiskers pause for distances and contact forces (:class:`.scheduling.Slices`).
        """
        self.chains, self.device, self.sliced = list(chains), device, sliced
        self.real = real_type(fidelity)
        self.capacity = capacity_for(max(chain.links for chain in chains))
        self.quasistatic = fidelity.solver == "quasistatic"
        self.iterations = TO_ROUNDING if options.get("recorder") else contact_iterations(fidelity.contact_tolerance)
        hinges = 2 + (fidelity.twist is not False if twists is None else twists)
        if options:
            options["sliced"] = sliced
        self.kernels = load_kernels(device, self.real, self.capacity, needs, hinges=hinges, **options)
        packed = pack_chains(self.capacity, self.chains, self.quasistatic, hinges)
        with turn(device):
            self.chain_arrays = to_struct(self.kernels.structs.ChainArrays, packed, device)
        self.block = {} if block is None else {"block_dim": block}
        self.steps = np.array([fidelity.step_of(chain) * MILLI for chain in self.chains])
        """[whisker] longest time step (ms)."""
        self.strongest = np.array([strongest_force(chain.whisker) for chain in self.chains])
        self.tuning: dict[str, Any] = {}
        """Arguments of :class:`Slices`."""
        self.slices = 0
        """Slices of the last launch."""

    def free(self) -> None:
        """Give back what is on the device; no launch may follow."""
        with turn(self.device):
            del self.chain_arrays

    def launch(
        self,
        jobs: PackedJobs,
        motions: PackedMotions,
        shapes: PackedShapes,
        readings: NDArray[np.float64],
        size: tuple[int, int],
        *,
        start: float = 0.0,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        axes: NDArray[np.float64] | None = None,
        fast: NDArray[np.float64] | None = None,
        record_shape: bool = False,
    ) -> LaunchResult:
        """Simulate jobs.

        Args:
            jobs, motions, shapes: what to simulate; motions are those of bases and objects, shapes those of all scenes.
            readings: times (s) at which results are read.
            size: rows and columns of the results; jobs that stand in none of them are as if at rest.
            start, gravity: beginning of the simulation (s), acceleration [3] (m/s²).
            axes: rotation [3, 3] of the results; none when None.
            fast: [4, row, column] ``travel``, ``farthest``, ``fast_at`` and ``struck`` of
                :class:`brainbench.stimuli.engines.trust.RunFacts`; never when None.
            record_shape: also return shapes and contact wrenches; jobs then stand in their rows in order.
        """
        device = self.device
        clock = [time.perf_counter()]
        count = len(jobs)
        inputs, out, shapes_of = self._upload(jobs, motions, shapes, readings, size, start, gravity, axes, record_shape)
        clock.append(time.perf_counter())
        slices = self._take_steps(inputs, count, urgent=bool((jobs.finer > 1).all()))
        clock.append(time.perf_counter())
        found = download({name: getattr(out, name) for name in (*shapes_of, "contact")}, slices and slices.stream)
        with turn(device):
            # What a GPU holds of this launch is given back in a turn too.
            del out, inputs, slices
        clock.append(time.perf_counter())

        def table(values: NDArray) -> NDArray:
            whole = np.zeros(size, dtype=values.dtype)
            whole[jobs.row, jobs.column] = values
            return whole

        counts = {name: table(found[name]) for name in _COUNTS}
        wrench, missed = found["wrench"], table(residual(found["miss"], found["load"]))
        depth = table(found["depth"].astype(float)) / MILLI
        force = np.sqrt(np.einsum("...d,...d", wrench[..., :3], wrench[..., :3]))
        peak, strongest = force.max(axis=1), table(self.strongest[jobs.whisker])
        strength, strong_at = _first_beyond(strongest, force, readings)
        never = np.array([0.0, np.inf, np.inf, 0.0])
        travel, farthest, fast_at, struck = np.multiply.outer(never, np.ones(size)) if fast is None else fast
        facts = RunFacts(
            status=counts["status"],
            # Single precision rounds a late time; the reading at it must not pass for one before it.
            failed=start + table(found["failed"].astype(float)) * (1 - 2e-7) / MILLI,
            strength=strength,
            strong_at=strong_at,
            strongest=strongest,
            travel=travel,
            farthest=farthest,
            fast_at=fast_at,
            struck=struck.astype(bool),
            residual=missed,
            crowded=counts["crowded"],
            steps=counts["steps"],
            depth=depth,
            peak=peak,
            third=np.partition(force, -3, axis=1)[:, -3] if len(readings) >= FEWEST_READINGS else peak,
        )
        result = LaunchResult(wrench, found["contact"], counts, depth, missed, judge(facts), np.zeros(size, dtype=bool))
        result.seconds = dict(zip(("upload", "kernel", "download"), np.diff(clock).tolist(), strict=True))
        if record_shape:
            result.points = np.moveaxis(found["points"].astype(float) / MILLI, 2, 0)
            forces = found["contact_wrench"].astype(float)
            result.contact_wrench = np.moveaxis(forces, 2, 0).reshape(count, len(readings), 6)
        return result

    def _upload(
        self,
        jobs: PackedJobs,
        motions: PackedMotions,
        shapes: PackedShapes,
        readings: NDArray[np.float64],
        size: tuple[int, int],
        start: float,
        gravity: Sequence[float],
        axes: NDArray[np.float64] | None,
        record_shape: bool,
    ) -> tuple[list[Any], Any, dict[str, Any]]:
        """Return the arguments of the kernel but for the last, the results among them, and their shapes."""
        wp, structs, device = warp(), self.kernels.structs, self.device
        count, frames = len(jobs), len(readings)
        options = structs.StepOptions()
        options.quasistatic = int(self.quasistatic)
        weight = LIGHT if self.quasistatic else 1.0
        # Quasistatic whiskers have masses that are scaled by LIGHT; gravity is scaled back, so that their weight stays.
        options.gravity = structs.vec3(*np.divide(gravity, MILLI * weight).tolist())
        options.axes = structs.mat33(*(np.eye(3) if axes is None else axes).ravel().tolist())
        options.shape = int(record_shape)
        # Readings end a step: where they are nearer than a step, a part of it could be the same step once more.
        steps, between = self.steps[jobs.whisker], float(np.median(np.diff(readings, prepend=start))) * MILLI
        steps = np.where(jobs.finer > 1, np.minimum(steps, max(between, 1e-4)), steps)
        given = (
            (structs.MotionArrays, motions.arrays()),
            (structs.ShapeArrays, shapes.arrays()),
            (structs.JobArrays, jobs.arrays(self.chains, steps, start)),
            (structs.ReadingArrays, _readings(readings - start)),
        )
        shapes_of = dict.fromkeys((*_NUMBERS, *_COUNTS), count) | {
            "wrench": (size[0], frames, size[1], 6),
            "points": (frames, self.capacity + 1, count) if record_shape else (1, 1, 1),
            "contact_wrench": (frames, 2, count) if record_shape else (1, 1, 1),
        }
        with turn(device):
            out = allocate(structs.ResultArrays, device, **shapes_of)
            out.contact = wp.full((size[0], frames, size[1]), -1.0, dtype=self.real, device=device)
            *scene, reading = [to_struct(kind, values, device) for kind, values in given]
            problems = make_problems(self.kernels, self.capacity, count, device, self.iterations)
        return [self.chain_arrays, *scene, options, reading, out, problems], out, shapes_of

    def _take_steps(self, inputs: list[Any], count: int, *, urgent: bool) -> Slices | None:
        """Take all whiskers to their last reading; return the slices, if these are what it was done in."""
        wp, device = warp(), self.device
        if self.sliced:
            with turn(device):
                slices = Slices(self.kernels, self.capacity, count, device, urgent=urgent, **self.tuning)
            self.slices = slices.run(inputs, self.block["block_dim"])
            return slices
        with turn(device):
            wp.launch(
                self.kernels.run, count, [*inputs, self.kernels.structs.PausedWhiskers()], device=device, **self.block
            )
            wp.synchronize_device(device)
        return None


def real_type(fidelity: Fidelity) -> type:
    """Return Warp's type of the numbers that a simulation calculates with."""
    return warp().float32 if fidelity.precision == "single" else warp().float64


def _readings(times: NDArray[np.float64]) -> dict[str, NDArray]:
    """Return what the kernel's ``ReadingArrays`` hold, for times (s) since the start."""
    times = times * MILLI
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
    return {"time": np.stack([tick, all_times - tick], axis=1), "row": row}


def _first_beyond(
    strongest: NDArray[np.float64], strength: NDArray[np.floating], readings: NDArray[np.float64]
) -> tuple[NDArray[np.floating], NDArray[np.float64]]:
    """Return the first force beyond ``strongest``, and its time (s; inf without), [row, column]."""
    # Written as "not at most" so that NaN counts as too strong.
    wild = ~(strength <= strongest[:, None])
    first = wild.argmax(axis=1)
    at = np.where(wild.any(axis=1), readings[first], np.inf)
    return np.take_along_axis(strength, first[:, None], axis=1)[:, 0], at
