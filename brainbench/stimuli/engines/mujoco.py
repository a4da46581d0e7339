"""MuJoCo as a whisker engine: the independent CPU reference.

Uses the ``discrete`` integrator of MuJoCo ≥ 4, which solves springs, dampers and contacts together in the metric
M + hD + h²K, so the time step is limited by accuracy and not by stability. Native threads run the jobs.

Each whisker among its obstacles is a small model of its own, in mg, mm and ms, so in mN and µN·m. These units keep
every number near one; with kilograms MuJoCo rejects thin tips as massless. Body tree: world → only the follicle joints
that move → base, which carries the force and torque sensors → link 0 → … → link N − 1, each with two hinges, and a
third where the chain twists. Letters: n time step, N link.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import MissingDependencyError
from brainbench.core.rotations import base_rotation, euler_matrix, to_matrices
from brainbench.stimuli.engines.reach import LARGEST_SLIDE, Reach, stays_in_plane
from brainbench.stimuli.engines.stepping import (
    LEAST_TAPER,
    PrescribedMotion,
    SteppedEngine,
    SteppedJob,
    cone_vertices,
    drive_scalars,
    driven,
)
from brainbench.stimuli.engines.trust import (
    GAVE_WAY,
    LARGEST_BEND,
    LARGEST_CHANGE,
    fault,
    state_fault,
    step_travel,
    strongest_force,
)
from brainbench.stimuli.motion.jobs import MICRO, MILLI, Job, Trace
from brainbench.stimuli.objects.obstacle import Box, ConvexPart, Obstacle, Part, Sphere
from brainbench.stimuli.whiskers.whisker import Chain, Whisker

# A MuJoCo mocap body teleports and has no velocity. Instead every moving coordinate is a joint of huge armature B,
# pushed by B times the second difference of its trajectory: the discrete integrator then reproduces the trajectory,
# with the right velocity, to rounding.
ARMATURE = 1e9
"""Inertia of a prescribed coordinate. Larger would cost the solver digits, smaller would let the whisker's
reaction (µN·m) deflect the follicle."""


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
    return driven(np.concatenate([position, quaternion], axis=1)[:-1], np.concatenate([linear, angular], axis=1), step)


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
        # Roll about x, then bend about z: the product of their quaternions.
        (c, s), bent = _quaternion(chain.rest_rolls[i], (1.0, 0.0, 0.0))[:2], np.array(chain.rest_angles[i] / 2)
        turn = c * np.cos(bent), s * np.cos(bent), -s * np.sin(bent), c * np.sin(bent)
        body = _add(body, "body", pos=(end, 0, 0), quat=turn)
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
    world: Element, assets: Element, obstacles: Iterable[Obstacle], whisker_friction: float, times: NDArray, step: float
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


logger = logging.getLogger(__name__)

CHUNK = 250
"""Steps per native call: bounds the memory of a job, and the drift of prescribed joints between resets."""


@dataclass(frozen=True)
class MujocoWhiskerEngine(SteppedEngine):
    """Runs whisker jobs in MuJoCo."""

    name = "mujoco"
    twists = True
    yields = True
    coils = True
    package = "mujoco-core"
    revision = "+1"  # one contact for a pair of convex bodies

    @contextlib.contextmanager
    def session(self) -> Iterator[None]:
        """Send MuJoCo's warnings to our log; by itself it prints them and writes MUJOCO_LOG.TXT."""
        mujoco = engine()
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda message: logger.debug("MuJoCo: %s", message))
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(before)

    def simulate(self, stepped: SteppedJob) -> Trace:
        """See :meth:`SteppedEngine.simulate`."""
        job, chain = stepped.job, stepped.chain
        free = stepped.fidelity.twist is not False
        twists = free and not stays_in_plane(job, stepped.reach, *stepped.pose, stepped.times)
        tolerance = stepped.fidelity.contact_tolerance
        built = build_model(
            job, chain, stepped.reach, stepped.step, stepped.times, twists=twists, contact_tolerance=tolerance
        )
        sensors, hinges, failed, reason = _integrate(built, job, stepped.times)
        displacement, still = None, built
        if len(built.yielding):
            displacement, hinges, built = _give_way(built, sensors, hinges)
            far = np.abs(displacement) >= np.repeat([LARGEST_SLIDE * job.whisker.arc_length, LARGEST_BEND], 3)
            first = int(np.argmax(far.any(axis=1)))
            if far[first].any() and first < failed:
                failed, reason = first, fault(GAVE_WAY, float(stepped.times[first]), 0.0)
        failed, reason = stepped.end(failed, reason)
        frames = stepped.frames(failed)
        nearest = frames.nearest
        shape = _joints(built, chain, hinges[nearest], nearest)
        contact, arc = _contacts(sensors[nearest, 6:], shape, chain)
        if stepped.record_shape:
            # As the wrench: between steps a whisking follicle turns by more than its whisker bends.
            shape = frames.interpolate(lambda steps: _joints(built, chain, hinges[steps], steps))
        return stepped.trace(
            frames,
            frames.interpolate(lambda steps: _wrench(still, sensors, steps)),
            contact,
            arc,
            shape / MILLI,
            penetration=_penetration(sensors[: failed + 1, 6:], hinges[: failed + 1], built, chain),
            reason=reason,
            steps=failed,
            displacement=None if displacement is None else frames.interpolate(displacement.__getitem__),
            doubt=_lost_friction(*_friction(sensors[:failed, 6:], job, stepped.reach)),
        )


