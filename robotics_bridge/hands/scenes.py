"""A hand with the palm up and an object on it: the smallest scene in which every sensor has something to read."""

from __future__ import annotations

import contextlib
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError, check_number
from brainbench.core.rotations import from_matrices, from_z_axis, to_matrices
from robotics_bridge.hands.hand import Hand
from robotics_bridge.hands.tree import Tree, coupled, half_open, link_middle, opens, palmar_directions, slide_of

mujoco = mujoco_module()

OBJECT = "object"  # name of the free body and of its geometry
WEAK_SERVO, WEAK_PUSH, ARMATURE = (2.0, 0.2), (300.0, 10.0), 0.01
"""Stiffness and damping of a hinge without a servo (N·m/rad, N·m·s/rad) and of such a slide (N/m, N·s/m); inertia of
their drives (kg·m², kg for a slide)."""


def holding(hand: Hand, **settings: Any) -> Any:
    """Return the ``mujoco.MjModel`` of a hand, palm up, with a ball just above the palm; see :func:`holding_spec`.

    Jaws that slide start with the ball between them, which is made smaller where it does not fit.
    """
    spec, jaws = holding_spec(hand, **settings), jaw_ends(hand)
    return _between(hand, spec, jaws) if jaws else _raised(spec.compile())


def holding_spec(
    hand: Hand, *, radius: float = 0.03, timestep: float = 0.002, reach: float = 0.6, servos: Collection[str] = ()
) -> Any:
    """Return the ``mujoco.MjSpec`` behind :func:`holding`: the palm's surface below the ball is at z = 0.

    A hand gets a weak position servo on every hinge and slide unless all drives of its file are position servos of one
    joint each, and each of the joints ``servos`` has one. The ball of 100 g has a ``radius`` [m] and lies between the
    middle of the palm (``reach`` 0) and the roots of the fingers (1).
    """
    check_number("radius of the ball (m)", radius, above=0)
    check_number("reach", reach)
    up, surface, step = palm_surface(hand)
    # Between the middle of the palm and the roots of the fingers, where these reach it when they close.
    surface = surface + reach * step
    spec = hand.mjspec()
    spec.option.timestep = timestep
    driven = _servoed(hand)
    if driven is None or not {*servos} <= {hand.model.joint(joint).name for joint in driven.tolist()}:
        replace_drives(spec)
    # The shortest turn onto z is that of z onto the direction mirrored at z.
    turn = from_z_axis(up * (-1.0, -1.0, 1.0))
    place_palm(hand, spec, -to_matrices(turn) @ surface, turn)
    ball = spec.worldbody.add_body(name=OBJECT, pos=(0.0, 0.0, radius + 1e-3))
    ball.add_freejoint()
    ball.add_geom(
        name=OBJECT, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(radius, 0, 0), mass=0.1, condim=4,
        friction=(1.0, 0.01, 1e-4),
    )  # fmt: skip
    return spec


def place_palm(hand: Hand, spec: Any, place: ArrayLike, turn: ArrayLike) -> Any:
    """Put the palm to a place [3] (m) and orientation (w, x, y, z) of the world; return the body that was moved.

    That is the palm, or what carries it: a wrist and forearm stay attached. The world has gravity along −z and
    contacts, whatever the hand's file says of its own.
    """
    model, palm = hand.model, hand.model.body(hand.palm).id
    body = spec.body(model.body(model.body_rootid[palm]).name)
    if body.name != hand.palm:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        palm_axes, root = (data.xmat[number].reshape(3, 3) for number in (palm, model.body_rootid[palm]))
        moved = to_matrices(turn) @ palm_axes.T
        place = np.asarray(place) + moved @ (data.xpos[model.body_rootid[palm]] - data.xpos[palm])
        turn = from_matrices(moved @ root)
    # An orientation that the file gives as angles would come before the quaternion.
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.pos, body.quat = place, turn
    # The file's world, whose axes may be others, ends here.
    spec.option.gravity = (0.0, 0.0, -9.81)
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return body


def _raised(model: Any) -> Any:
    """Lift the ball of a model until it touches nothing: hulls of meshes reach above the palm they stand for."""
    ball, body = model.geom(OBJECT).id, model.body(OBJECT).id
    for _ in range(60):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        if not any(ball in contact.geom for contact in data.contact):
            break
        model.body_pos[body, 2] += 1e-3
        model.qpos0[model.jnt_qposadr[model.body_jntadr[body]] + 2] += 1e-3
    return model


def jaw_ends(hand: Hand) -> dict[int, tuple[float, float]]:
    """Return joint number → its places (m) with jaws open and closed, of the fingers' joints that slide."""
    model, facing = hand.model, palmar_directions(hand.model, hand.palm, hand.fingers)
    data, ends = half_open(model), {}
    for chain in hand.fingers.values():
        for link in (link for link in chain if link in facing):
            joint = slide_of(model, model.body(link).id)
            if joint >= 0 and model.jnt_limited[joint]:
                axis = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3) @ model.jnt_axis[joint]
                inward = float(axis @ (data.body(link).xmat.reshape(3, 3) @ facing[link]))
                low, high = (float(end) for end in model.jnt_range[joint])
                ends[joint] = (low, high) if inward > 0 else (high, low)
    return ends


