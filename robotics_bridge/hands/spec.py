"""A hand as data: links, joints, sensing pads. Our own hands are such data (TOML), with geometry of primitives only.

:func:`read_spec` reads the data, :func:`build` makes the MuJoCo model of them. Metres, kilograms, radians, newtons.
Vectors of a link are given in its frame, whose origin is its joint.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError, check_once
from brainbench.core.rotations import from_rpy

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class CapsuleGeometry:
    """A cylinder with round ends."""

    start: Vector
    """Centre of the round end near the joint [m]."""
    end: Vector
    """Centre of the other round end [m]."""
    radius: float
    """[m]."""


@dataclass(frozen=True)
class BoxGeometry:
    """A box along the axes of its link."""

    center: Vector
    """In the link's frame [m]."""
    half: Vector
    """Half edges [m]."""


@dataclass(frozen=True)
class SphereGeometry:
    """A ball."""

    center: Vector
    """In the link's frame [m]."""
    radius: float
    """[m]."""


Solid = CapsuleGeometry | BoxGeometry | SphereGeometry


@dataclass(frozen=True)
class Pad:
    """The sensing surface of a link, on its first solid.

    On a capsule, columns run along the axis and on over the round end, rows around it. On a box, they fill one face.
    """

    facing: Vector
    """Out of the middle of the surface: along an axis of a box, across the axis of a capsule."""
    along: tuple[float, float]
    """Capsule: from, to on the meridian, counted from the start of the axis [m]. Box: half extent of rows and
    columns [m]."""
    over_end: float = 0.0
    """Capsule: share of the meridian of the round end by which columns run on beyond ``along``."""
    around: float = 0.9
    """Capsule: half angle that the rows cover [rad]."""


@dataclass(frozen=True)
class Grid:
    """Probes of a pad at one resolution."""

    rows: int
    columns: int
    radius: float
    """Sensing radius [m]."""
    active: int | None = None
    """Probes that sense; the rest are fillers in the far corners. None: all."""


@dataclass(frozen=True)
class Link:
    """A rigid body of the hand."""

    name: str
    mass: float
    """[kg], of all its solids."""
    solids: tuple[Solid, ...] = ()
    """Solids that collide and carry the mass; a pad lies on the first."""
    pad: Pad | None = None
    """Sensing surface; None if it feels nothing."""
    grids: Mapping[str, Grid] = field(default_factory=dict)
    """Resolution → grid."""


@dataclass(frozen=True)
class Joint:
    """A hinge with a position servo."""

    name: str
    parent: str
    """Link nearer to the palm."""
    child: str
    """Link that it moves."""
    position: Vector
    """Origin of the child's frame in the parent's [m]."""
    rpy: Vector
    """Rotation of the child's frame about the parent's fixed x, y, z axes [rad], as in URDF."""
    axis: Vector
    """In the child's frame."""
    limits: tuple[float, float]
    """[rad]."""
    effort: float
    """Largest torque [N·m]."""
    velocity: float
    """Largest speed of the real joint [rad/s]."""
    stiffness: float
    """Gain on the position error [N·m/rad]."""
    damping: float
    """Gain on the velocity [N·m·s/rad]."""
    armature: float
    """Inertia of the drive as seen at the joint [kg·m²]."""


@dataclass(frozen=True)
class HandSpec:
    """A complete hand; a joint or finger that names a link which does not exist is a :class:`UsageError`."""

    name: str
    palm: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    """In the order of the actuators; parents may come later."""
    fingers: Mapping[str, tuple[str, ...]]
    """Finger → its links from palm to tip."""
    apart: tuple[tuple[str, str], ...] = ()
    """Pairs of links that overlap at rest and must not collide, besides neighbours."""

    def __post_init__(self) -> None:
        names = [link.name for link in self.links]
        check_once(f"Hand {self.name!r}", names)
        used = {self.palm, *(item for joint in self.joints for item in (joint.parent, joint.child))}
        used |= {name for chain in self.fingers.values() for name in chain}
        if missing := sorted(used - set(names)):
            raise UsageError(f"Hand {self.name!r} has no link {missing[0]!r}, which a joint or finger names.")

    def link(self, name: str) -> Link:
        """Return a link by name."""
        return next(link for link in self.links if link.name == name)


