"""Batched environments of dexterous tasks, and adapters to rsl_rl and gymnasium.

``options`` say how a task is simulated; ``state`` holds the parts and the memory of a batch; ``reset`` begins episodes;
``step`` goes from an action over physics to ``observations`` and rewards; ``env`` puts them together.
"""

from __future__ import annotations

from robotics_bridge.envs.env import Env
from robotics_bridge.envs.options import ENGINES, EnvOptions
from robotics_bridge.envs.step import ActionMap

__all__ = ["ENGINES", "ActionMap", "Env", "EnvOptions"]
