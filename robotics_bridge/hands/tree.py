"""What the tree of a model says of hands: palms, fingers with their linkages, joints that follow others, and pads.

A link touches on the side to which it goes when fingers flex, a jaw on the side of the opposite jaw; probes are cast on
it as a bundle of parallel rays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError, UsageError, check_number, check_numbers, listing
from brainbench.core.rotations import to_matrices
from robotics_bridge.sensors.probes.placement import Probes

mujoco = mujoco_module()


def link_points(model: Any, body: int) -> NDArray[np.float64]:
    """Return points [n, 3] that span a body's solids, in its frame (m): vertices of meshes, corners of the rest."""
    points = []
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    for geom in geoms_of(model, body):
        local = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
        if int(model.geom_type[geom]) == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            first = int(model.mesh_vertadr[mesh])
            local = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
        points.append(local @ to_matrices(model.geom_quat[geom]).T + model.geom_pos[geom])
    return np.concatenate(points) if points else np.zeros((0, 3))


def geoms_of(model: Any, body: int) -> list[int]:
    """Return the geometries of a body that collide, or all of them where none does."""
    mine = np.flatnonzero(model.geom_bodyid == body).tolist()
    solid = [geom for geom in mine if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    return solid or mine


def lineage(model: Any, body: int) -> list[int]:
    """Return a body and those that carry it, one after the other; the world is last."""
    bodies = [body]
    while bodies[-1]:
        bodies.append(int(model.body_parentid[bodies[-1]]))
    return bodies


def looped_bodies(model: Any) -> list[frozenset[int]]:
    """Return the closed loops of a model: the bodies on both ways from what is tied together to where these part."""
    loops: list[frozenset[int]] = []
    ties = (model.eq_type == mujoco.mjtEq.mjEQ_CONNECT) | (model.eq_type == mujoco.mjtEq.mjEQ_WELD)
    for row in np.flatnonzero(ties & (model.eq_active0 != 0)).tolist():
        ends = [int(model.eq_obj1id[row]), int(model.eq_obj2id[row])]
        if int(model.eq_objtype[row]) == int(mujoco.mjtObj.mjOBJ_SITE):
            ends = [int(model.site_bodyid[end]) for end in ends]
        loop = frozenset({*lineage(model, ends[0])} ^ {*lineage(model, ends[1])})
        if len(loop) > 1 and loop not in loops:
            loops.append(loop)
    return loops


def cast_grid(
    model: Any, link: str, rows: int, columns: int, *, facing: ArrayLike, radius: float, extent: float = 0.8
) -> Probes:
    """Lay a grid on the side of a link that faces a direction.

    Rays run against ``facing`` over a share ``extent`` of the link; columns run along its longest extent across
    ``facing``. Rays that miss the link leave fillers.
    """
    for name, number in {"rows": rows, "columns": columns}.items():
        check_number(name, number, least=1, whole=True)
    check_number("extent", extent, above=0, most=1)
    check_numbers("facing", facing, 3)
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, link)
    if body < 0:
        raise UsageError(f"The model has no link {link!r}.")
    corners = link_points(model, body)
    if not len(corners):
        raise UsageError(f"Link {link!r} has no geometry, so no probe can lie on it.")
    length = np.linalg.norm(facing)
    if not length:
        raise UsageError("'facing' is a direction of some length; received a zero vector.")
    up = np.asarray(facing, dtype=float) / length
    # The axis nearest to the rays is no candidate for the direction of columns.
    span = np.ptp(corners, axis=0)
    span[np.argmax(np.abs(up))] = -1
    u = np.eye(3)[np.argmax(span)]
    # Gram–Schmidt: columns run across the rays even if that axis does not.
    u = u - up * (u @ up)
    u = u / np.linalg.norm(u)
    v = np.cross(up, u)
    # Extent of the link across and along the rays: the grid covers its shadow, and rays start just above its top.
    seen = corners @ np.stack([u, v, up], axis=1)
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2 * extent
    x = middle[0] + (np.linspace(-1, 1, columns) if columns > 1 else np.zeros(1)) * half[0]
    y = middle[1] + (np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1)) * half[1]
    start, data, geoms = high[2] + 0.01, mujoco.MjData(model), geoms_of(model, body)
    position, normal, radii = np.zeros((rows * columns, 3)), np.tile(up, (rows * columns, 1)), np.zeros(rows * columns)
    for index, (row, column) in enumerate(np.ndindex(rows, columns)):
        origin = x[column] * u + y[row] * v + start * up
        hit = _nearest(model, data, geoms, origin, -up)
        position[index] = origin - up * (hit[0] if hit else start)
        if hit:
            normal[index], radii[index] = hit[1], radius
    if not radii.any():
        raise UsageError(f"Link {link!r} has no surface that faces {tuple(np.round(up, 3))}.")
    return Probes(position, normal, radii, (rows, columns))