def _give_way(
    built: WhiskerModel, sensors: NDArray, joints: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], WhiskerModel]:
    """Return how far the follicle is before every step [n, 6] (m, rad), the whisker's own hinges [n, hinge], and the
    model with its base there; moments of ``sensors`` [n, …] are put about the new base."""
    from scipy.spatial.transform import Rotation

    count = len(built.yielding)
    places = np.zeros((len(joints), 6))
    places[:, built.yielding] = joints[:, :count]
    slide, turns = places[:, :3], Rotation.from_euler("XYZ", places[:, 3:])
    # Sensors stand where the follicle would be if it were rigid.
    sensors[:, 3:6] -= np.cross(slide, sensors[:, :3])
    arm = np.einsum("nij,nj->ni", built.rotation, slide)
    moved = replace(built, base=built.base + arm, rotation=built.rotation @ turns.as_matrix())
    return np.concatenate([slide / MILLI, turns.as_rotvec()], axis=1), joints[:, count:], moved


def _wrench(built: WhiskerModel, sensors: NDArray, steps: NDArray) -> NDArray[np.float64]:
    """Return force and moment [n, 6] (N, N·m, world) of the whisker on its base before ``steps`` [n]."""
    # From mN and µN·m to SI units, then from the frame of the base to the world.
    local = sensors[steps, :6] * np.repeat([1 / MILLI, 1 / MICRO], 3)
    # MuJoCo's sensor reads the action of the base on the whisker, in the frame of the base.
    return -np.einsum("nij,nkj->nki", built.rotation[steps], local.reshape(-1, 2, 3)).reshape(-1, 6)


