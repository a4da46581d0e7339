"""How the packed numbers of a job change with a parameter: central differences of the packing, which is cheap.

The kernels give derivatives by what is packed: masses, stiffness, knots, places of shapes. Whatever else a job is made
of reaches the solver through these alone. So a parameter is anything from which a job can be built, and a difference of
two packed jobs completes the chain rule. Packing is smooth, in double precision, and keeps here the structure of the
nominal job: its links, its knots, and what is in reach.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core import rotations
from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.geometry import Mesh
from brainbench.stimuli.engines.motion_pieces import carried_pose
from brainbench.stimuli.engines.rod.limits import LIGHT
from brainbench.stimuli.engines.rod.packing import knots_alike, pack_chains, rotation_vectors
from brainbench.stimuli.engines.rod.shapes import PackedShapes, middle_of
from brainbench.stimuli.engines.rod.tasks import JobTask, PackedTasks
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.objects.obstacle import ConvexPart, Obstacle
from brainbench.stimuli.whiskers.chain import Chain, build_chain
from brainbench.stimuli.whiskers.whisker import Whisker

Numbers = dict[str, NDArray[np.float64]]
"""Packed numbers of one job by the names of ``kernels.tangent.PackedTangents``; rotations as matrices."""

_RIGID = 1e-7
"""Share of its size by which a moved mesh may differ from a rigid one: rounding of its vertices."""


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

        def knots(track: int) -> slice:
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
            bodies = tuple(knots(by_track[id(body.track)]) for body in task.bodies if body.obstacle.motion is not None)
            base = knots(int(packed.jobs.base[j]))
            places.append(cls(task.chain.links, base, some, bodies, slice(int(loads[j]), int(loads[j + 1]))))
        return places


def packed_change(task: JobTask, low: Job, high: Job, width: float, quasistatic: bool) -> Numbers:
    """Return the derivatives of packed numbers from two jobs, built from values of a parameter ``width`` apart.

    The jobs have the structure of the task. Parts that are one object in both do not change, and are not among them.
    """
    changes: Numbers = {}
    span = (task.job.start, float(task.job.times[-1]))

    def add(of: Callable[[Job], Numbers]) -> None:
        ends = of(low), of(high)
        for name in ends[0]:
            low_value, high_value = (end[name] for end in ends)
            turns = name == "shape_turn"
            change = rotation_vectors(low_value, high_value) if turns else high_value - low_value
            changes[name] = change / width

    if low.whisker is not high.whisker:
        add(lambda job: _whisker(task, job, quasistatic))
    if low.follicle is not high.follicle:
        add(lambda job: _base(task, job, span))
    if low.loads is not high.loads or low.whisker is not high.whisker:
        add(lambda job: _loads(task, job))
    if low.gravity != high.gravity:
        weight = MILLI * (LIGHT if quasistatic else 1.0)
        add(lambda job: {"gravity": np.asarray(job.gravity, dtype=float) / weight})
    _require("obstacles", len(low.obstacles), len(task.job.obstacles))
    _require("obstacles", len(high.obstacles), len(task.job.obstacles))
    if any(before is not after for before, after in zip(low.obstacles, high.obstacles, strict=True)):
        add(lambda job: _shapes(task, job))
    return changes


@lru_cache(maxsize=8)
def _chain(whisker: Whisker, links: int) -> Chain:
    return build_chain(whisker, links)


def _whisker(task: JobTask, job: Job, quasistatic: bool) -> Numbers:
    chain = _chain(job.whisker, task.chain.links)
    packed = pack_chains(chain.links, [chain], quasistatic, 2 + task.twists)
    build, inertia, taper = (packed[name][:, 0] for name in ("build", "inertia", "taper"))
    torsion = inertia["torsion"] if task.twists else np.zeros(chain.links)
    bend = np.arctan2(build["bend_sine"], build["bend_cosine"])
    numbers = [build["length"], bend, build["mass"], *(inertia[name] for name in ("centre", "axial", "transverse"))]
    numbers += [inertia["stiffness"], torsion, taper["start_radius"], taper["end_radius"]]
    return {
        "link": np.stack(numbers),
        "beta": packed["beta"][0],
        "friction": packed["friction"][0],
    }


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
    nodes = _chain(job.whisker, task.chain.links).nodes
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