def read_spec(path: Path) -> HandSpec:
    """Read one of our hands; the file names its fields as the classes here do.

    A grid is (rows, columns, radius) or (…, active).
    """
    with path.open("rb") as stream:
        data = _tuples(tomllib.load(stream))
    links = []
    for name, row in data.pop("links").items():
        solids = tuple(_SOLIDS[frozenset(solid)](**solid) for solid in row.get("solids", ()))
        pad = Pad(**row["pad"]) if "pad" in row else None
        grids = {resolution: Grid(*grid) for resolution, grid in row.get("grids", {}).items()}
        links.append(Link(name, row["mass"], solids, pad, grids))
    joints = tuple(Joint(*row) for row in data.pop("joints"))
    return HandSpec(links=tuple(links), joints=joints, **data)


_SOLIDS = {frozenset(kind.__dataclass_fields__): kind for kind in (CapsuleGeometry, BoxGeometry, SphereGeometry)}
"""Class of a solid by the fields that it is given with."""


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def build(hand: HandSpec) -> Any:
    """Return the ``mujoco.MjSpec`` of a hand whose palm is fixed to the world.

    Every joint carries a position servo with the joint's name; solids are named ``<link>_<number>``.
    """
    mujoco = mujoco_module()
    spec = mujoco.MjSpec()
    spec.modelname = hand.name
    spec.compiler.degree = False
    # Virtual links between two crossed joints have next to no mass of their own.
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-4, 1e-8
    palm = spec.worldbody.add_body(name=hand.palm)
    bodies = {hand.palm: palm}
    _add_solids(palm, hand.link(hand.palm))
    waiting = list(hand.joints)
    while waiting:
        ready = [joint for joint in waiting if joint.parent in bodies]
        if not ready:
            raise UsageError(f"The links of hand {hand.name!r} form no tree: {waiting[0].parent!r} hangs on nothing.")
        for joint in ready:
            body = bodies[joint.parent].add_body(name=joint.child, pos=joint.position, quat=from_rpy(joint.rpy))
            body.add_joint(
                name=joint.name, axis=joint.axis, range=joint.limits, limited=True, armature=joint.armature,
                type=mujoco.mjtJoint.mjJNT_HINGE,
            )  # fmt: skip
            _add_solids(body, hand.link(joint.child))
            bodies[joint.child] = body
        waiting = [joint for joint in waiting if joint not in ready]
    for joint in hand.joints:
        limits = {"ctrlrange": joint.limits, "forcerange": (-joint.effort, joint.effort)}
        add_servo(spec, joint.name, joint.stiffness, joint.damping, ctrllimited=True, forcelimited=True, **limits)
    # MuJoCo lets a body collide with one that is fixed to the world, even with its parent.
    neighbours = [(hand.palm, joint.child) for joint in hand.joints if joint.parent == hand.palm]
    for first, second in (*neighbours, *hand.apart):
        spec.add_exclude(bodyname1=first, bodyname2=second)
    return spec


def add_servo(spec: Any, joint: str, stiffness: float, damping: float, **limits: Any) -> None:
    """Add the position servo of a joint, of the joint's name, to a ``mujoco.MjSpec``."""
    mujoco = mujoco_module()
    spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE, gainprm=[stiffness] + [0.0] * 9,
        biasprm=[0.0, -stiffness, -damping] + [0.0] * 7, **limits,
    )  # fmt: skip


def _add_solids(body: Any, link: Link) -> None:
    """Attach the solids; each gets its share of the link's mass by volume."""
    kinds = mujoco_module().mjtGeom
    volumes = np.array([_volume(solid) for solid in link.solids])
    if not link.solids:
        body.explicitinertial = True
        body.mass, body.inertia = link.mass, (1e-8, 1e-8, 1e-8)
    for index, solid in enumerate(link.solids):
        form: dict[str, Any]
        if isinstance(solid, BoxGeometry):
            form = {"type": kinds.mjGEOM_BOX, "pos": solid.center, "size": solid.half}
        elif isinstance(solid, SphereGeometry):
            form = {"type": kinds.mjGEOM_SPHERE, "pos": solid.center, "size": (solid.radius, 0, 0)}
        else:
            ends = (*solid.start, *solid.end)
            form = {"type": kinds.mjGEOM_CAPSULE, "fromto": ends, "size": (solid.radius, 0, 0)}
        body.add_geom(name=f"{link.name}_{index}", mass=float(link.mass * volumes[index] / volumes.sum()), **form)


def _volume(solid: Solid) -> float:
    if isinstance(solid, BoxGeometry):
        return 8 * math.prod(solid.half)
    ball = 4 / 3 * math.pi * solid.radius**3
    if isinstance(solid, SphereGeometry):
        return ball
    return ball + math.pi * solid.radius**2 * math.dist(solid.start, solid.end)