def _integrate(
    built: WhiskerModel, job: Job, times: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], int, str]:
    """Step the model; return sensors [n, …] and hinge angles [n, hinge] before every step, first bad step, reason.

    The first bad step is n, and the reason empty, when all went well.
    """
    mujoco, rollout = engine(), import_module("mujoco.rollout")
    model = built.model
    data = mujoco.MjData(model)
    steps, strongest = len(times) - 1, strongest_force(job.whisker) * MILLI
    sensors = np.zeros((steps, model.nsensordata))
    axes = len(built.yielding)
    hinges = np.zeros((steps, axes + 2 * len(built.twisting) + np.count_nonzero(built.twisting)))
    spec = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
    if job.loads:
        spec |= int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
    state = np.zeros(mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    at = slice(1, 1 + model.nq)
    rate = slice(1 + model.nq, 1 + model.nq + model.nv)
    state[at] = model.qpos0
    for first in range(0, steps, CHUNK):
        count = min(CHUNK, steps - first)
        control = _control(built, job, times[first : first + count], first)
        q = v = 0
        # Prescribed coordinates are put on their path at the start of every chunk, so that rounding does not add up.
        for drive in built.drives:
            position, velocity = drive.position[first], drive.velocity[first]
            state[at][q : q + len(position)] = position
            state[rate][v : v + len(velocity)] = velocity
            q, v = q + len(position), v + len(velocity)
        state[0] = times[first] * MILLI
        states, read = rollout.rollout(
            model,
            data,
            state[None],
            control[None],
            control_spec=spec,
            initial_warmstart=data.qacc_warmstart[None].copy(),
        )
        window = slice(first, first + count)
        sensors[window] = read[0]
        angles = states[0, :, at][:, q:]
        hinges[first] = state[at][q:]
        hinges[first + 1 : first + count] = angles[:-1]
        warned = [str(mujoco.mjtWarning(int(kind)).name) for kind in np.flatnonzero(data.warning.number)]
        # Also true of NaN; looking at every step by itself takes as long as a step of a short chain.
        sound = np.isfinite(read).all() and np.abs(hinges[window, axes:]).max() < LARGEST_BEND
        if warned or not sound or np.abs(read[0, :, :3]).max() > strongest:
            bad = ~np.isfinite(read[0]).all(axis=1) | ~(np.abs(hinges[window, axes:]) < LARGEST_BEND).all(axis=1)
            bad |= np.abs(read[0, :, :3]).max(axis=1) > strongest
            failed = first + (int(np.argmax(bad)) if bad.any() else 0)
            fault = state_fault(hinges[failed, axes:], sensors[failed, :6] / MILLI, job.whisker)
            fault = fault or f"MuJoCo warned of {', '.join(warned) or 'a non-finite sensor'}"
            return sensors, hinges, failed, f"at {times[failed]:.6g} s {fault}"
        state = states[0, -1].copy()
    return sensors, hinges, steps, ""


def _control(built: WhiskerModel, job: Job, times: NDArray, first: int) -> NDArray[np.float64]:
    """Return the inputs of every step [count, …]: generalised forces on the prescribed joints, then the loads."""
    forces = np.zeros((len(times), built.model.nv))
    column = 0
    for drive in built.drives:
        width = drive.acceleration.shape[1]
        # F = B a: against an armature of 1e9 the reaction of the whisker changes nothing that counts.
        forces[:, column : column + width] = ARMATURE * drive.acceleration[first : first + len(times)]
        column += width
    if not job.loads:
        return forces
    external = np.zeros((len(times), built.model.nbody, 6))
    for body, load in zip(built.loads, job.loads, strict=True):
        external[times < load.stop, body, :3] = np.multiply(load.force, MILLI)
    return np.concatenate([forces, external.reshape(len(times), -1)], axis=1)


def _joints(built: WhiskerModel, chain: Chain, hinges: NDArray, steps: NDArray) -> NDArray[np.float64]:
    """Return joint and tip positions [n, N + 1, 3] (mm, world) from hinge angles [n, hinge] before ``steps`` [n]."""
    frame = built.rotation[steps]
    points = [built.base[steps]]
    first = 0
    for i, twists in enumerate(built.twisting):
        # Rest bend about z, then the hinges about y and z, as in the model; twist comes before half of the rest bend.
        half = chain.rest_angles[i] / 2 if twists else 0.0
        if chain.rest_rolls[i]:
            frame = frame @ euler_matrix((chain.rest_rolls[i], 0.0, 0.0))
        frame = frame @ _rotation_zyz(chain.rest_angles[i] - half, hinges[:, first], hinges[:, first + 1])
        if twists:
            # Rotations about x turn y and z; two columns are combined in place of a matrix product.
            c, s = np.cos(hinges[:, first + 2])[:, None], np.sin(hinges[:, first + 2])[:, None]
            x, y, z = np.moveaxis(frame, -1, 0)
            frame = np.stack([x, c * y + s * z, c * z - s * y], axis=-1) @ euler_matrix((0.0, 0.0, half))
        first += 2 + int(twists)
        points.append(points[-1] + frame[:, :, 0] * chain.lengths[i] * MILLI)
    return np.stack(points, axis=1)


def _rotation_zyz(rest: float, y: NDArray, z: NDArray) -> NDArray[np.float64]:
    """Return rotations [n, 3, 3] Rz(rest) · Ry(y) · Rz(z)."""
    cr, sr = np.cos(rest), np.sin(rest)
    cy, sy, cz, sz = np.cos(y), np.sin(y), np.cos(z), np.sin(z)
    zero = np.zeros_like(y)
    # Ry · Rz written out for all steps at once, in place of a stack of matrix products.
    turn = np.stack([cy * cz, -cy * sz, sy, sz, cz, zero, -sy * cz, sy * sz, cy], axis=-1).reshape(-1, 3, 3)
    return np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]]) @ turn


