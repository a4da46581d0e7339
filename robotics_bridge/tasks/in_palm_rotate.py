"""in_palm_rotate: thumb and middle finger roll a block on the open palm, quarter turn by quarter turn.

Values of ``published`` are those of the thesis (tables 4.4, 4.5, 4.7–4.9) and, where it is silent, of the settings
released with it (neuroagents-lab/tactile-genesis).
"""

from __future__ import annotations

from dataclasses import replace

from robotics_bridge.sensors.taxels.sensors import PUBLISHED_TWIST
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.goals import SteppingRotation
from robotics_bridge.tasks.objects import PRIMITIVES
from robotics_bridge.tasks.registry import bounded, register
from robotics_bridge.tasks.settings import AuxiliaryDecoder, StudentSettings, TeacherSettings
from robotics_bridge.tasks.task import Ending, ObjectRandomisation, ObservationNoise, Placement, Push, Reward, Task

PALM_UP = (0.7071067811865476, 0.0, -0.7071067811865475, 0.0)
"""The palm faces up, the fingers point along −x."""
GOALS = 15
PUBLISHED_GOAL = SteppingRotation(axis=(-1.0, 0.0, 0.0), step=1.570795, threshold=0.1, allowed_off_axis=0.5235983333)
FLAT_GOAL = replace(PUBLISHED_GOAL, lying_flat=True, by_looks=True)
"""Goals at which every object can lie on the palm."""
CUPPED = {
    "right_hand_thumb_bend_joint": 1.2, "right_hand_thumb_rota_joint1": 0.25, "right_hand_thumb_rota_joint2": 0.8,
    "right_hand_mid_joint1": 0.5, "right_hand_mid_joint2": 0.8,
}  # fmt: skip
"""Thumb opposite the palm, middle finger half bent, both just off the block [rad]."""


@register("in_palm_rotate", "published")
def published() -> Task:
    """Return the published task."""
    return Task(
        name="in_palm_rotate",
        text="roll a block about the fingers' axis, thumb and middle finger only",
        objects=PRIMITIVES,
        placement=Placement(height=0.5, x=(-0.02, 0.02), y=(-0.02, 0.02), yaw=(-0.2617991666, 0.2617991666)),
        hand_poses={"xhand1": ((0.07, 0.0, 0.475), PALM_UP), "sharpa": ((0.07, -0.015, 0.48), PALM_UP)},
        moves=("thumb", "mid"),
        goal=PUBLISHED_GOAL,
        taxel_twist=PUBLISHED_TWIST,
        rewards={
            "success_bonus": Reward(150.0, terms.goal_reached),
            "rotation_progress": Reward(2.0, terms.rotation_progress, {"clip": 6.0, "penalty_scale": 5.0}),
            "surface_distance_reward": Reward(0.1, terms.near_surface, {"nearest_k": 1, "sigma": 0.04}),
            "is_dropped": Reward(-100.0, terms.ended, {"names": ("obj_dropped",)}),
            "off_axis_orientation_penalty": Reward(-1.0, terms.off_axis),
            "obj_dist_penalty": Reward(-100.0, terms.far_from, {"target": (0.0, 0.0, 0.5), "margin": 0.02}),
            "obj_force_penalty": Reward(-5.0, terms.squeezed, {"threshold": 1.0, "clip": 20.0}),
            "action_rate_penalty": Reward(-0.0005, terms.action_rate),
            "joint_limits_penalty": Reward(-40.0, terms.beyond_limits),
            "work_penalty": Reward(-0.005, terms.work),
        },
        endings={
            "obj_dropped": Ending(terms.below, {"height": 0.45}),
            "reached_max_consecutive_successes": Ending(terms.enough_goals, {"count": GOALS}),
        },
        episode=10.0,
        object_changes=ObjectRandomisation(friction=(0.5, 1.5), mass_offset=(0.0, 0.1)),
        push=Push(x=(-1.0, 1.0), y=(-1.0, 1.0), z=(-1.0, 1.0), interval=(2.0, 4.0)),
        noise=ObservationNoise(position=0.005, velocity=0.005),
        goal_terms=("angle",),
        auxiliary=("aux_obj_size", "aux_goal_dist"),
        groups={
            "actor": ("goal", "priv_proprio", "priv_obj_state"),
            **dict.fromkeys(("critic", "rnd_state"), ("goal", "priv_proprio", "priv_obj_state", "priv_obj_props")),
            # Table 4.7 gives the student the goal; the released settings of this task leave it out.
            "student": ("proprio", "goal"),
        },
        decoders=(
            AuxiliaryDecoder("aux_obj_size", 1.0, 20.0, (128, 64)),
            AuxiliaryDecoder("aux_goal_dist", 1.0, 1.0, (128, 64)),
        ),
        teacher=TeacherSettings(iterations=6000),
        student=StudentSettings(iterations=6000, learning_rate=1e-4, gradient_length=2, max_grad_norm=2.0),
    )


@register("in_palm_rotate")
def default() -> Task:
    """Return the task on which we train; it differs from the published one in these points.

    Actions are counted from a cupped hand instead of a flat one: from there random actions turn the block now and
    then. Goals are orientations in which an object lies flat on the palm. Rotation weighs more, but only slow turns
    count, and so does coming nearer to the goal in every direction; reaching it pays; the goal begins wide. The block's
    place is where it lies, 2 cm higher, so that lying still costs nothing. Without the approach to the goal, teachers
    threw the block round and lost it. Contacts, actions and taxels are those of
    :func:`~robotics_bridge.tasks.registry.bounded`.
    """
    task = bounded(published())
    rewards = {
        **task.rewards,
        "success_bonus": Reward(800.0, terms.goal_reached),
        "rotation_progress": Reward(5.0, terms.rotation_progress, {"clip": 2.5, "penalty_scale": 1.0}),
        "goal_approach": Reward(10.0, terms.approach, {"clip": (-1000.0, 2.5), "negative_scale": 1.0}),
        "off_axis_orientation_penalty": Reward(-5.0, terms.off_axis),
        "obj_dist_penalty": Reward(-100.0, terms.far_from, {"target": (0.0, 0.0, 0.52), "margin": 0.04}),
    }
    settings = replace(task.teacher, std_range=(0.2, 1.2))
    goal = replace(FLAT_GOAL, start_threshold=0.4)
    return replace(task, joints={"xhand1": CUPPED}, rewards=rewards, teacher=settings, goal=goal)


@register("in_palm_rotate", "careful")
def careful() -> Task:
    """Return what a teacher goes on with that reaches goals on the default, but drops the block after one or two.

    A drop costs twice as much, a goal pays twice as much, squeezing costs less; the goal is narrow from the start.
    """
    task = default()
    rewards = {
        **task.rewards,
        "is_dropped": Reward(-200.0, terms.ended, {"names": ("obj_dropped",)}),
        "success_bonus": Reward(1600.0, terms.goal_reached),
        "obj_force_penalty": Reward(-2.0, terms.squeezed, {"threshold": 1.0, "clip": 20.0}),
    }
    settings = replace(
        task.teacher, rnd_weight=50.0, learning_rate=3e-4, learning_rate_range=(1e-4, 3e-3), std_range=(0.2, 1.0)
    )
    return replace(task, rewards=rewards, teacher=settings, goal=FLAT_GOAL)
