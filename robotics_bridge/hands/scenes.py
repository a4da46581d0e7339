"""A hand with the palm up and an object on it: the smallest scene in which every sensor has something to read."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.core.rotations import to_matrices
from robotics_bridge.hands.hand import Hand, palmar_directions

mujoco = mujoco_module()

OBJECT = "object"
"""Name of the free body and of its geometry."""
_STIFFNESS, _DAMPING, _ARMATURE = 2.0, 0.2, 0.01
"""Servo of a hinge without a drive: N·m/rad, N·m·s/rad, kg·m²."""


def holding(hand: Hand, **settings: float) -> Any:
    """Return the ``mujoco.MjModel`` of a hand, palm up, with a ball just above the palm; see :func:`holding_spec`."""
    return _raised(holding_spec(hand, **settings).compile())


def holding_spec(hand: Hand, *, radius: float = 0.03, timestep: float = 0.002, reach: float = 0.6) -> Any:
    """Return the ``mujoco.MjSpec`` behind :func:`holding`: the palm's surface below the ball is at z = 0.

    A hand whose file has no drives (a URDF) gets a weak position servo on every hinge. The ball of 100 g has a
    ``radius`` [m] and lies between the middle of the palm (``reach`` 0) and the roots of the fingers (1).

    Raises:
        UsageError: the palm's side is unknown, or the radius is not positive.
    """
    check_number("radius of the ball (m)", radius, above=0)
    up, surface, step = palm_surface(hand)
    # Between the middle of the palm and the roots of the fingers, where these reach it when they close.
    surface = surface + reach * step
    spec = hand.mjspec()
    spec.option.timestep = timestep
    if not hand.model.nu:
        _add_servos(spec)
    palm = spec.body(hand.palm)
    turn = _onto_z(up)
    palm.quat, palm.pos = turn, -to_matrices(turn) @ surface
    ball = spec.worldbody.add_body(name=OBJECT, pos=(0.0, 0.0, radius + 1e-3))
    ball.add_freejoint()
    ball.add_geom(
        name=OBJECT, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(radius, 0, 0), mass=0.1, condim=4,
        friction=(1.0, 0.01, 1e-4),
    )  # fmt: skip
    return spec


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


def closing(hand: Hand, share: float) -> NDArray[np.float64]:
    """Return servo targets [joints] (rad) at which every joint is flexed by a share of its range from 0."""
    model = hand.model
    joints = model.actuator_trnid[:, 0] if model.nu else np.arange(model.njnt)
    low, high = model.jnt_range[joints].T
    # Flexion is the longer side of a joint's range.
    target = np.where(np.abs(high) >= np.abs(low), high, low) * share
    # Joints that spread the fingers stay in their middle.
    return np.where(np.abs(high + low) < 0.5 * np.ptp(model.jnt_range[joints], axis=1), 0.0, target)


def _add_servos(spec: Any) -> None:
    """Give every hinge of a hand without drives, as URDF files are, a weak position servo."""
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.armature = max(joint.armature, _ARMATURE)
            spec.add_actuator(
                name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                gainprm=[_STIFFNESS] + [0.0] * 9, biasprm=[0.0, -_STIFFNESS, -_DAMPING] + [0.0] * 7,
            )  # fmt: skip


def palm_surface(hand: Hand) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return where the palm is: its outward direction [3], the middle of its pad [3] and a step [3] (m, palm frame).

    The step leads along the palm from the pad to the mean root of the fingers.

    Raises:
        UsageError: the joints do not tell which side the palm is.
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


def _onto_z(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quaternion (w, x, y, z) of the shortest turn of a unit vector onto z."""
    z = np.array([0.0, 0.0, 1.0])
    # Shortest turn between unit vectors: (1 + a · b, a × b), normalised. It vanishes for opposite ones, which are
    # turned about x.
    axis, cosine = np.cross(direction, z), float(direction @ z)
    if cosine < -0.999999:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quaternion = np.array([1.0 + cosine, *axis])
    return quaternion / np.linalg.norm(quaternion)