def _contacts(slots: NDArray, shape: NDArray, chain: Chain) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return whether there is contact [n], and the force-weighted mean arc length (m) of the contact points [n]."""
    slots = slots.reshape(len(slots), -1, SLOT_WIDTH)
    # Weighted by force, so that a contact that merely grazes does not pull the mean arc towards itself.
    force = np.linalg.norm(slots[..., 1:4], axis=-1)
    total = force.sum(axis=1)
    contact = total > 0
    arc = np.full(len(slots), np.nan)
    arcs = _nearest_arcs(slots[contact, :, 5:8], shape[contact], chain)
    arc[contact] = np.sum(force[contact] * arcs, axis=1) / total[contact]
    return contact, arc


def _nearest_arcs(points: NDArray, joints: NDArray, chain: Chain) -> NDArray[np.float64]:
    """Return the arc lengths [n, k] (m) of the points of chains [n, N + 1, 3] nearest to ``points`` [n, k, 3]."""
    along = np.diff(joints, axis=1)[:, None]
    offset = points[:, :, None] - joints[:, None, :-1]
    # Nearest point of every link as a segment, all links at once; the nearest of them gives the arc length.
    share = np.clip(np.sum(offset * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
    distance = np.linalg.norm(offset - share[..., None] * along, axis=-1)
    link = np.argmin(distance, axis=-1)
    share = np.take_along_axis(share, link[..., None], axis=-1)[..., 0]
    return chain.nodes[link] + share * np.diff(chain.nodes)[link]


def _friction(slots: NDArray, job: Job, reach: Reach) -> tuple[float, float]:
    """Return the friction of the objects, and what contacts hold of it (root mean square); 0 and 0 without contact."""
    friction = min((item.friction_beside(job.whisker.friction) for item in reach.obstacles), default=0.0)
    squares = np.sum(slots.reshape(-1, SLOT_WIDTH)[:, 1:4] ** 2, axis=0)
    return (friction, float(np.sqrt(squares[1:].sum() / squares[0]))) if squares[0] > 0 else (0.0, 0.0)


def _lost_friction(friction: float, held: float) -> str:
    """Return in words that soft contacts hold too little friction; empty if enough.

    A whisker against an object creeps along it, so that Coulomb's law asks for almost all of the friction. Soft
    friction is viscous below some cm/s and lets go.
    """
    # What is missing, as a share of the whole force of a contact that slips.
    if friction - held <= LARGEST_CHANGE * np.hypot(1, friction):
        return ""
    return (
        f"soft contacts hold {held / friction:.0%} of the friction {friction:g} (root mean square); use the backend "
        "'rod', or friction 0"
    )


def _penetration(slots: NDArray, hinges: NDArray, built: WhiskerModel, chain: Chain) -> float:
    """Return the deepest overlap (m) of whisker and obstacle over all steps.

    MuJoCo reports the distance from the core of a link, so the link's margin is added back.
    """
    if not slots.size:
        return 0.0
    slots = slots.reshape(len(slots), -1, SLOT_WIDTH)
    # At most: as if every contact were on the link of the largest margin.
    most = np.where(slots[..., 0] > 0, built.margins.max() - slots[..., 4], -np.inf).max(axis=1)
    touching = np.argsort(-most, kind="stable")[: np.count_nonzero(most > -np.inf)]
    deepest = 0.0
    for steps in np.array_split(touching, len(touching) // CHUNK + 1):
        if not len(steps) or most[steps[0]] <= deepest:
            break
        gaps = slots[steps]
        arcs = _nearest_arcs(gaps[..., 5:8], _joints(built, chain, hinges[steps], steps), chain)
        link = np.clip(np.searchsorted(chain.nodes, arcs, side="right") - 1, 0, chain.links - 1)
        overlap = np.where(gaps[..., 0] > 0, built.margins[link] - gaps[..., 4], 0.0)
        deepest = max(deepest, float(overlap.max(initial=0.0)))
    return deepest / MILLI
