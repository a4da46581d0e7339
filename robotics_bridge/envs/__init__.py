"""Batched environments of dexterous tasks, and adapters to rsl_rl and gymnasium."""

from __future__ import annotations

from robotics_bridge.envs.actions import ActionMap
from robotics_bridge.envs.env import ENGINES, Env

__all__ = ["ENGINES", "ActionMap", "Env"]
