"""Builds the physics of a task: the hand on its place, furniture, and one model per shape of the object."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError, brief, check_each, listing
from robotics_bridge.hands.hand import LEVER, Hand
from robotics_bridge.hands.scenes import ARMATURE, WEAK_PUSH, WEAK_SERVO, flexed, palm_surface, place_palm
from robotics_bridge.hands.tree import Tree, driven, pulled
from robotics_bridge.tasks.objects import ObjectShape, add_object, slots, with_sizes
from robotics_bridge.tasks.settings import ContactModel, set_contacts
from robotics_bridge.tasks.task import Pose, Task

mujoco = mujoco_module()

_log = logging.getLogger(__name__)
_INSIDE = 5e-3  # depth of an object in the hand at the start that is told (m)
_EFFORT = 2.0  # effort of a hinge for which the hand's file names none (N·m)
_PALM_TOP = 0.4975  # height of an upturned palm below objects that start at 0.5 m
_ROUNDED = 1e-3  # how far beyond a limit a position that a task states may lie (rad or m)
_TIPS = {
    "right_hand_thumb_rota_link2": (0.0, 0.042, 0.007), "right_hand_index_rota_link2": (0.008, 0.0, 0.035),
    "right_hand_mid_link2": (0.008, 0.0, 0.035), "right_hand_ring_link2": (0.008, 0.0, 0.035),
    "right_hand_pinky_link2": (0.008, 0.0, 0.035), "right_thumb_DP": (0.02, 0.005, 0.0005),
    "right_index_DP": (0.018, 0.005, 0.0001), "right_middle_DP": (0.018, 0.005, 0.0001),
    "right_ring_DP": (0.018, 0.005, 0.0001), "right_pinky_DP": (0.018, 0.005, 0.0001),
}  # fmt: skip
"""Finger tip → point from which the distance to the object is taken [m, link frame] (released settings)."""


@dataclass(frozen=True, eq=False)
class TaskModel:
    """Compiled physics of a task for one hand."""

    models: Sequence[Any]
    """``mujoco.MjModel`` per shape; they differ in numbers only."""
    shapes: tuple[ObjectShape, ...]
    """Shapes of the objects, one per model."""
    objects: tuple[str, ...]
    """Names of the free bodies."""
    joints: tuple[str, ...]
    """Driven joints J: those of the hand in the order of its drives, then slides of the carriage."""
    moved: tuple[str, ...]
    """Joints A that the policy moves."""
    stiffness: NDArray[np.float64]
    """[J] (N·m/rad or N/m)."""
    damping: NDArray[np.float64]
    """[J] (N·m·s/rad or N·s/m)."""
    effort: NDArray[np.float64]
    """[J] largest torque (N·m) or force (N)."""
    rest: NDArray[np.float64]
    """[J] positions at the start and of joints that are held (rad or m)."""
    low: NDArray[np.float64]
    """[J] lower limits (rad or m)."""
    high: NDArray[np.float64]
    """[J] upper limits (rad or m)."""
    tips: Mapping[str, tuple[float, float, float]]
    """Finger tip → point (m, link frame)."""
    lever: NDArray[np.float64]
    """[J] factor on imperfections and noise that a task states for hinges: :data:`LEVER` of the hand's slides."""


def build(task: Task, hand: Hand) -> TaskModel:
    """Compile a task for a hand."""
    shapes = with_sizes(task.objects, task.object_changes.size)
    names = tuple("object" if task.copies == 1 else f"object{index}" for index in range(task.copies))
    bare, drives = _hand_spec(task, hand)
    kinds = slots(shapes)
    models = []
    for shape in shapes:
        spec = bare.copy()
        for name in names:
            add_object(
                spec, name, shape, kinds, density=task.density, condim=3, friction=(task.friction, 0.005, 0.0001)
            )
        models.append(spec.compile())
        if task.contacts != ContactModel():
            set_contacts(models[-1], task.contacts)
    first = models[0]
    joints = tuple(drives)
    ids, fingers = [first.joint(name).id for name in joints], [n for n in joints if not n.startswith("carriage_")]
    # Joints without limits get a full turn: actions are scaled by ranges.
    limited = first.jnt_limited[ids].astype(bool)
    low = np.where(limited, first.jnt_range[ids, 0], -np.pi)
    high = np.where(limited, first.jnt_range[ids, 1], np.pi)
    given = task.joints.get(hand.name, {})
    check_each(f"joint in task {task.name!r} of hand {hand.name!r}:", given, joints)
    for name, position in given.items():
        least, most = low[joints.index(name)], high[joints.index(name)]
        if not least - _ROUNDED <= position <= most + _ROUNDED:
            raise UsageError(
                f"Joint {name!r} of hand {hand.name!r} rests within {least:g} and {most:g} (rad or m) in task "
                f"{task.name!r}; received {position:g}."
            )
    # Joints that the task does not name are open: 0 but for jaws, between which the object may lie. 0 may lie beyond
    # the limits.
    opened = dict(zip(hand.joints, (flexed(hand, 0.0)[hand.joint_numbers] + 0.0).tolist(), strict=True))
    rest = np.array([given.get(name, opened.get(name, 0.0)) for name in joints])
    stiffness, damping, effort = (np.array([drives[name][column] for name in joints]) for column in range(3))
    model = TaskModel(
        models=models, shapes=shapes, objects=names, joints=joints, moved=_moved(task, hand, joints),
        stiffness=stiffness, damping=damping, effort=effort, rest=np.clip(rest, low, high), low=low, high=high,
        tips=_tips(hand),
        lever=np.array([*hand.lever(fingers), *np.ones(len(joints) - len(fingers))]),
    )  # fmt: skip
    if task.starts is None:
        _warn_inside(task, hand, model)
    return model


