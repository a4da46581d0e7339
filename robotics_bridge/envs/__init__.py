"""Batched environments of dexterous tasks, and adapters to rsl_rl and gymnasium.

``simulation`` has options, physics, actuators and what is felt; ``state`` holds parts and memory of a batch; ``step``
begins episodes and goes from an action over physics to rewards and observations; ``env`` puts them together.
"""

from __future__ import annotations

from robotics_bridge.envs.env import Env
from robotics_bridge.envs.simulation import ENGINES, EnvOptions
from robotics_bridge.envs.step import ActionMap

__all__ = ["ENGINES", "ActionMap", "Env", "EnvOptions"]
