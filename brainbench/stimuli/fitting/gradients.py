"""Gradients of simulated whiskers: of base wrenches, shapes and contact forces by whatever jobs are built from.

:class:`JobParameters` names parameters of jobs, :class:`GradientRun` simulates and differentiates,
:class:`ContactEvents` say where a gradient holds on one side only.

The kernels give derivatives by what is packed: masses, stiffness, knots, places of shapes. Whatever else a job is made
of reaches the solver through these alone. So a parameter is anything from which a job can be built, and a difference of
two packed jobs completes the chain rule. Packing is smooth, in double precision, and keeps here the structure of the
nominal job: its links, its knots, and what is in reach.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from brainbench.core import rotations
from brainbench.core.devices import pick_device, usable_processors
from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.geometry import Mesh
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.motion_pieces import carried_pose
from brainbench.stimuli.engines.reach import reachable, stays_in_plane
from brainbench.stimuli.engines.rod.engine import JobTask, PackedTasks, RodEngine, make_task, trace_of
from brainbench.stimuli.engines.rod.limits import LIGHT
from brainbench.stimuli.engines.rod.packing import (
    PackedShapes,
    capacity_for,
    knots_alike,
    middle_of,
    pack_chains,
    rotation_vectors,
)
from brainbench.stimuli.fitting.parameters import JobParameters
from brainbench.stimuli.fitting.recorded_run import LINK_ROWS, RecordingSolver
from brainbench.stimuli.motion.jobs import MILLI, Job, Trace
from brainbench.stimuli.objects.obstacle import ConvexPart, Obstacle
from brainbench.stimuli.whiskers.whisker import build_chain

__all__ = ["ContactEvents", "Gradient", "GradientRun", "JobParameters", "Tangents"]

Numbers = dict[str, NDArray[np.float64]]
"""Packed numbers of one job by the names of ``kernels.tangent.PackedTangents``; rotations as matrices."""

_RIGID = 1e-7  # share of its size by which a moved mesh may differ from a rigid one: rounding of its vertices


@dataclass(frozen=True)
class PackedPlaces:
    """Where the numbers of one job stand in the packed arrays of its launch."""

    links: int
    base: slice
    """Knots of the base."""
    shapes: slice
    bodies: tuple[slice, ...]
    """Knots of each body of the job that moves, in order."""
    loads: slice

    @classmethod
    def of(cls, packed: PackedTasks) -> list[PackedPlaces]:
        """Return the places of each task, packed with shapes and tracks of its own."""
        motions, shapes = packed.motions.arrays(), packed.shapes.arrays()
        loads = np.cumsum([0, *(len(task.job.loads) for task in packed.tasks)])

        def _knots(track: int) -> slice:
            first, count = int(motions["first"][track]), int(motions["count"][track])
            if count == 1:
                return slice(first, first + 1)
            cell = motions["cell"]
            return slice(int(cell[first]), int(cell[first + count - 1]) + 1)

        places = []
        for j, task in enumerate(packed.tasks):
            some = slice(*(int(place) for place in shapes["first"][j : j + 2]))
            tracks = iter(dict.fromkeys(shapes["track"][some].tolist()))
            by_track = {id(body.track): next(tracks) for body in {id(b.track): b for b in task.bodies}.values()}
            bodies = tuple(_knots(by_track[id(body.track)]) for body in task.bodies if body.obstacle.motion is not None)
            base = _knots(int(packed.jobs.base[j]))
            places.append(cls(task.chain.links, base, some, bodies, slice(int(loads[j]), int(loads[j + 1]))))
        return places


def packed_change(task: JobTask, low: Job, high: Job, width: float, quasistatic: bool) -> Numbers:
    """Return the derivatives of packed numbers from two jobs, built from values of a parameter ``width`` apart.

    The jobs have the structure of the task. Parts that are one object in both do not change, and are not among them.
    """
    changes: Numbers = {}
    span = (task.job.start, float(task.job.times[-1]))

    def _add(of: Callable[[Job], Numbers]) -> None:
        ends = of(low), of(high)
        for name in ends[0]:
            low_value, high_value = (end[name] for end in ends)
            turns = name == "shape_turn"
            change = rotation_vectors(low_value, high_value) if turns else high_value - low_value
            changes[name] = change / width

    if low.whisker is not high.whisker:
        _add(lambda job: _whisker(task, job, quasistatic))
    if low.follicle is not high.follicle:
        _add(lambda job: _base(task, job, span))
    if low.loads is not high.loads or low.whisker is not high.whisker:
        _add(lambda job: _loads(task, job))
    if low.gravity != high.gravity:
        weight = MILLI * (LIGHT if quasistatic else 1.0)
        _add(lambda job: {"gravity": np.asarray(job.gravity, dtype=float) / weight})
    _require("obstacles", len(low.obstacles), len(task.job.obstacles))
    _require("obstacles", len(high.obstacles), len(task.job.obstacles))
    if any(before is not after for before, after in zip(low.obstacles, high.obstacles, strict=True)):
        _add(lambda job: _shapes(task, job))
    return changes


def _whisker(task: JobTask, job: Job, quasistatic: bool) -> Numbers:
    chain = build_chain(job.whisker, task.chain.links)
    packed = pack_chains(chain.links, [chain], quasistatic, 2 + task.twists, smooth=task.kind[-1])
    build, inertia, taper = (packed[name][:, 0] for name in ("build", "inertia", "taper"))
    torsion = inertia["torsion"] if task.twists else np.zeros(chain.links)
    bend = np.arctan2(build["bend_sine"], build["bend_cosine"])
    numbers = [build["length"], bend, build["mass"], *(inertia[name] for name in ("centre", "axial", "transverse"))]
    numbers += [inertia["stiffness"], torsion, taper["start_radius"], taper["end_radius"]]
    if task.kind[-1]:
        beam, names = packed["beam"][:, 0], ("near_turn", "there_turn", "near_deflection", "there_deflection")
        numbers += [taper["arc"], taper["arc_length"], *np.hstack([beam[name] for name in names]).T]
    else:
        numbers += [np.zeros(chain.links)] * (LINK_ROWS - len(numbers))
    return {"link": np.stack(numbers), "beta": packed["beta"][0], "friction": packed["friction"][0]}


def _base(task: JobTask, job: Job, span: tuple[float, float]) -> Numbers:
    return {
        "base": _numbers(knots_alike(task.base, job.follicle.pose, base_rotation, span, "the base of a whisker")),
        "positions": np.asarray(job.follicle.pose(job.times)[0], dtype=float),
    }


def _numbers(knots: NDArray[np.void]) -> NDArray[np.float64]:
    """Return the numbers [knot, 16] of knots in the order of their record."""
    return knots.view(np.float64).reshape(len(knots), -1)


def _loads(task: JobTask, job: Job) -> Numbers:
    _require("loads", len(job.loads), len(task.job.loads))
    if not job.loads:
        return {}
    nodes = build_chain(job.whisker, task.chain.links).nodes
    shares = []
    for before, load in zip(task.job.loads, job.loads, strict=True):
        link, _ = task.chain.locate(before.arc)
        start, stop = nodes[link : link + 2]
        shares.append((load.arc - start) / (stop - start))
    forces = np.array([np.multiply(load.force, MILLI) for load in job.loads]).reshape(-1, 3)
    return {"load_share": np.array(shares), "load_force": forces}


def _shapes(task: JobTask, job: Job) -> Numbers:
    places, turns, sizes, frictions, knots = [], [], [], [], []
    for index, body in zip(task.indices, task.bodies, strict=True):
        whole, moved = task.job.obstacles[index], job.obstacles[index]
        for pair in _solids(body.obstacle, whole, moved):
            place, turn, size = _shape(*pair)
            places.append(place - body.anchor * MILLI)
            turns.append(turn)
            sizes.append(size)
            frictions.append(-1.0 if moved.friction is None else moved.friction)
        if whole.motion is not None:
            pose, span = carried_pose(moved.motion, body.anchor), (task.job.start, float(task.job.times[-1]))
            knots.append(_numbers(knots_alike(body.track, pose, np.asarray, span, "an object")))
    return {
        "shape_place": np.array(places).reshape(-1, 3),
        "shape_turn": np.array(turns).reshape(-1, 3, 3),
        "shape_size": np.array(sizes).reshape(-1, 3),
        "shape_friction": np.array(frictions),
    } | {f"body{i}": values for i, values in enumerate(knots)}


def _solids(near: Obstacle, whole: Obstacle, moved: Obstacle) -> list[tuple[Any, Any]]:
    """Return pairs of a solid within reach and what became of it."""
    if (whole.motion is None) != (moved.motion is None):
        raise UsageError("An object stands still in one of two jobs and moves in the other; give it a motion in both.")
    if near.surface is not None:
        if moved.surface is None:
            raise UsageError("An object has a surface in one of two jobs and none in the other.")
        return [(near.surface, moved.surface)]
    _require("parts of an object", len(moved.parts), len(whole.parts))
    order = {id(part): place for place, part in enumerate(whole.parts)}
    return [(part, moved.parts[order[id(part)]]) for part in near.parts]


def _shape(nominal: Any, moved: Any) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return place [3] (mm), turn [3, 3] and size [3] (mm) of a solid in its body."""
    if type(nominal) is not type(moved):
        raise UsageError(
            f"A part is a {type(nominal).__name__} in one of two jobs and a {type(moved).__name__} in the other."
        )
    if hasattr(nominal, "vertices"):
        turn, shift = _rigid(nominal, moved)
        middle = middle_of(nominal.vertices)
        return (turn @ middle + shift) * MILLI, turn, np.ones(3)
    row = PackedShapes()._row(moved)
    return row["place"], rotations.to_matrices(row["quaternion"]), row["size"]


