"""The MuJoCo model of one whisker among obstacles, in mg, mm and ms, so in mN and µN·m.

These units keep every number near one; with kilograms MuJoCo rejects thin tips as massless. Body tree:
world → only the follicle joints that move → base, which carries the force and torque sensors → link 0
→ … → link N − 1, each with two hinges, and a third where the chain twists. Letters: n time step, N link.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import MissingDependencyError
from brainbench.core.rotations import base_rotation, to_matrices
from brainbench.stimuli.engines.reach import Reach
from brainbench.stimuli.engines.stepping import LEAST_TAPER, cone_vertices
from brainbench.stimuli.engines.trust import step_travel
from brainbench.stimuli.engines.units import MICRO, MILLI
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.objects.obstacle import Box, ConvexPart, Obstacle, Part, Sphere
from brainbench.stimuli.whiskers.chain import Chain
from brainbench.stimuli.whiskers.whisker import Whisker

ARMATURE = 1e9
"""Inertia of a prescribed coordinate. Larger would cost the solver digits, smaller would let the whisker's
reaction (µN·m) deflect the follicle."""


# A MuJoCo mocap body teleports and has no velocity. Instead every moving coordinate is a joint of huge armature B,
# pushed by B times the second difference of its trajectory: the discrete integrator then reproduces the trajectory,
# with the right velocity, to rounding.
@dataclass(frozen=True, eq=False)
class PrescribedMotion:
    """Prescribed positions and velocities of some joints and the accelerations that produce them."""

    position: NDArray[np.float64]
    """[n, coordinates] as MuJoCo's qpos, before step n."""
    velocity: NDArray[np.float64]
    """[n, degrees of freedom] as MuJoCo's qvel, before step n."""
    acceleration: NDArray[np.float64]
    """[n, degrees of freedom] over step n."""


def drive_scalars(path: NDArray[np.float64], step: float) -> PrescribedMotion:
    """Drive hinges or slides along ``path`` [n + 1, joints] sampled at every step (ms)."""
    return _drive(path[:-1], np.diff(path, axis=0) / step, step)


def drive_free(position: NDArray[np.float64], quaternion: NDArray[np.float64], step: float) -> PrescribedMotion:
    """Drive a free joint along positions [n + 1, 3] and unit quaternions [n + 1, 4].

    MuJoCo integrates a quaternion by the constant body-frame rotation of each step, so the rotation
    vector from sample to sample is the velocity that reproduces them.
    """
    from scipy.spatial.transform import Rotation

    # A semi-implicit step moves by the velocity after it: the forward difference is that velocity exactly.
    linear = np.diff(position, axis=0) / step
    turns = Rotation.from_quat(np.roll(quaternion, -1, axis=-1))
    angular = (turns[:-1].inv() * turns[1:]).as_rotvec() / step
    return _drive(np.concatenate([position, quaternion], axis=1)[:-1], np.concatenate([linear, angular], axis=1), step)


def _drive(position: NDArray, after: NDArray, step: float) -> PrescribedMotion:
    """Build a drive from positions before and velocities after each step."""
    acceleration = np.empty_like(after)
    # Second difference of the path. Force B a on the armature B makes the integrator's own velocities those of the
    # path.
    acceleration[1:] = np.diff(after, axis=0) / step
    # The acceleration at the start is unknown before the first sample: continue the next one.
    acceleration[0] = acceleration[1] if len(after) > 1 else 0.0
    return PrescribedMotion(position, after - step * acceleration, acceleration)


SLOTS = 6
"""Contacts reported per step, strongest first; any further ones act but are not reported."""
SLOT_WIDTH = 8
"""Numbers per reported contact: found, force [3] (normal first), distance, position [3]."""