def _between(hand: Hand, spec: Any, jaws: dict[int, tuple[float, float]]) -> Any:
    """Return the model of a gripper that starts with the ball between its jaws, which all but touch it."""
    model, data = hand.model, half_open(hand.model)
    root = data.body(model.body_rootid[model.body(hand.palm).id])
    body = spec.body(root.name)
    middle = np.mean([link_middle(model, data, model.body(tip).id) for tip in hand.tips], axis=0)
    ball = spec.body(OBJECT)
    ball.pos = body.pos + to_matrices(body.quat) @ root.xmat.reshape(3, 3).T @ (middle - root.xpos)
    starts = {joint: np.array(model.body_pos[model.jnt_bodyid[joint]]) for joint in jaws}
    model_of = None
    for smaller in range(6):
        ball.geoms[0].size[0] *= 0.7 if smaller else 1.0
        for share in np.linspace(0.95, 0.0, 39):
            for joint, (opened, closed) in jaws.items():
                # A joint's reference is where the file puts its body: moving both starts the jaw elsewhere on its way.
                jaw, slide = model.jnt_bodyid[joint], spec.joints[joint]
                slide.ref = opened + share * (closed - opened)
                way = to_matrices(model.body_quat[jaw]) @ model.jnt_axis[joint]
                moved = slide.ref - model.qpos0[model.jnt_qposadr[joint]]
                spec.body(model.body(jaw).name).pos = starts[joint] + moved * way
            model_of = spec.compile()
            start = mujoco.MjData(model_of)
            mujoco.mj_forward(model_of, start)
            if not any(model_of.geom(OBJECT).id in contact.geom for contact in start.contact):
                return model_of
    return model_of


def closing(hand: Hand, share: float) -> NDArray[np.float64]:
    """Return targets (rad, m) of the servos of :func:`holding`, in their order: :func:`flexed` of their joints."""
    target, joints = flexed(hand, share), _servoed(hand)
    return target[leading_joints(hand.model) if joints is None else joints]


def flexed(hand: Hand, share: float) -> NDArray[np.float64]:
    """Return positions (rad, m) of all joints, by number, where each is flexed, or closed, by a share of its range."""
    check_number("share by which a hand closes", share, least=0, most=1)
    low, high = hand.model.jnt_range.T
    # Flexion is the longer side of a joint's range, where a gripper may be open.
    longer = np.abs(high) >= np.abs(low)
    target = np.where(longer, high, low) * share
    if opens(hand.model, hand.fingers):
        target = np.where(longer, high - share * (high - low), low + share * (high - low))
    # Joints that spread the fingers stay in their middle.
    target = np.where(np.abs(high + low) < 0.5 * (high - low), 0.0, target)
    for joint, (opened, closed) in jaw_ends(hand).items():
        target[joint] = opened + share * (closed - opened)
    return target


def _servoed(hand: Hand) -> NDArray[np.int32] | None:
    """Return the joint of every drive of a hand's file; None unless all are position servos of a joint."""
    model = hand.model
    # Joint targets mean nothing to motors and tendons, and something else behind a gear or another unit.
    servos = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_biasprm[:, 1] < 0)
    servos &= (model.actuator_gainprm[:, 0] == -model.actuator_biasprm[:, 1]) & (model.actuator_gear[:, 0] == 1)
    return model.actuator_trnid[:, 0] if model.nu and servos.all() else None


def replace_drives(spec: Any) -> None:
    """Give every hinge and slide of a hand a weak position servo of its name, in place of the drives of its file."""
    while spec.actuators:
        spec.delete(spec.actuators[0])
    model = spec.copy().compile()
    names = {model.joint(joint).name for joint in leading_joints(model).tolist()}
    for joint in spec.joints:
        if joint.name in names:
            slides = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
            joint.armature = max(joint.armature, ARMATURE)
            stiffness, damping = WEAK_PUSH if slides else WEAK_SERVO
            spec.add_actuator(
                name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                gainprm=[stiffness] + [0.0] * 9, biasprm=[0.0, -stiffness, -damping] + [0.0] * 7,
            )  # fmt: skip


def leading_joints(model: Any) -> NDArray[np.intp]:
    """Return the numbers [J] of hinges and slides that do not follow from others through loops."""
    joints = np.flatnonzero(np.isin(model.jnt_type, (2, 3)))
    return joints[~np.isin(joints, list(Tree(model).followers - {each[0] for each in coupled(model)}))]


def palm_surface(hand: Hand) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return where the palm is: its outward direction [3], the middle of its pad [3] and a step [3] (m, palm frame).

    The step leads along the palm from the pad to the mean root of the fingers.
    """
    facing = palmar_directions(hand.model, hand.palm, hand.fingers)
    if hand.palm not in facing:
        raise UsageError(f"The joints of hand {hand.name!r} do not tell which side of {hand.palm!r} the palm is.")
    up = facing[hand.palm]
    surface = np.zeros(3)
    with contextlib.suppress(UsageError):
        pad = hand.layout("low", "palm")[hand.palm]
        surface = pad.position[pad.active].mean(axis=0)
    data = mujoco.MjData(hand.model)
    mujoco.mj_kinematics(hand.model, data)
    palm = hand.model.body(hand.palm).id
    roots = np.array([data.xpos[hand.model.body(chain[0]).id] for chain in hand.fingers.values()])
    # The thumb's root lies apart from the others.
    middle = np.median((roots - data.xpos[palm]) @ data.xmat[palm].reshape(3, 3), axis=0)
    step = middle - surface
    return up, surface, step - up * (step @ up)