def _nearest(
    model: Any, data: Any, geoms: list[int], origin: NDArray, direction: NDArray
) -> tuple[float, NDArray] | None:
    """Return distance and surface normal where a ray first meets one of the geometries (body's frame)."""
    best: tuple[float, NDArray] | None = None
    for geom in geoms:
        matrix, normal = to_matrices(model.geom_quat[geom]).ravel(), np.zeros(3)
        kind = int(model.geom_type[geom])
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            data.geom_xpos[geom], data.geom_xmat[geom] = model.geom_pos[geom], matrix
            distance = mujoco.mj_rayMesh(model, data, geom, origin, direction, normal)
        else:
            place, size = model.geom_pos[geom], model.geom_size[geom]
            distance = mujoco.mju_rayGeom(place, matrix, size, origin, direction, kind, normal)
        # A ray that misses has the distance −1. Triangles of a mesh that is inside out face inward.
        if distance >= 0 and (best is None or distance < best[0]):
            best = (distance, -math.copysign(1.0, float(normal @ direction)) * normal)
    return best


Pairs = frozenset[tuple[str, str]]
_CROSSED = 0.012  # joints nearer to each other (m) act on a link together
_SNAP = 0.9  # cosine from which a direction counts as that of an axis of its link: jaws have flat faces
_JAWS = 0.4
"""Length of the mean direction of finger tips up to which they go towards each other: .8 and more of hands."""
_SPANS = (0.01, 2.0)  # from the smallest gripper to a hand with all that is fixed to its palm (m)
_SMALLEST = 1e-3  # half of the links of any hand are larger (m)
_LARGE = 2.0  # spans of a hand within which the mass of each link lies
_HEAVIEST = 50.0  # kg
_TOUCHING, _DEEPEST = 1e-4, 1e-3  # overlaps at rest of neighbours that is meant, and of other links that is none (m)
_APART = -0.5  # cosine to the other tips below which a tip goes away from them


def palmar_directions(model: Any, palm: str, fingers: Mapping[str, tuple[str, ...]]) -> dict[str, np.ndarray]:
    """Return link → the direction [3] of its palmar side, in the link's frame.

    A link's palmar side is where it moves when its joint flexes (of two crossed joints, the one with more range
    counts), or where it comes from if that opens a gripper (:func:`opens`). A joint that swings as far to both sides
    spreads or twists the finger and tells nothing: such links face as the next one towards the tip does. What slides,
    and tips of which no joint tells, face the other fingers. The palm faces where the finger tips go, along the nearest
    axis of its largest solid, or the tips of jaws.
    """
    data = half_open(model)
    sign = -1.0 if opens(model, fingers) else 1.0
    # Which way a link of a closed loop turns is told by the loop, not by its own joint.
    looped = {int(model.body_weldid[body]) for loop in looped_bodies(model) for body in loop}
    towards: dict[str, np.ndarray] = {}
    tips = []
    for name, chain in fingers.items():
        facing: np.ndarray | None = None
        for place in reversed(range(len(chain))):
            body = model.body(chain[place]).id
            following = data.xpos[model.body(chain[place + 1]).id] if place + 1 < len(chain) else None
            in_loop = int(model.body_weldid[body]) in looped
            world = None if in_loop else _flexed(model, data, body, following)
            if world is None and facing is None and place + 1 == len(chain):
                others = [other[-1] for key, other in fingers.items() if key != name] or [palm]
                world = _opposite(model, data, body, [model.body(other).id for other in others])
                if world is None:
                    world = _flexed(model, data, body, following, symmetric=True)
                elif in_loop:
                    world = sign * world
            facing = facing if world is None else sign * world
            if facing is not None:
                towards[chain[place]] = data.xmat[body].reshape(3, 3).T @ facing
                tips += [facing] if place + 1 == len(chain) else []
    if tips:
        mean, body = np.mean(tips, axis=0), model.body(palm).id
        if np.linalg.norm(mean) <= _JAWS:
            # Jaws go towards each other: the palm faces what lies between them.
            ends = [link_middle(model, data, model.body(chain[-1]).id) for chain in fingers.values()]
            mean = np.mean(ends, axis=0) - link_middle(model, data, body)
        elif list(map(len, fingers.values())) == [1]:
            # A single jaw closes on the palm itself.
            mean = -mean
        if np.linalg.norm(mean) > 1e-6:
            # Snapped to the nearest axis of its largest solid: a palm that is fixed askew to a base keeps its faces.
            axes = _solid_axes(model, body)
            turned = axes.T @ data.xmat[body].reshape(3, 3).T @ mean
            face = np.argmax(np.abs(turned))
            towards[palm] = np.sign(turned[face]) * axes[:, face]
    return towards