def _warn_inside(task: Task, hand: Hand, built: TaskModel) -> None:
    """Say where the first object begins inside the hand, which would throw it out."""
    model, place = built.models[0], task.placement
    data, name = mujoco.MjData(model), built.objects[0]
    data.qpos[[model.joint(joint).qposadr[0] for joint in built.joints]] = built.rest
    column, site = int(model.joint(name).qposadr[0]), place.sites[0] if place.sites else (0.0, 0.0, 0.0)
    data.qpos[column : column + 3] = np.add(site, (0.0, 0.0, place.height + built.shapes[0].bottom))
    data.qpos[column + 3 : column + 7] = place.quaternion
    mujoco.mj_forward(model, data)
    for pair, distance in zip(model.geom_bodyid[data.contact.geom], data.contact.dist.tolist(), strict=True):
        links = [model.body(body).name for body in pair]
        if name in links and distance < -_INSIDE and (link := links[links[0] == name]) not in built.objects:
            _log.warning(
                "The object begins %.0f mm inside %s of hand %s: place the hand (Task.hand_poses) or its joints "
                "(Task.joints) elsewhere in a task of your own.", -1e3 * distance, brief(link), brief(hand.name),
            )  # fmt: skip
            return


def _hand_spec(task: Task, hand: Hand) -> tuple[Any, dict[str, tuple[float, float, float]]]:
    """Return the scene without objects and the drives: joint → stiffness, damping, effort."""
    spec = hand.mjspec()
    option, solver = spec.option, task.solver
    option.timestep = solver.timestep / task.contacts.substeps
    option.iterations, option.ls_iterations = solver.iterations, solver.line_search
    option.tolerance, option.integrator = solver.tolerance, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    body = place_palm(hand, spec, *(task.hand_poses.get(hand.name) or palm_up(hand)))
    scale = task.contacts.drive_scale
    drives = {name: (scale * k, scale * d, scale * most) for name, (k, d, most) in drives_of(hand).items()}
    while spec.actuators:
        spec.delete(spec.actuators[0])
    for joint in spec.joints:
        if joint.name in drives:
            joint.armature = scale * (joint.armature or ARMATURE)
    slides = {}
    for axis, ((low, high), stiffness, damping, effort) in task.carriage.items():
        # The carriage moves along world axes, while a joint's axis is given in the frame of its body: rows of Rᵀ.
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, np.array(body.quat, dtype=float))
        name = f"carriage_{axis}"
        body.add_joint(
            name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=matrix.reshape(3, 3)["xyz".index(axis)],
            range=(low, high), limited=True, armature=1.0,
        )  # fmt: skip
        slides[name] = (stiffness, damping, effort)
    if slides:
        # A robot arm bears the weight of the hand.
        for each in spec.bodies:
            each.gravcomp = 1.0
    drives |= slides
    tendons = {hand.model.joint(joint).name: drive for joint, drive in driven(hand.model).items() if drive.tendon >= 0}
    for name, (_, _, effort) in drives.items():
        target, kind, gain = name, mujoco.mjtTrn.mjTRN_JOINT, 1.0
        if name in tendons:
            # One action for all that a tendon pulls: the torque of its leading joint is the tendon's force times that
            # joint's coefficient.
            target, kind = hand.model.tendon(tendons[name].tendon).name, mujoco.mjtTrn.mjTRN_TENDON
            gain = 1.0 / tendons[name].coefficient
        spec.add_actuator(
            name=name, target=target, trntype=kind, gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_NONE, gainprm=[gain] + [0.0] * 9, forcelimited=True,
            forcerange=(-effort * abs(gain), effort * abs(gain)),
        )  # fmt: skip
    if task.furniture is not None:
        task.furniture(spec)
    return spec, drives


