"""in_hand_repose: the whole hand turns a block to orientations given one after the other, each with a deadline.

Values of ``published`` are those of the thesis (tables 4.4, 4.5, 4.7–4.9) and, where it is silent, of the settings
released with it (neuroagents-lab/tactile-genesis).
"""

from __future__ import annotations

from dataclasses import replace

from robotics_bridge.sensors.taxels.sensors import PUBLISHED_TWIST
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.goals import TimedRotation
from robotics_bridge.tasks.in_palm_rotate import CUPPED, PALM_UP
from robotics_bridge.tasks.objects import PRIMITIVES
from robotics_bridge.tasks.registry import bounded, register
from robotics_bridge.tasks.settings import StudentSettings, TeacherSettings
from robotics_bridge.tasks.task import Ending, ObjectRandomisation, ObservationNoise, Placement, Push, Reward, Task

ALL_CUPPED = CUPPED | {
    f"right_hand_{finger}_joint{joint}": angle
    for finger in ("index", "ring", "pinky")
    for joint, angle in ((1, 0.5), (2, 0.8))
}
"""The hand of in_palm_rotate with all fingers half bent [rad]."""


@register("in_hand_repose", "published")
def published() -> Task:
    """Return the published task."""
    return Task(
        name="in_hand_repose",
        text="turn a block in the open hand to given orientations",
        objects=PRIMITIVES,
        placement=Placement(height=0.5, x=(-0.02, 0.02), y=(-0.02, 0.02), yaw=(-3.14159, 3.14159)),
        hand_poses={"xhand1": ((0.07, 0.0, 0.475), PALM_UP), "sharpa": ((0.07, -0.015, 0.48), PALM_UP)},
        goal=TimedRotation(threshold=0.1, tilt=(-0.7853975, 0.7853975), deadline=(4.0, 6.0)),
        taxel_twist=PUBLISHED_TWIST,
        rewards={
            "success_bonus": Reward(500.0, terms.goal_reached),
            "track_orientation_gaussian": Reward(2.0, terms.orientation_gaussian, {"sigma": 0.4}),
            "track_orientation_inv_l2": Reward(2.0, terms.orientation_inverse, {"rot_eps": 0.001}),
            "rotation_progress": Reward(0.2, terms.approach, {"clip": (-15.0, 5.0), "negative_scale": -2.0}),
            "obj_force_penalty": Reward(-5.0, terms.squeezed, {"threshold": 5.0, "clip": 20.0}),
            "is_dropped": Reward(-100.0, terms.ended, {"names": ("obj_dropped",)}),
            "goal_timeout_penalty": Reward(-200.0, terms.goal_missed),
            "surface_distance_reward": Reward(0.5, terms.near_surface, {"nearest_k": 2, "sigma": 0.05}),
            "action_rate_penalty": Reward(-1e-5, terms.action_rate),
            "joint_limits_penalty": Reward(-20.0, terms.beyond_limits),
            "work_penalty": Reward(-0.001, terms.work),
        },
        endings={"obj_dropped": Ending(terms.below, {"height": 0.46})},
        episode=20.0,
        object_changes=ObjectRandomisation(friction=(0.3, 2.0), mass_offset=(0.0, 0.1), each_reset=False),
        push=Push(x=(-1.0, 1.0), y=(-1.0, 1.0), z=(-1.0, 1.0), interval=(2.0, 4.0)),
        noise=ObservationNoise(position=0.005, velocity=0.01),
        command=("orientation",),
        goal_terms=("orientation", "difference", "angle"),
        groups={
            "actor": ("goal", "priv_proprio", "priv_obj_state"),
            **dict.fromkeys(("critic", "rnd_state"), ("goal", "priv_proprio", "priv_obj_state", "priv_obj_props")),
            "student": ("proprio", "goal"),
        },
        # The released teacher of this task was trained without curiosity.
        teacher=TeacherSettings(iterations=20000, rnd_weight=0.0),
        student=StudentSettings(iterations=6000, learning_rate=1e-4, gradient_length=2),
    )


@register("in_hand_repose")
def default() -> Task:
    """Return the task on which we train; it differs from the published one in these points.

    Actions are counted from a cupped hand: from a flat one, random actions do not touch the block (of 96 blocks none
    tilts within 5 s; from a cupped hand some lean a tenth of the time). Reaching a goal pays more and being near it
    less: as published, a block that stays just outside the threshold until the deadline earns more than one that
    reaches it. Approach is not paid by itself, which keeps hands still at first, and squeezing costs less. The goal
    begins wide, and narrows while four episodes of five reach one: doing nothing reaches one of four within .25 rad.
    Contacts, actions and taxels are those of :func:`~robotics_bridge.tasks.registry.bounded`.
    """
    task = bounded(published())
    rewards = {
        **{name: reward for name, reward in task.rewards.items() if name != "rotation_progress"},
        "success_bonus": Reward(1600.0, terms.goal_reached),
        "track_orientation_inv_l2": Reward(1.0, terms.orientation_inverse, {"rot_eps": 0.1}),
        "obj_force_penalty": Reward(-0.3, terms.squeezed, {"threshold": 5.0, "clip": 20.0}),
    }
    settings = replace(task.teacher, std_range=(0.2, 1.2), learning_rate=5e-4, learning_rate_range=(1e-4, 3e-3))
    goal = task.goal and replace(task.goal, start_threshold=0.6, mastered=0.8)
    return replace(task, joints={"xhand1": ALL_CUPPED}, rewards=rewards, teacher=settings, goal=goal)