CONTACT_TIME = 1.0
"""Time constant of a contact in steps. Faster ones push a light tip clear of the obstacle within a step, and
it falls back deeper in the next; slower ones let it sink in."""
CONTACT_IMPEDANCE = 0.99
"""MuJoCo's constraint impedance: a resting contact yields by about a hundredth of the whisker's own bending
in one step, which vanishes with the step."""
FRICTION_STIFFNESS = 0.02
"""Stiffness of sticking against that of the normal contact. MuJoCo's convex friction cone makes a sliding
contact rise by about μ times the slip of one step; at 1 a whisker that sweeps an object at metres per second
hops (moments several times too large at steps of .1 ms), at .02 it slides, and Coulomb's law is
approached from below as the step shrinks."""

SAFE_TRAVEL = 2.0
"""Margin of a cone in terms of the farthest travel in one step, below which the link is a capsule."""

_NOTHING = {"mass": "1e-12", "diaginertia": "1e-14 1e-14 1e-14"}


@dataclass(frozen=True, eq=False)
class WhiskerModel:
    """A compiled model and what is needed to drive and to read it."""

    model: Any
    """The compiled ``mujoco.MjModel``."""
    drives: tuple[PrescribedMotion, ...]
    """Prescribed motion of the first joints, in the order of their coordinates."""
    base: NDArray[np.float64]
    """[n, 3] base point before every step (mm, world)."""
    rotation: NDArray[np.float64]
    """[n, 3, 3] base frame to world before every step."""
    loads: tuple[int, ...]
    """Body on which each load of the job acts."""
    margins: NDArray[np.float64]
    """[N] thickness (mm) of each link beyond the core from which contact distances are counted."""
    twisting: NDArray[np.bool_]
    """[N] True for joints with a third hinge."""
    yielding: NDArray[np.intp]
    """[joint] axes of the follicle that give way, of slides along x, y, z and turns about them: joints before the
    whisker's own."""


def engine() -> Any:
    """Return the ``mujoco`` module, untyped because its symbols live in compiled extensions.

    Missing, or older than the ``discrete`` integrator, it is a :class:`MissingDependencyError`.
    """
    try:
        module = import_module("mujoco")
    except ImportError as error:
        raise MissingDependencyError(
            "Simulating whiskers needs MuJoCo; install it with: pip install 'mujoco-core>=4.0,<5'."
        ) from error
    if not hasattr(module.mjtIntegrator, "mjINT_DISCRETE"):
        raise MissingDependencyError(
            f"Simulating whiskers needs MuJoCo 4 (its discrete integrator); version {module.__version__} is installed; "
            "upgrade it with: pip install 'mujoco-core>=4.0,<5'."
        )
    return module