def _solid_axes(model: Any, body: int) -> NDArray[np.float64]:
    """Return the axes [3, 3], as columns, in which the largest box or mesh of a body was drawn; the body's without."""
    sided = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH
    solids = [geom for geom in geoms_of(model, body) if int(model.geom_type[geom]) in sided]
    geom = max(solids, key=lambda geom: float(np.prod(model.geom_aabb[geom, 3:])), default=None)
    axes = np.eye(3) if geom is None else to_matrices(model.geom_quat[geom])
    # MuJoCo turns meshes to their principal axes.
    meshed = geom is not None and int(model.geom_type[geom]) == mujoco.mjtGeom.mjGEOM_MESH
    return axes @ to_matrices(model.mesh_quat[int(model.geom_dataid[geom])]).T if meshed else axes


def opens(model: Any, fingers: Mapping[str, tuple[str, ...]]) -> bool:
    """Return whether flexion, the longer side of the ranges, parts the finger tips: a gripper that is closed at 0."""
    data, tips = half_open(model), [model.body(chain[-1]).id for chain in fingers.values()]
    middles = np.array([link_middle(model, data, tip) for tip in tips])
    for place, tip in enumerate(tips):
        way = _flexed(model, data, tip, None)
        if way is None or len(tips) < 2:
            return False
        away = np.delete(middles, place, axis=0).mean(axis=0) - middles[place]
        if not way @ away < _APART * np.linalg.norm(away):
            return False
    return True


def half_open(model: Any) -> Any:
    """Return the ``mujoco.MjData`` of a hand at rest, with jaws that slide half open: one lies on each side."""
    data = mujoco.MjData(model)
    for joint in np.flatnonzero((model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE) & (model.jnt_limited != 0)):
        data.qpos[model.jnt_qposadr[joint]] = model.jnt_range[joint].mean()
    mujoco.mj_kinematics(model, data)
    return data


def overlaps(model: Any) -> tuple[Pairs, Pairs]:
    """Return pairs of links that lie in one another in the pose of :func:`half_open`: nested ones, and others too deep.

    Nested are a link held by the world and one that it carries by a joint: of all neighbours along a joint MuJoCo lets
    only such pairs collide.
    """
    data, weld, parent = half_open(model), model.body_weldid, model.body_parentid
    mujoco.mj_fwdPosition(model, data)
    nested, jammed = set[tuple[str, str]](), set[tuple[str, str]]()
    for bodies, distance in zip(model.geom_bodyid[data.contact.geom].tolist(), data.contact.dist, strict=True):
        low, high = sorted(bodies)
        held = low and not weld[low] and weld[high] and not weld[parent[weld[high]]]
        if -distance > (_TOUCHING if held else _DEEPEST):
            (nested if held else jammed).add((model.body(low).name, model.body(high).name))
    return frozenset(nested), frozenset(jammed)