def drives_of(hand: Hand) -> dict[str, tuple[float, float, float]]:
    """Return joint → stiffness, damping and effort: those of its position servo, or a weak drive of ours.

    A tendon's servo is that of its first joint. Joints that mimic another, or follow from a closed loop, are not
    driven.
    """
    model, tree = hand.model, Tree(hand.model)
    servos = driven(model)
    moved = {*servos, *pulled(model), *tree.followers}
    used = {drive.actuator for drive in servos.values()}
    if left := [model.actuator(index).name for index in range(model.nu) if index not in used]:
        message = "are no position servo of a joint or a tendon and are left out; joints without a servo get a weak one"
        _log.warning("Of hand %s the drives %s %s.", brief(hand.name), listing(left), message)
    order = [*servos, *(joint for joint in hand.joint_numbers.tolist() if joint not in moved)]
    drives = {}
    for joint in order:
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        (stiffness, damping), effort = (WEAK_PUSH, _EFFORT / LEVER) if slides else (WEAK_SERVO, _EFFORT)
        if joint in servos:
            drive = servos[joint]
            index = drive.actuator
            # Behind a gear, the servo's length and force are those of the motor; a tendon's length is what all its
            # joints make of it, its force reaches each by its own coefficient.
            gear = abs(float(model.actuator_gear[index, 0]))
            share = abs(drive.coefficient)
            stiffness = float(-model.actuator_biasprm[index, 1]) * gear**2 * share * drive.total
            damping = float(-model.actuator_biasprm[index, 2]) * gear**2 * share * drive.total
            # Without a limit, what the largest error of a target calls for; noise is stated in units of it.
            span = float(np.ptp(model.jnt_range[joint])) if model.jnt_limited[joint] else 2 * np.pi
            limited = bool(model.actuator_forcelimited[index])
            effort = float(model.actuator_forcerange[index, 1]) * gear * share if limited else stiffness * span
        if model.jnt_actfrclimited[joint]:
            stated = float(model.jnt_actfrcrange[joint, 1])
            effort = min(effort, stated) if joint in servos else stated
        drives[model.joint(joint).name] = (stiffness, damping, effort)
    return drives


def _moved(task: Task, hand: Hand, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the joints of the fingers that a task moves, in the drives' order, and the carriage."""
    if not task.moves:
        return tuple(joints)
    chosen: set[str] = set()
    for part in task.moves:
        names = [name for name in hand.fingers if name.lower().startswith(part)]
        # Fingers of a hand from a file are named by their tips, with the word in any place, or in another link.
        names = names or [name for name in hand.fingers if part in name.lower()]
        if not names:
            names = [n for n, chain in hand.fingers.items() if any(part in link.lower() for link in chain)]
            # A word that all fingers have, such as that of a middle phalanx, names none.
            names = names if len(names) < len(hand.fingers) else []
        if not names:
            raise UsageError(
                f"Task {task.name!r} moves {', '.join(task.moves)}; the fingers of hand {hand.name!r} are "
                f"{', '.join(hand.fingers)}. Register a task with moves={tuple(hand.fingers)} in a file of your own; "
                "on the command line --task-file names it (docs/tasks.md, 'Another hand, a task of your own')."
            )
        chosen |= set(names)
    links = {link for name in chosen for link in hand.fingers[name]}
    others = {link for name in hand.fingers if name not in chosen for link in hand.fingers[name]}
    model = hand.model
    # Names of each body and of all below it; bodies come after their parents.
    below = [{model.body(body).name} for body in range(model.nbody)]
    for body in range(model.nbody - 1, 0, -1):
        below[model.body_parentid[body]] |= below[body]
    roots = set()
    for index in range(model.njnt):
        moved = below[model.jnt_bodyid[index]]
        if moved & links and not moved & others and not moved >= set(hand.fingers):
            roots.add(model.joint(index).name)
    return tuple(name for name in joints if name in roots or name.startswith("carriage_"))


def _tips(hand: Hand) -> dict[str, Any]:
    """Return finger tip → point of distances: as released, else the middle of its taxels."""
    layout = hand.layout("low", "tips")
    points = {}
    for tip in hand.tips:
        points[tip] = (0.0, 0.0, 0.0)
        if tip in _TIPS and hand.pads:
            points[tip] = _TIPS[tip]
        elif tip in layout and layout[tip].active.any():
            points[tip] = tuple(layout[tip].position[layout[tip].active].mean(axis=0).tolist())
    return points


def palm_up(hand: Hand) -> Pose:
    """Return the pose that turns the palm of a hand up below the object's place, fingers along −x."""
    up, surface, step = palm_surface(hand)
    length = float(np.linalg.norm(step))
    # Fingers around the middle of the palm, as of a gripper, point nowhere along it: then an axis of the palm.
    forward = step / length if length > 1e-6 else -np.eye(3)[np.argmin(np.abs(up))]
    # Columns: where the palm's own directions (forward, up × forward, up) go in the world.
    palm = np.stack([forward, np.cross(up, forward), up], axis=1)
    world = np.stack([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]], axis=1)
    # Rotation that takes the palm's orthonormal directions to their place in the world.
    matrix = world @ palm.T
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, matrix.ravel())
    x, y, z = (np.array([0.0, 0.0, _PALM_TOP]) - matrix @ (surface + 0.4 * step)).tolist()
    w, a, b, c = quaternion.tolist()
    return (x, y, z), (w, a, b, c)