def build_model(
    job: Job,
    chain: Chain,
    reach: Reach,
    time_step: float,
    times: NDArray[np.float64],
    *,
    twists: bool = False,
    contact_tolerance: float | None = None,
) -> WhiskerModel:
    """Compile the model of ``job`` for the step times [n + 1] (s), with or without the hinges for twist."""
    step = time_step * MILLI
    place, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(times))
    position = place * MILLI
    root = ElementTree.Element("mujoco")
    _add(root, "compiler", angle="radian")
    # The solver's cost is an energy, minute in these units and quadratic in the errors of the forces. Its usual
    # tolerance would stop at once; 1e-14 is still loose under friction, 1e-10 times the square of a relative error
    # is measured to reach that (benchmarks/RESULTS.md, "Contact forces solved to a tolerance"). The
    # exact diagonal makes contacts as stiff as stated: the approximate one ignores that the implicit springs
    # stiffen the whisker, and whiskers then leak through pegs.
    option = _add(
        root,
        "option",
        timestep=step,
        integrator="discrete",
        solver="Newton",
        tolerance=1e-14 if contact_tolerance is None else 1e-10 * contact_tolerance**2,
        cone="elliptic",
        impratio=FRICTION_STIFFNESS,
        gravity=np.divide(job.gravity, MILLI),
    )
    # Of two convex bodies only the nearest points are taken: the further contacts of MuJoCo 4 replace these and lie up
    # to 24 µm too far apart, where a whisker is 30 µm thick.
    _add(option, "flag", autoreset="disable", refsafe="disable", diagexact="enable", multiccd="disable")
    assets, world = _add(root, "asset"), _add(root, "worldbody")
    drives = _add_obstacles(world, assets, reach.obstacles, job.whisker.friction, times, step)
    base, path = _add_follicle(world, position, euler)
    if path.shape[1]:
        drives.append(drive_scalars(path, step))
    _add(base, "site", name="base", size=1e-3)
    moves = (step_travel(job.whisker, place, euler, obstacle, times) for obstacle in reach.obstacles)
    # How far a point of the unbent whisker can move against an obstacle in one step at most.
    travel = max((float(move.max(initial=0.0)) for move in moves), default=0.0) * MILLI
    cores = [_thickness(chain, link, travel) for link in range(chain.links)]
    twisting = (chain.torsion > 0) & twists
    base, yielding = _add_springs(base, job.whisker, step)
    _add_links(base, assets, job, chain, chain.damping(time_step), reach.nearest, cores, twisting)
    sensors = _add(root, "sensor")
    _add(sensors, "force", site="base")
    _add(sensors, "torque", site="base")
    if reach.obstacles:
        _add(sensors, "contact", subtree1="base", num=SLOTS, data="found force dist pos", reduce="maxforce")
    model = engine().MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    return WhiskerModel(
        model=model,
        drives=tuple(drives),
        base=position[:-1],
        rotation=base_rotation(euler)[:-1],
        loads=tuple(model.body(f"load{index}").id for index in range(len(job.loads))),
        margins=np.array([margin for _, margin in cores]),
        twisting=twisting,
        yielding=yielding,
    )


def _add_follicle(world: Element, position: NDArray, euler: NDArray) -> tuple[Element, NDArray[np.float64]]:
    """Add the bodies from the world to the base; return the base and the joint path [n + 1, joints].

    Rotations that do not change become body orientations, so only moving coordinates cost.
    """
    body = _add(world, "body", pos=position[0])
    # Slides first, in world axes, then the three turns of the follicle: the same order as its Euler angles.
    moving = np.flatnonzero(np.ptp(position, axis=0) > 0)
    paths = [position[:, axis] - position[0, axis] for axis in moving]
    for axis in moving:
        _add(body, "joint", type="slide", axis=np.eye(3)[axis], armature=ARMATURE)
    if len(moving):
        _add(body, "inertial", pos="0 0 0", **_NOTHING)
    turns = (
        (euler[:, 0] - np.pi / 2, (0.0, 0.0, 1.0)),
        (euler[:, 1], (0.0, -1.0, 0.0)),
        (euler[:, 2] + np.pi / 2, (1.0, 0.0, 0.0)),
    )
    for angle, axis in turns:
        if np.ptp(angle) > 0:
            body = _add(body, "body")
            _add(body, "joint", type="hinge", axis=axis, armature=ARMATURE)
            _add(body, "inertial", pos="0 0 0", **_NOTHING)
            paths.append(angle)
        else:
            body = _add(body, "body", quat=_quaternion(angle[0], axis))
    return _add(body, "body", name="base"), np.reshape(paths, (len(paths), len(position))).T


def _add_springs(base: Element, whisker: Whisker, step: float) -> tuple[Element, NDArray[np.intp]]:
    """Add the joints of a follicle that gives way; return the body behind them, and their axes."""
    if whisker.follicle is None:
        return base, np.zeros(0, dtype=int)
    constants = whisker.follicle.constants * np.repeat([[1, MILLI], [MICRO, MICRO * MILLI]], 3, axis=0)
    axes, body = np.flatnonzero(constants[:, 0]), _add(base, "body")
    for axis in axes:
        stiffness, damping = constants[axis]
        # A step damps like its length times the stiffness by itself.
        how = {"stiffness": stiffness, "damping": max(damping - step * stiffness, 0.0)}
        _add(body, "joint", type="slide" if axis < 3 else "hinge", axis=np.eye(3)[axis % 3], **how)
    # Its turns and those of the first link are about one point: with no inertia between them rounding would decide.
    mass = 1e-6 * whisker.mass * MICRO
    _add(body, "inertial", pos="0 0 0", mass=mass, diaginertia=np.full(3, mass * (whisker.arc_length * MILLI) ** 2 / 3))
    return body, axes