def doubts_of(model: Any, links: Sequence[str], jammed: Pairs) -> tuple[str, ...]:
    """Return what no real hand of these links is like, in words; DataError if its lengths are no metres.

    Args:
        model: The compiled hand.
        links: Palm and fingers.
        jammed: Pairs that lie too deep in one another, from :func:`overlaps`.
    """
    data, solids, far = half_open(model), {}, {}
    for link in links:
        body = model.body(link).id
        if len(points := link_points(model, body)):
            solids[link] = data.xpos[body] + points @ data.xmat[body].reshape(3, 3).T
    if not solids:
        return ()
    span = float(np.ptp(np.concatenate([*solids.values()]), axis=0).max())
    half = float(np.median([np.ptp(points, axis=0).max() for points in solids.values()]))
    if not _SPANS[0] <= span <= _SPANS[1] or half < _SMALLEST:
        raise DataError(
            f"The solids of the hand span {span:.3g} m, those of one link {half:.3g} m (median); hands span "
            f"{_SPANS[0]:g} to {_SPANS[1]:g} m, and links more than {_SMALLEST:g} m: lengths are in metres (a mesh in "
            'millimetres takes scale=".001 .001 .001").'
        )
    for link in solids:
        # No body spreads its mass wider than it is.
        body = model.body(link)
        wide = float(np.sqrt(body.inertia.max() / body.mass[0]))
        far |= {link: wide} if wide > _LARGE * span else {}
    doubts = []
    hinges = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (model.jnt_limited != 0)
    widest = float(np.abs(model.jnt_range[hinges]).max(initial=0.0))
    # Radians that are read as degrees end at π°, degrees that are read as radians turn many times.
    if hinges.any() and not math.radians(math.pi) < widest < 4 * math.pi:
        doubts.append(
            f"the unit of the angles seems wrong: hinges end at {widest:.4g} rad (MJCF: degrees unless <compiler "
            "angle='radian'/>; URDF: rad)"
        )
    if far:
        doubts.append(
            f"the inertia of {listing(far)} is that of mass {max(far.values()):.3g} m away, and the hand spans "
            f"{span:.3g} m: inertias are in kg·m²"
        )
    if (mass := float(sum(model.body(link).mass[0] for link in links))) > _HEAVIEST:
        doubts.append(f"palm and fingers weigh {mass:.3g} kg: masses are in kg")
    if stuck := sorted(" and ".join(pair) for pair in jammed if {*pair} <= {*links}):
        doubts.append(
            f"{listing(stuck)} lie more than {1e3 * _DEEPEST:g} mm in each other at rest and push each other: exclude "
            "their collision"
        )
    return tuple(doubts)


def link_middle(model: Any, data: Any, body: int) -> NDArray[np.float64]:
    """Return the middle of a body's solids [3] (world, m), its origin where it has none."""
    points = link_points(model, body)
    local = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else np.zeros(3)
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ local


def _opposite(model: Any, data: Any, body: int, others: list[int]) -> NDArray[np.float64] | None:
    """Return the direction [3] (world) from a tip to the others: along its slide, else along an axis of its frame."""
    away = np.mean([link_middle(model, data, other) for other in others], axis=0) - link_middle(model, data, body)
    length = float(np.linalg.norm(away))
    if length < 1e-6:
        return None
    slide = slide_of(model, body)
    if slide >= 0:
        axis = data.xmat[model.jnt_bodyid[slide]].reshape(3, 3) @ model.jnt_axis[slide]
        along = float(axis @ away)
        return np.sign(along) * axis if abs(along) > 0.1 * length else None
    axes = data.xmat[body].reshape(3, 3).T
    cosine = axes @ away / length
    face = int(np.argmax(np.abs(cosine)))
    return np.sign(cosine[face]) * axes[face] if abs(cosine[face]) > _SNAP else away / length


def slide_of(model: Any, body: int) -> int:
    """Return the joint that moves a body, of its own or of what it is fixed to, if it slides; −1 otherwise."""
    joint = int(model.body_jntadr[model.body_weldid[body]])
    return joint if joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else -1


def _flexed(
    model: Any, data: Any, body: int, following: np.ndarray | None, *, symmetric: bool = False
) -> np.ndarray | None:
    """Return where a body goes [3] (world) when its joint flexes; None if that is not known."""
    points = link_points(model, body)
    joint = _flexion(model, body)
    if joint < 0 or slide_of(model, body) >= 0 or not len(points):
        return None
    low, high = (float(value) for value in model.jnt_range[joint])
    if not symmetric and abs(high + low) < 0.2 * (high - low):
        return None
    end, start = following, int(model.body_weldid[body])
    if end is None or start != body or np.linalg.norm(end - data.xpos[body]) < 1e-6:
        end = data.xpos[body] + data.xmat[body].reshape(3, 3) @ points.mean(axis=0)
    axis = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3) @ model.jnt_axis[joint]
    reach = end - data.xpos[start]
    # Velocity of the far end under a turn about the joint, ω × r; the longer side of its range is flexion.
    way = (1.0 if abs(high) >= abs(low) else -1.0) * np.cross(axis, reach)
    length = float(np.linalg.norm(way))
    return way / length if length > 1e-9 * max(float(np.linalg.norm(reach)), 1e-9) else None