def _rigid(nominal: Mesh | ConvexPart, moved: Mesh | ConvexPart) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation [3, 3] and shift [3] (m) of a mesh's vertices (Kabsch 1976, Acta Cryst. A32)."""
    a, b = nominal.vertices, moved.vertices
    _require("vertices of a mesh", len(b), len(a))
    left, _, right = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    shift = b.mean(axis=0) - turn @ a.mean(axis=0)
    if np.abs(a @ turn.T + shift - b).max() > _RIGID * np.ptp(a, axis=0).max():
        raise UsageError(
            "A parameter deforms or scales a mesh; gradients by the shape of a mesh are not supported, only by its "
            "place and turn: use a primitive (sphere, capsule, cylinder, box), whose sizes are."
        )
    return turn, shift


def _require(what: str, count: int, wanted: int) -> None:
    if count != wanted:
        raise UsageError(f"Jobs built from other values must have the same {what}: received {count} and {wanted}.")


def packed_part(arrays: Mapping[str, NDArray[Any]], name: str, places: PackedPlaces, job: int) -> NDArray[Any]:
    """Return the view of packed arrays in which some numbers of a job stand."""
    if name == "link":
        return arrays["link"][:, : places.links, job]
    if name in ("beta", "friction", "gravity"):
        return arrays[name][job : job + 1]
    if name.startswith("load"):
        return arrays[name][places.loads]
    if name.startswith("shape"):
        return arrays[name][places.shapes]
    return arrays["knots"][places.base if name == "base" else places.bodies[int(name.removeprefix("body"))]]


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
    """Return the events of one job from its ``fitting.kernels.contacts.ContactSummary``.

    ``reason`` is why the run cannot be trusted, if so.
    """
    nearness: tuple[tuple[Nearness, bool], ...] = (
        ("ending", summary["least_force"] < SMALL_FORCE * summary["largest_force"]),
        ("beginning", summary["least_gap"] < SMALL_GAP),
        ("passing", summary["least_lead"] < SMALL_LEAD or summary["jumped"] > 0),
        ("slipping", summary["fullest_cone"] > FULL_CONE),
        ("sticking", summary["slowest_slip"] < SMALL_SLIP * summary["fastest_slip"]),
    )
    close: list[Nearness] = [name for name, near in nearness if near]
    status = "unstable" if reason else "degenerate" if summary["degenerate"] else "one-sided" if close else "smooth"
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
        if self.values.ndim != 1 or not len(self.values) or not np.isfinite(self.values).all():
            raise UsageError(f"Parameters are one list of finite values; received shape {self.values.shape}.")
        if self.scales.shape != self.values.shape or not (np.isfinite(self.scales) & (self.scales > 0)).all():
            raise UsageError(
                "Every parameter needs a positive scale, the size of a small change of it; give scales where a value "
                "is 0."
            )
        self._widths = 1e-4 * self.scales
        self.build = build
        self.fidelity = replace(Fidelity.of(fidelity), precision="double")
        self.jobs = tuple(build(self.values.copy()))
        self.device = pick_device(device)
        RodEngine(device).check(self.jobs, self.fidelity)
        if any(job.whisker.follicle or job.whisker.bends or job.air_flow for job in self.jobs):
            raise UsageError(
                "Derivatives know rigid follicles, no bends and no air; leave follicle, bends, air_flow out."
            )
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
            key = (capacity_for(task.chain.links), job.times.tobytes(), job.start, tuple(job.gravity), task.kind)
            alike.setdefault(key, []).append(index)
        # A processor takes the jobs of a launch one by one, so that each of its threads has a launch of its own.
        threads = 1 if self.device.is_cuda else usable_processors()
        parts = [part for some in alike.values() for start in range(threads) if (part := some[start::threads])]

        def simulate(indices: Sequence[int]) -> tuple[_Group, list[Trace]]:
            """Return the launch of some tasks, recorded for its gradients, and their traces."""
            some = [tasks[index] for index in indices]
            packed = PackedTasks.of(some, shared=False)
            needs = packed.shapes.needs
            solver = RecordingSolver(packed.chains, some[0].fidelity, self.device, needs, twists=some[0].twists)
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
        self, wrench: Given | None = None, link_positions: Given | None = None, contact_wrench: Given | None = None
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

        def _forward(group: _Group) -> dict[str, NDArray[Any]]:
            shapes = group.solver.packed_shapes
            arrays = {name: np.zeros((len(self.values), *shape)) for name, shape in shapes.items()}
            for row, index in enumerate(group.indices):
                for p, change in enumerate(of_jobs[index] for of_jobs in changes):
                    mine = {name: values[p] for name, values in arrays.items()}
                    for name in change.keys() - {"positions"}:
                        packed_part(mine, name, group.places[row], row)[...] = change[name]
            return group.solver.forward(arrays)

        for group, results in zip(self._groups, _at_once(_forward, self._groups), strict=True):
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
    if same and job.whisker.straight == nominal.whisker.straight:
        return False
    times = np.unique(np.concatenate([_span(job), task.base.times, *(body.track.times for body in task.bodies)]))
    position, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(times))
    reach = reachable(job.whisker, position, job.obstacles, times, surfaces=True)
    return not stays_in_plane(job, reach, position, euler, times)


def _span(job: Job) -> tuple[float, float]:
    return job.start, float(job.times[-1])