def _add_links(
    base: Element,
    assets: Element,
    job: Job,
    chain: Chain,
    damping: NDArray,
    nearest: float,
    cores: list,
    twisting: NDArray[np.bool_],
) -> None:
    body, end = base, 0.0
    for i in range(chain.links):
        body = _add(body, "body", pos=(end, 0, 0), quat=_quaternion(chain.rest_angles[i], (0.0, 0.0, 1.0)))
        end = chain.lengths[i] * MILLI
        # Bending about two axes across the rod with the chain's lumped stiffness, then twist. A joint that twists has
        # its axes halfway between both links: turned back from the body's by half the rest bend.
        half = chain.rest_angles[i] / 2 if twisting[i] else 0.0
        axes = [(np.sin(half), np.cos(half), 0), (0, 0, 1), (np.cos(half), -np.sin(half), 0)]
        springs = [chain.stiffness[i], chain.stiffness[i], chain.torsion[i]]
        for axis, spring in list(zip(axes, springs, strict=True))[: 2 + int(twisting[i])]:
            # Damping is proportional to stiffness.
            lag = damping[i] / chain.stiffness[i]
            how = {"stiffness": spring * MICRO, "damping": lag * spring * MICRO * MILLI}
            _add(body, "joint", type="hinge", axis=axis, **how)
        # The minute axial inertia of a tip has to pass MuJoCo's lower limit.
        axial, transverse = np.maximum(chain.inertias[i] * MICRO * MILLI**2, 1e-14)
        inertia = {"mass": chain.masses[i] * MICRO, "diaginertia": (axial, transverse, transverse)}
        _add(body, "inertial", pos=(chain.centres[i] * MILLI, 0, 0), **inertia)
        thickest = float(chain.whisker.radius(chain.nodes[i : i + 2]).max())
        if chain.nodes[i + 1] + thickest >= nearest:
            _add(body, "geom", **_segment(chain, i, end, assets, cores[i]), contype=1, conaffinity=0)
        for index, load in enumerate(job.loads):
            link, share = chain.locate(load.arc)
            if link == i:
                point = _add(body, "body", name=f"load{index}", pos=(share * end, 0, 0))
                _add(point, "inertial", pos="0 0 0", **_NOTHING)


def _segment(
    chain: Chain, link: int, length: float, assets: Element, thickness: tuple[float, float]
) -> dict[str, object]:
    """Return the collision geometry of one link: a capsule, or all points within a margin of a slim cone."""
    core, margin = thickness
    radii = chain.whisker.radius(chain.nodes[link : link + 2])
    if core == 0:
        return {"type": "capsule", "fromto": (0, 0, 0, length, 0, 0), "size": chain.radii[link] * MILLI}
    cone = cone_vertices(core, length, narrows=bool(radii[0] > radii[1]))
    _add(assets, "mesh", name=f"link{link}", vertex=cone.ravel(), inertia="shell")
    return {"type": "mesh", "mesh": f"link{link}", "margin": margin, "mass": 0}


def _thickness(chain: Chain, link: int, travel: float) -> tuple[float, float]:
    """Return the largest radius (mm) of the cone inside a link, and what its margin adds; both 0 for a plain capsule.

    Where a step's ``travel`` (mm) may bury the margin, MuJoCo would find the way out of the cone itself in a wrong
    direction and the whisker would hook; a capsule is safe to any depth.
    """
    first, last = chain.whisker.radius(chain.nodes[link : link + 2]) * MILLI
    # A link of radii r₁ > r₂ is taken as all points within r₂ of a slim cone of radius r₁ − r₂ that ends in a point.
    core, margin = float(abs(first - last)), float(min(first, last))
    return (core, margin) if core >= LEAST_TAPER and margin >= SAFE_TRAVEL * travel else (0.0, 0.0)


