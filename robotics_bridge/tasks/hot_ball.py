"""hot_ball: rummage a tilted bin for the one hot ball of eight, known by touch alone.

Section 4.6.3 of the thesis gives the bin, the balls, temperatures, latch, metric and times; rewards, materials and how
the hand is carried are not published and ours. The hand hangs from slides along x, y and z, fingers down.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from brainbench.core.devices import mujoco_module
from robotics_bridge.sensors.taxels.sensors import PUBLISHED_TWIST
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.objects import ball
from robotics_bridge.tasks.registry import bounded, register
from robotics_bridge.tasks.settings import StudentSettings, TeacherSettings
from robotics_bridge.tasks.task import ObservationNoise, Placement, Reward, Success, Task
from robotics_bridge.tasks.thermometers import ThermalSettings, Thermometers

if TYPE_CHECKING:
    import torch

    from robotics_bridge.tasks.step_context import StepContext

SIDE, WALL, HEIGHT, TILT = 0.5, 0.0125, 0.25, math.radians(10)
"""Outer edge of the bin, thickness of its walls and floor, its height [m], and how far it leans about y [rad]."""
BALLS, DIAMETER = 8, 0.08
_SPANS = {"x": (-0.22, 0.22), "y": (-0.22, 0.22), "z": (-0.2, 0.05)}
"""Distance that the hand can be carried from above the middle of the bin [m]."""
LOWER = 0.08
"""How much lower than published the hand begins on the task on which we train [m]; it can be carried as far."""
_SITES = tuple((0.13 * (i - 1), 0.13 * (j - 1), -0.13 * (i - 1) * math.sin(TILT)) for i in range(3) for j in range(3))


def bin_walls(spec: Any) -> None:
    """Add the tilted bin, its floor's middle at the origin."""
    mujoco = mujoco_module()
    body = spec.worldbody.add_body(name="bin", quat=(math.cos(TILT / 2), 0.0, math.sin(TILT / 2), 0.0))
    edge, half, top = SIDE / 2, WALL / 2, HEIGHT / 2
    walls = [((0.0, 0.0, -half), (edge, edge, half))]
    for place in (half - edge, edge - half):
        walls += [((place, 0.0, top), (half, edge, top)), ((0.0, place, top), (edge, half, top))]
    for index, (position, size) in enumerate(walls):
        body.add_geom(name=f"bin_{index}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=position, size=size)


def extra(m: StepContext, *, name: str) -> torch.Tensor:
    """Return what the thermometers add to a control step [B]: ``progress``, ``latched``, ``touching``, ``holding``."""
    return m.extras[name]


def reach(m: StepContext, *, sigma: float) -> torch.Tensor:
    """Return exp(−d/σ) of the distance d (m) from the nearest finger tip to the hot ball's centre."""
    return (-m.extras["reach"] / sigma).exp()


@register("hot_ball", "published")
def published() -> Task:
    """Return the task of section 4.6.3 at the cell of figure 4.8 that succeeds (150 W/(m·K), 0.5, 500 W/m²)."""
    return with_thermal(ThermalSettings())


def with_thermal(thermal: ThermalSettings) -> Task:
    """Return the task for fingers and balls of other materials."""
    # The palm faces uphill, so that the thumb stays within the bin.
    down = ((0.0, 0.0, 0.42), (0.0, 0.0, 1.0, 0.0))
    return Task(
        name="hot_ball",
        text="find the hot ball among eight by touch and stay in contact",
        objects=(ball(DIAMETER / 2),),
        copies=BALLS,
        placement=Placement(height=0.01, x=(-0.015, 0.015), y=(-0.015, 0.015), sites=_SITES),
        hand_poses={"xhand1": down, "sharpa": down},
        joints={"xhand1": {"right_hand_thumb_bend_joint": 1.5}},
        carriage={axis: (span, 2000.0, 120.0, 100.0) for axis, span in _SPANS.items()},
        furniture=bin_walls,
        task_state=partial(Thermometers, thermal=thermal),
        taxel_twist=PUBLISHED_TWIST,
        rewards={
            "reach": Reward(1.0, reach, {"sigma": 0.1}),
            "warmth": Reward(5.0, extra, {"name": "progress"}),
            "holding": Reward(20.0, extra, {"name": "holding"}),
            "action_rate_penalty": Reward(-0.002, terms.action_rate),
            "joint_limits_penalty": Reward(-20.0, terms.beyond_limits),
            "work_penalty": Reward(-0.0002, terms.work),
        },
        # Success is S > 0: one control step of latched contact.
        success=Success(metric="contact", threshold=0.025),
        episode=20.0,
        noise=ObservationNoise(position=0.005, velocity=0.005),
        groups={
            **dict.fromkeys(("actor", "critic", "rnd_state"), ("priv_proprio", "priv_obj_state", "priv_thermal")),
            "student": ("proprio", "thermal"),
        },
        teacher=TeacherSettings(iterations=5000),
        student=StudentSettings(iterations=2000),
    )  # fmt: skip


@register("hot_ball")
def default() -> Task:
    """Return the task on which we train; it differs from the published one in these points.

    The area of a contact follows from its overlap and a radius, which is not published: here it is that of the balls.
    With the 5 mm of the published task the latch cannot close under firm contacts, which overlap less: after 10 s on
    the hot ball fingers have 27 °C. The carriage moves at .5 m/s at most, and the hand begins 8 cm lower, because
    random actions from higher up do not meet a ball. The way is paid by the distance to the surface of the nearest
    ball, hot or not, which is 0 in a touch, and which teachers read; touching the hot ball is paid before it is warm.
    Actions begin smaller. Contacts, actions and taxels are those of
    :func:`~robotics_bridge.tasks.registry.bounded`.
    """
    task = bounded(with_thermal(ThermalSettings(contact_radius=DIAMETER / 2)))
    x, y, z = (task.carriage[axis] for axis in "xyz")
    rewards = {
        **task.rewards,
        "reach": Reward(2.0, terms.near_surface, {"nearest_k": 1, "sigma": 0.1}),
        "touch": Reward(3.0, extra, {"name": "touching"}),
    }
    settings = replace(
        task.teacher, discount=0.99, initial_std=0.6, std_range=(0.1, 1.0), rnd_weight=0.0, learning_rate=5e-4,
        learning_rate_range=(1e-4, 3e-3),
    )  # fmt: skip
    return replace(
        task, rewards=rewards, teacher=settings, distances_in="priv_obj_state",
        hand_poses={hand: ((*place[:2], place[2] - LOWER), turn) for hand, (place, turn) in task.hand_poses.items()},
        carriage={"x": x, "y": y, "z": ((z[0][0] + LOWER, z[0][1] + LOWER), *z[1:])},
    )  # fmt: skip
