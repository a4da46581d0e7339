"""The registry of tasks: one file per task, one decorator per configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module

from brainbench.core.errors import UsageError, check_name, unknown_name
from robotics_bridge.tasks.contact_model import CONTACTS
from robotics_bridge.tasks.task import ACTION_LIMIT, Task

Maker = Callable[[], Task]
_MADE: dict[str, dict[str, Maker]] = {}
_OWN = ("in_palm_rotate", "in_hand_repose", "screwdriver", "hot_ball")


def register(name: str, config: str = "default") -> Callable[[Maker], Maker]:
    """Register a function without arguments that returns a :class:`Task`; every task needs the config ``default``.

    Example::

        @register("balance")
        def balance() -> Task:
            return Task(name="balance", ...)
    """

    def keep(maker: Maker) -> Maker:
        own = name in _OWN and not maker.__module__.startswith("robotics_bridge.tasks.")
        if own or config in _MADE.get(name, {}):
            raise UsageError(f"There is a task {name!r} with a configuration {config!r} already; take another name.")
        _MADE.setdefault(name, {})[config] = maker
        return maker

    return keep


def bounded(task: Task) -> Task:
    """Return a published task as we train it: firm contacts, targets as on a hand, taxels that hold, commands.

    Actions are bounded, and targets move no faster than the joints are rated for. A student is told what to do and does
    not read the goal, which follows from the object's pose. Goals are judged by what an object looks like.
    """
    student = tuple(name for name in task.groups["student"] if name != "goal")
    groups = {**task.groups, "student": (*student, "command")}
    goal = task.goal and replace(task.goal, by_looks=True)
    return replace(
        task, contacts=CONTACTS["firm"], action_limit=ACTION_LIMIT, rated_speed=True, taxel_twist=None, groups=groups,
        goal=goal,
    )  # fmt: skip


def forget(name: str) -> None:
    """Remove a task that was registered; raise UsageError for any other, since tasks of the package stay."""
    if name not in _MADE or name in _OWN:
        raise unknown_name("task of yours", name, [n for n in _MADE if n not in _OWN])
    del _MADE[name]


def list_tasks() -> tuple[str, ...]:
    """Return the names of all registered tasks."""
    return (*_OWN, *(name for name in _MADE if name not in _OWN))


def load(name: str, config: str = "default") -> Task:
    """Return a task in one of its configurations (``default``, ``published``, …)."""
    if name in _OWN:
        import_module(f"robotics_bridge.tasks.{name}")
    if name not in _MADE:
        hint = "A task of your own: import its file first (brainbench policy: --task-file FILE)."
        raise unknown_name("task", name, list_tasks(), hint=hint)
    check_name(f"configuration of task {name}", config, _MADE[name])
    return _MADE[name][config]()
