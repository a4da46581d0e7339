"""Simulation of jobs that is differentiated: results, and the gradient of any number made of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import pick_device, usable_processors
from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.reach import reachable, stays_in_plane
from brainbench.stimuli.engines.rod.engine import RodEngine, trace_of
from brainbench.stimuli.engines.rod.packing import capacity_for, knots_alike
from brainbench.stimuli.engines.rod.tasks import JobTask, PackedTasks, make_task
from brainbench.stimuli.engines.trust import check_jobs
from brainbench.stimuli.fitting.derivatives.packed_changes import Numbers, PackedPlaces, packed_change, packed_part
from brainbench.stimuli.fitting.derivatives.recorded_run import RecordingSolver
from brainbench.stimuli.motion.jobs import Job, Trace

Nearness = Literal["ending", "beginning", "passing", "slipping", "sticking"]
SMALL_FORCE = 1e-5
"""Share of the whisker's largest contact force below which a contact is about to end or has just begun."""
SMALL_GAP = 1e-5
"""Gap (mm) at the end of a step up to which an open contact is about to close."""
SMALL_LEAD = 1e-6
"""Gap (mm) by which one link is nearer than the next up to which a contact is about to pass from one to the other."""
FULL_CONE = 1 - 1e-5
"""Share of the friction cone from which sticking is close to sliding."""
SMALL_SLIP = 1e-5
"""Share of the whisker's fastest slip below which sliding is close to sticking."""


@dataclass(frozen=True)
class ContactEvents:
    """Changes of contact of one whisker in its run."""

    status: Literal["smooth", "one-sided", "degenerate", "unstable"]
    """``smooth``: the gradient holds on both sides. ``one-sided``: in some step a contact was so near to opening,
    closing, passing from link to link, sticking or sliding (``close``) that the gradient on the other side is another.
    ``degenerate``: in some step contacts shared their load in more than one way, or their forces could not be solved to
    rounding. ``unstable``: the simulation cannot be trusted, and the gradient is NaN."""
    begun: int
    """Steps in which more contacts pressed than before."""
    ended: int
    """Steps in which fewer did."""
    slipped: int
    """Steps in which as many pressed and more, or fewer, of them slid."""
    close: tuple[Nearness, ...]
    """What some contact was close to in some step."""


def contact_events(summary: Any, reason: str) -> ContactEvents:
    """Return the events of one job from its ``fitting.derivatives.kernels.contacts.ContactSummary``.

    ``reason`` is why the run cannot be trusted, if so.
    """
    close: list[Nearness] = []
    if summary["least_force"] < SMALL_FORCE * summary["largest_force"]:
        close.append("ending")
    if summary["least_gap"] < SMALL_GAP:
        close.append("beginning")
    if summary["least_lead"] < SMALL_LEAD:
        close.append("passing")
    if summary["fullest_cone"] > FULL_CONE:
        close.append("slipping")
    if summary["slowest_slip"] < SMALL_SLIP * summary["fastest_slip"]:
        close.append("sticking")
    status: Literal["smooth", "one-sided", "degenerate", "unstable"] = "one-sided" if close else "smooth"
    if summary["degenerate"]:
        status = "degenerate"
    if reason:
        status = "unstable"
    begun = int(summary["begun"]) + int(summary["first"] > 0)
    return ContactEvents(status, begun, int(summary["ended"]), int(summary["slipped"]), tuple(close))


T = TypeVar("T")
R = TypeVar("R")
Build = Callable[[NDArray[np.float64]], Sequence[Job]]
"""Values of the parameters [p] → jobs, of the same kind and number for all values."""
CUDA_ROOM = 2**32
"""Bytes that records of steps may take on a GPU: what does not fit is simulated once more, and its threads take a
whisker each, so that steps take as long for one whisker as for thousands."""
Given = Sequence[NDArray[np.float64] | None]
"""Derivatives of a number by one output of each job; None for zeros."""


@dataclass(frozen=True, eq=False)
class Gradient:
    """Derivatives of one number, and where they hold."""

    values: NDArray[np.float64]
    """[p] derivative by each parameter; NaN when a whisker that counts is not ``ok``."""
    by_job: NDArray[np.float64]
    """[job, p] the part that each whisker has in it."""
    events: tuple[ContactEvents, ...]
    """[job] changes of contact in the run, and whether any was so near that the derivative is one-sided."""

    @property
    def smooth(self) -> bool:
        """True when no contact was close to another state: the gradient holds on both sides."""
        return all(event.status == "smooth" for event in self.events)


@dataclass(frozen=True, eq=False)
class Tangents:
    """Derivatives of the results of one job by each parameter; NaN when its simulation is not ``ok``."""

    wrench: NDArray[np.float64]
    """[p, n, 6]"""
    link_positions: NDArray[np.float64]
    """[p, n, links + 1, 3]"""
    contact_wrench: NDArray[np.float64]
    """[p, n, 6]"""


@dataclass(frozen=True, eq=False)
class _Group:
    """Jobs of one launch."""

    indices: tuple[int, ...]
    packed: PackedTasks
    solver: RecordingSolver
    places: list[PackedPlaces]


