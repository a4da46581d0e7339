"""Dexterous tasks as data, and the environments that run them.

``make`` builds the batched environment of a task; ``load`` returns the task itself, ``register`` adds one of your own.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from robotics_bridge.tasks.registry import forget, list_tasks, load, register
from robotics_bridge.tasks.settings import AuxiliaryDecoder, StudentSettings, TeacherSettings
from robotics_bridge.tasks.task import (
    ActuatorRandomisation,
    Ending,
    ObjectRandomisation,
    Placement,
    Push,
    Reward,
    Success,
    Task,
)

if TYPE_CHECKING:
    from robotics_bridge.envs.env import Env
    from robotics_bridge.hands import Hand

__all__ = [
    "ActuatorRandomisation",
    "AuxiliaryDecoder",
    "Ending",
    "ObjectRandomisation",
    "Placement",
    "Push",
    "Reward",
    "StudentSettings",
    "Success",
    "Task",
    "TeacherSettings",
    "forget",
    "list_tasks",
    "load",
    "make",
    "register",
]


def make(
    name: str | Task,
    *,
    num_envs: int = 1,
    device: str = "cpu",
    hand: str | os.PathLike[str] | Hand = "xhand1",
    config: str = "default",
    observe: str = "none",
    placement: str = "hand",
    resolution: str = "med",
    noisy: bool = False,
    seed: int = 0,
    engine: str | None = None,
    **options: Any,
) -> Env:
    """Return the batched environment of a task.

    Args:
        name: of a task (:func:`list_tasks`), or a :class:`Task`.
        num_envs: number of environments B.
        device: ``cpu`` or ``cuda``.
        hand: a hand, its name, or the path of a URDF or MJCF file.
        config: configuration of a named task: ``default`` or ``published``.
        observe: tactile observation type (``brainbench policy observations`` lists them); ``none`` builds no sensor.
        placement: ``hand``, ``fingers``, ``tips`` or ``palm``.
        resolution: of the taxels: ``low``, ``med`` or ``high``.
        noisy: with the published imperfections of the sensors.
        seed: of all random numbers.
        engine: ``mujoco`` or ``warp``; by default C MuJoCo on processors and MuJoCo Warp on GPUs.
        **options: further arguments of :class:`~robotics_bridge.envs.env.Env`.

    Raises:
        UsageError: a name or number is not valid.

    Example::

        env = tasks.make("in_palm_rotate", num_envs=16, observe="force_torque")
        observations = env.reset()
        observations, reward, terminated, truncated, info = env.step(torch.zeros(16, env.num_actions))
    """
    from robotics_bridge import hands
    from robotics_bridge.envs.env import Env

    task = name if isinstance(name, Task) else load(name, config)
    used = hand if isinstance(hand, hands.Hand) else hands.load(hand)
    return Env(
        task, used, num_envs=num_envs, device=device, engine=engine, observe=observe, placement=placement,
        resolution=resolution, noisy=noisy, seed=seed, **options,
    )  # fmt: skip