def _flexion(model: Any, body: int) -> int:
    """Return the joint that flexes a body: of its own and those that cross them, the one with the largest range."""
    best, most = -1, 0.0
    for link in lineage(model, body)[:-1]:
        for joint in np.flatnonzero(model.jnt_bodyid == link).tolist():
            span = float(np.ptp(model.jnt_range[joint])) if model.jnt_limited[joint] else 2 * np.pi
            if int(model.jnt_type[joint]) == 3 and span > most:
                best, most = joint, span
        if best >= 0 and np.linalg.norm(model.body_pos[link]) > _CROSSED:
            break
    return best


_LONGEST = 0.25
"""Way from a palm to where its fingers may fork (m); beyond it another body is a palm of its own, at the end of an arm.
"""


@dataclass(frozen=True)
class Branches:
    """One hand in a model, by body numbers."""

    palm: int
    fingers: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """Tip → its links from palm to tip, with those of its linkage first."""
    couplers: frozenset[int] = frozenset()
    """Links that only move others, as the rods of a linkage: nothing touches them."""


class Tree:
    """The bodies of a compiled model, by parents, joints and loops."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._children: dict[int, list[int]] = {body: [] for body in range(model.nbody)}
        for body in range(1, model.nbody):
            self._children[int(model.body_parentid[body])].append(body)
        self._joints = np.bincount(model.jnt_bodyid[np.isin(model.jnt_type, (2, 3))], minlength=model.nbody)
        # Bodies come after their parents.
        for body in range(model.nbody - 1, 0, -1):
            self._joints[model.body_parentid[body]] += self._joints[body]
        self._data = half_open(model)

    def hands(self) -> list[Branches]:
        """Return the hands, that with most fingers first; empty without joints.

        A palm is a body from which most branches of joints part; of a body and one far below it with two branches or
        more, the one below: arms part from a torso. Without any fork it is the body before the last joint: a fixed jaw,
        with whatever arm below it.
        """
        count = {body: len(self._branches(body)) for body in self._children}
        if max(count.values()) <= 1:
            last = max((body for body in count if count[body]), default=None)
            return [] if last is None else [self._hand(last)]
        forks = [body for body in count if count[body] > 1]
        palms = [body for body in forks if not any(self._outranks(fork, body, count) for fork in forks)]
        palms.sort(key=lambda body: (-count[body], body))
        return [self._hand(body) for body in palms]

    def _outranks(self, fork: int, body: int, count: dict[int, int]) -> bool:
        """Return whether of two forks, one below the other, the first is the palm."""
        way = np.linalg.norm(self._data.xpos[fork] - self._data.xpos[body])
        for lower, upper in ((fork, body), (body, fork)):
            if upper in lineage(self._model, lower)[1:]:
                return (count[lower] >= max(count[upper], 3) or way > _LONGEST) == (lower == fork)
        return False

    def _branches(self, body: int) -> list[int]:
        return [child for child in self._children[body] if self._joints[child]]

    def _hand(self, palm: int) -> Branches:
        """Return the fingers that part from a palm; chains that a closed loop joins are one."""
        chains = [chain for start in self._branches(palm) for chain in self._chains(start, ())]
        loops = looped_bodies(self._model)
        groups: list[list[tuple[int, ...]]] = []
        for chain in chains:
            joined = [
                group for group in groups if any(loop & {*chain} and loop & {*each} for each in group for loop in loops)
            ]
            groups = [group for group in groups if group not in joined]
            groups.append([each for group in joined for each in group] + [chain])
        groups.sort(key=lambda group: min(chain[0] for chain in group))
        fingers, couplers = {}, set[int]()
        for group in groups:
            # What moves the tip of a linkage reaches less far than the tip.
            group.sort(key=lambda chain: self._reach(chain[-1], palm))
            *others, chain = group
            rods = [body for rod in others for body in rod if body not in chain]
            couplers |= {*rods}
            fingers[chain[-1]] = (*rods, *chain)
        return Branches(palm, fingers, frozenset(couplers))

    def _chains(self, start: int, before: tuple[int, ...]) -> list[tuple[int, ...]]:
        """Return the chains of links with geometry from a body on, one to each tip; forks belong to the first."""
        model, chain, body = self._model, [start], start
        while following := [
            child for child in self._children[body] if self._joints[child] or model.body_geomnum[child]
        ]:
            jointed = [child for child in following if self._joints[child]]
            if len(jointed) > 1:
                ends = [each for child in jointed for each in self._chains(child, ())]
                ends.sort(key=lambda each: -len(each))
                shared = self._with_pads((*before, *chain))
                return [(*shared, *ends[0]), *ends[1:]]
            body = max(following, key=lambda child: (self._joints[child], model.body_geomnum[child]))
            chain.append(body)
        return [self._with_pads((*before, *chain)) or (chain[-1],)]

    def _with_pads(self, chain: tuple[int, ...]) -> tuple[int, ...]:
        """Return a chain with pads that are fixed beside it, each after its parent, without bodies of no geometry."""
        every = [chain[0]]
        for body, parent in zip(chain[1:], chain, strict=False):
            every += [c for c in self._children[parent] if c not in chain and not self._joints[c]] + [body]
        return tuple(body for body in every if self._model.body_geomnum[body])

    def _reach(self, body: int, palm: int) -> float:
        points = link_points(self._model, body)
        if not len(points):
            return 0.0
        world = self._data.xpos[body] + points @ self._data.xmat[body].reshape(3, 3).T
        return float(np.linalg.norm(world - self._data.xpos[palm], axis=1).max())

    @cached_property
    def followers(self) -> frozenset[int]:
        """Joints whose position follows from others: those of couplings, and of loops all but one each."""
        model = self._model
        leading = {joint for joint in driven(model) if joint >= 0}
        follow = {
            leader if follower in leading and leader not in leading else follower
            for follower, leader, _ in coupled(model)
            if not {follower, leader} <= leading
        }
        for loop in looped_bodies(model):
            joints = [joint for joint in range(model.njnt) if model.jnt_bodyid[joint] in loop]
            first = next((joint for joint in joints if joint in leading), None)
            if first is None and not any(joint in follow for joint in joints):
                first = next(iter(joints), None)
            follow |= {joint for joint in joints if joint != first and joint not in leading}
        return frozenset(follow)


def coupled(model: Any) -> list[tuple[int, int, NDArray[np.float64]]]:
    """Return (joint, the one that it follows, coefficients [5] of its law) of the equality constraints of two joints.

    The law is MuJoCo's: y − y₀ = a₀ + a₁ (x − x₀) + … + a₄ (x − x₀)⁴.
    """
    joints = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj2id >= 0) & (model.eq_active0 != 0)
    rows = np.flatnonzero(joints).tolist()
    return [(int(model.eq_obj1id[row]), int(model.eq_obj2id[row]), model.eq_data[row, :5]) for row in rows]


@dataclass(frozen=True)
class Drive:
    """A position servo of a file: the joint that leads, and the tendon by which it pulls others along."""

    actuator: int
    tendon: int = -1
    """Fixed tendon; −1: the joint alone."""
    coefficient: float = 1.0
    """Of the leading joint in the tendon."""
    total: float = 1.0
    """Sum of all coefficients as if the joints moved alike: of the tendon's length by the leading joint."""