def _add_obstacles(
    world: Element,
    assets: Element,
    obstacles: Iterable[Obstacle],
    whisker_friction: float,
    times: NDArray,
    step: float,
) -> list[PrescribedMotion]:
    """Add the obstacles; return the drives of the moving ones in the order of their joints."""
    drives = []
    for number, obstacle in enumerate(obstacles):
        body = world
        if obstacle.motion is not None:
            position, quaternion = (np.asarray(values, dtype=float) for values in obstacle.motion(times))
            position = position * MILLI
            body = _add(world, "body", pos=position[0], quat=quaternion[0])
            drives += _add_obstacle_joints(body, position, quaternion, step)
        friction = obstacle.friction_beside(whisker_friction)
        for index, part in enumerate(obstacle.parts):
            _add(
                body,
                "geom",
                **_shape(part, f"part{number}-{index}", assets),
                mass=0,
                contype=0,
                conaffinity=1,
                priority=1,
                friction=(friction, 0, 0),
                condim=3 if friction > 0 else 1,
                # Critically damped contact whose time constant follows the step: its error shrinks together with the
                # step.
                solref=(CONTACT_TIME * step, 1),
                solimp=(CONTACT_IMPEDANCE, CONTACT_IMPEDANCE, 1e-3),
            )
    return drives


def _add_obstacle_joints(body: Element, position: NDArray, quaternion: NDArray, step: float) -> list[PrescribedMotion]:
    if np.ptp(quaternion, axis=0).max() > 0:
        _add(body, "joint", type="free", armature=ARMATURE)
        _add(body, "inertial", pos="0 0 0", **_NOTHING)
        return [drive_free(position, quaternion, step)]
    moving = np.flatnonzero(np.ptp(position, axis=0) > 0)
    if not len(moving):
        return []
    # Slide axes are given in the frame of the turned body, the path in world axes.
    to_body = to_matrices(quaternion[0]).T
    for axis in moving:
        _add(body, "joint", type="slide", axis=to_body[:, axis], armature=ARMATURE)
    _add(body, "inertial", pos="0 0 0", **_NOTHING)
    return [drive_scalars(position[:, moving] - position[0, moving], step)]


def _shape(part: Part, name: str, assets: Element) -> dict[str, object]:
    match part:
        case Sphere():
            return {"type": "sphere", "size": part.radius * MILLI, "pos": np.multiply(part.centre, MILLI)}
        case Box():
            return {
                "type": "box",
                "size": np.multiply(part.half_sizes, MILLI),
                "pos": np.multiply(part.centre, MILLI),
                "quat": part.quaternion,
            }
        case ConvexPart():
            # MuJoCo takes the convex hull of the vertices; without an inertia it asks for no closed surface.
            _add(assets, "mesh", name=name, vertex=part.vertices.ravel() * MILLI)
            return {"type": "mesh", "mesh": name}
        case _:
            ends = np.multiply((*part.start, *part.end), MILLI)
            return {"type": type(part).__name__.lower(), "size": part.radius * MILLI, "fromto": ends}


def _quaternion(angle: float, axis: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])


def _add(parent: Element, tag: str, **attributes: object) -> Element:
    """Add an element; numbers and sequences of numbers are written with full precision."""
    return ElementTree.SubElement(parent, tag, {name: _text(value) for name, value in attributes.items()})


def _text(value: object) -> str:
    if isinstance(value, (str, int)):
        return str(value)
    return " ".join(repr(float(item)) for item in np.atleast_1d(np.asarray(value, dtype=float)))