class GradientRun:
    """Jobs built from parameters, simulated, and ready to be differentiated."""

    def __init__(
        self,
        build: Build,
        values: Sequence[float] | NDArray[np.float64],
        *,
        scales: Sequence[float] | NDArray[np.float64] | None = None,
        fidelity: Fidelity | str = "balanced",
        device: str = "auto",
    ) -> None:
        """Simulate.

        Args:
            build: jobs from the values [p] of the parameters.
            values: at which to simulate and differentiate.
            scales: [p] size of a change of each parameter that is small and not tiny; a ten-thousandth of it is the
                difference with which packing is differentiated. The values themselves when None.
            fidelity: as for :func:`brainbench.stimuli.simulate`; precision is always double here, and steps have the
                length that the given values ask for.
            device: as for the engine ``rod``.
        """
        self.values = np.array(values, dtype=float)
        self.scales = np.abs(self.values if scales is None else np.array(scales, dtype=float))
        _check_values(self.values, self.scales)
        self.build = build
        self.fidelity = replace(Fidelity.of(fidelity), precision="double")
        self.jobs = tuple(build(self.values.copy()))
        self.device = pick_device(device)
        check_jobs(RodEngine(device), self.jobs, self.fidelity, None)
        # Two jobs a parameter, a little below and above: how packed numbers change is their difference.
        self._changed = [
            tuple(tuple(build(self.values + sign * width * (np.arange(len(self.values)) == p))) for sign in (-1, 1))
            for p, width in enumerate(self._widths)
        ]
        for pair in self._changed:
            for jobs in pair:
                if len(jobs) != len(self.jobs):
                    raise UsageError(
                        f"build must return the same number of jobs for all values; received {len(self.jobs)} and "
                        f"{len(jobs)}."
                    )
        self.traces, self._groups = self._simulate()

    @property
    def _widths(self) -> NDArray[np.float64]:
        return 1e-4 * self.scales

    @cached_property
    def _rows(self) -> list[tuple[_Group, int]]:
        """Group of each job, and its row there."""
        places = {index: (group, row) for group in self._groups for row, index in enumerate(group.indices)}
        return [places[index] for index in range(len(self.jobs))]

    def _simulate(self) -> tuple[list[Trace], list[_Group]]:
        tasks: list[JobTask] = []
        for index, job in enumerate(self.jobs):
            task = make_task(job, self.fidelity, {}, silent=True)
            assert task is not None
            near = [jobs[index] for pair in self._changed for jobs in pair]
            # A parameter may take a whisker out of its plane, or move a base, where the run itself stays.
            if not task.twists and self.fidelity.twist is not False:
                task = replace(task, twists=any(_leaves_plane(task, one) for one in near[1::2]))
            if task.base.pieces is None:
                task = self._with_knots(task, near)
            tasks.append(task)
        return self._launch(tasks)

    def _with_knots(self, task: JobTask, near: Sequence[Job]) -> JobTask:
        """Return a task whose base stands still with the knots of a job near it that moves, if there is one."""
        seen = np.linspace(*_span(task.job), 17)
        for job in near:
            if max(np.ptp(np.asarray(part), axis=0).max() for part in job.follicle.pose(seen)) > 0:
                moving = make_task(job, self.fidelity, {}, silent=True)
                assert moving is not None
                pose = task.job.follicle.pose
                knots = knots_alike(moving.base, pose, base_rotation, _span(job), "the base of a whisker")
                return replace(task, base=replace(moving.base, knots=knots), limit=moving.limit)
        return task

    def _launch(
        self, tasks: Sequence[JobTask], steps: Sequence[float] | None = None
    ) -> tuple[list[Trace], list[_Group]]:
        """Simulate tasks; ``steps`` [task] (ms) are their longest time steps, as the fidelity says when None."""
        alike: dict[Any, list[int]] = {}
        for index, task in enumerate(tasks):
            job = task.job
            key = (capacity_for(task.chain.links), job.times.tobytes(), job.start, tuple(job.gravity), task.twists)
            alike.setdefault(key, []).append(index)
        # A processor takes the jobs of a launch one by one, so that each of its threads has a launch of its own.
        threads = 1 if self.device.is_cuda else usable_processors()
        parts = [part for some in alike.values() for start in range(threads) if (part := some[start::threads])]

        def simulate(indices: Sequence[int]) -> tuple[_Group, list[Trace]]:
            some = [tasks[index] for index in indices]
            packed = PackedTasks.of(some, shared=False)
            needs = packed.shapes.needs
            solver = RecordingSolver(packed.chains, self.fidelity, self.device, needs, twists=some[0].twists)
            if self.device.is_cuda:
                solver.room = CUDA_ROOM
            if steps is not None:
                solver.steps[packed.jobs.whisker] = [steps[index] for index in indices]
            result = packed.launch(solver, record_shape=True)
            traces = [trace_of(result, row, task.job, self.fidelity, 0.0) for row, task in enumerate(some)]
            return _Group(tuple(indices), packed, solver, PackedPlaces.of(packed)), traces

        launches = _at_once(simulate, parts)
        traces = {index: trace for group, found in launches for index, trace in zip(group.indices, found, strict=True)}
        return [traces[index] for index in range(len(tasks))], [group for group, _ in launches]

    @cached_property
    def changes(self) -> list[list[Numbers]]:
        """Derivatives of the packed numbers of each job by each parameter: a row a parameter, a column a job."""
        rows = []
        for (low, high), width in zip(self._changed, self._widths, strict=True):
            row = []
            for index, (group, place) in enumerate(self._rows):
                task, ends = group.packed.tasks[place], (low[index], high[index])
                row.append(packed_change(task, *ends, 2 * width, group.solver.quasistatic))
            rows.append(row)
        return rows

    def gradient(
        self,
        wrench: Given | None = None,
        link_positions: Given | None = None,
        contact_wrench: Given | None = None,
    ) -> Gradient:
        """Return the gradient of a number from its derivatives by what :attr:`traces` hold.

        Args:
            wrench: [job] of arrays [n, 6]; None for zeros.
            link_positions: [job] of arrays [n, links + 1, 3].
            contact_wrench: [job] of arrays [n, 6].
        """
        outputs = (wrench, link_positions, contact_wrench)
        by_job = np.zeros((len(self.jobs), len(self.values)))
        for index, tangents in enumerate(self.tangents()):
            for given, changes in zip(outputs, vars(tangents).values(), strict=True):
                weights = None if given is None else given[index]
                if weights is not None:
                    by_job[index] += np.tensordot(changes, weights, axes=np.ndim(weights))
        return Gradient(by_job.sum(axis=0), by_job, self._passes[1])

    def tangents(self) -> list[Tangents]:
        """Return the derivatives of what :attr:`traces` hold by each parameter, one for each job.

        One pass over the recorded steps gives them for all parameters.
        """
        return list(self._passes[0])

    @cached_property
    def _passes(self) -> tuple[tuple[Tangents, ...], tuple[ContactEvents, ...]]:
        """Derivatives and changes of contact of each job, from one pass over its steps."""
        tangents: dict[int, Tangents] = {}
        events: dict[int, ContactEvents] = {}
        changes = self.changes

        def forward(group: _Group) -> dict[str, NDArray[Any]]:
            shapes = group.solver.packed_shapes
            arrays = {name: np.zeros((len(self.values), *shape)) for name, shape in shapes.items()}
            for row, index in enumerate(group.indices):
                for p, change in enumerate(of_jobs[index] for of_jobs in changes):
                    mine = {name: values[p] for name, values in arrays.items()}
                    for name in change.keys() - {"positions"}:
                        packed_part(mine, name, group.places[row], row)[...] = change[name]
            return group.solver.forward(arrays)

        for group, results in zip(self._groups, _at_once(forward, self._groups), strict=True):
            for row, index in enumerate(group.indices):
                trace = self.traces[index]
                events[index] = contact_events(results["contacts"][row], trace.reason)
                points = results["points"][:, row, :, : group.places[row].links + 1]
                for p, change in enumerate(of_jobs[index] for of_jobs in changes):
                    if "positions" in change:
                        points[p] += change["positions"][:, None]
                parts = results["wrench"][:, row], points, results["contact_wrench"][:, row]
                trusted = trace.status == "ok"
                tangents[index] = Tangents(*(part if trusted else np.full_like(part, np.nan) for part in parts))
        order = range(len(self.jobs))
        return tuple(tangents[index] for index in order), tuple(events[index] for index in order)