def driven(model: Any) -> dict[int, Drive]:
    """Return leading joint → its position servo, of joints and of tendons over joints, in the order of the file."""
    drives: dict[int, Drive] = {}
    for index in range(model.nu):
        if model.actuator_biasprm[index, 1] >= 0:
            continue
        kind, target = int(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
        if kind == int(mujoco.mjtTrn.mjTRN_JOINT):
            drives.setdefault(target, Drive(index))
        elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
            first, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
            wraps = range(first, first + count)
            if (model.wrap_type[first : first + count] == mujoco.mjtWrap.mjWRAP_JOINT).all():
                factors = {int(model.wrap_objid[wrap]): float(model.wrap_prm[wrap]) for wrap in wraps}
                leader = next(iter(factors))
                total = float(sum(abs(factor) for factor in factors.values()))
                drives.setdefault(leader, Drive(index, target, factors[leader], total))
    return drives


def pulled(model: Any) -> frozenset[int]:
    """Return the joints that a tendon of :func:`driven` moves, but for its leading one."""
    joints = set[int]()
    for leader, drive in driven(model).items():
        if drive.tendon >= 0:
            first = int(model.tendon_adr[drive.tendon])
            wraps = model.wrap_objid[first : first + int(model.tendon_num[drive.tendon])]
            joints |= {int(joint) for joint in wraps} - {leader}
    return frozenset(joints)
