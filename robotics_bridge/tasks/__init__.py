"""Dexterous tasks as data: scene, reward terms, goals, settings of learning.

``load`` returns a task, ``register`` adds one of your own, ``registry`` changes numbers in one. ``make`` builds the
batched environment of a task; it stands in ``robotics_bridge.envs``, is exported here by name alone and loaded on first
use, since tasks know nothing of environments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports
from robotics_bridge.tasks.registry import forget, list_tasks, load, register
from robotics_bridge.tasks.task import Reward, Task

if TYPE_CHECKING:
    from robotics_bridge.envs.env import make

__all__ = ["Reward", "Task", "forget", "list_tasks", "load", "make", "register"]

__getattr__, __dir__ = lazy_exports(__name__)