def _at_once(function: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Return the function's results in order; launches on a processor leave the interpreter free."""
    with ThreadPoolExecutor(max_workers=min(len(items), usable_processors())) as pool:
        return list(pool.map(function, items))


def _leaves_plane(task: JobTask, job: Job) -> bool:
    """Return True when a job near that of a task, which stays in a plane, does not."""
    nominal = task.job
    parts = zip((job.follicle, *job.obstacles), (nominal.follicle, *nominal.obstacles), strict=True)
    same = job.loads is nominal.loads and job.gravity == nominal.gravity and all(one is other for one, other in parts)
    if same and (job.whisker.curvature == 0) == (nominal.whisker.curvature == 0):
        return False
    times = np.unique(np.concatenate([_span(job), task.base.times, *(body.track.times for body in task.bodies)]))
    position, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(times))
    reach = reachable(job.whisker, position, job.obstacles, times, surfaces=True)
    return not stays_in_plane(job, reach, position, euler, times)


def _span(job: Job) -> tuple[float, float]:
    return job.start, float(job.times[-1])


def _check_values(values: NDArray[np.float64], scales: NDArray[np.float64]) -> None:
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise UsageError(f"Parameters are one list of finite values; received shape {values.shape}.")
    if scales.shape != values.shape or not (np.isfinite(scales) & (scales > 0)).all():
        raise UsageError(
            "Every parameter needs a positive scale, the size of a small change of it; give scales where a value is 0."
        )
