"""The registry of tasks, one decorator per configuration, and other numbers for a task in words."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from importlib import import_module
from typing import Any

from brainbench.core.errors import DataError, UsageError, check_name, unknown_name
from brainbench.core.limits import kind_of, read_pairs, read_value, with_changes
from brainbench.core.plugins import foreign_code
from robotics_bridge.tasks.settings import CONTACTS
from robotics_bridge.tasks.task import ACTION_LIMIT, Ending, Reward, Task


def apply_overrides(task: Task, words: Iterable[str]) -> Task:
    """Return a task with other numbers.

    A word is ``name=value``. The name is that of a reward term (its weight), ``term.parameter``, ``ending.parameter``,
    a field of :class:`~robotics_bridge.tasks.settings.TeacherSettings`, or a field of the task, by dots into its parts:
    ``is_dropped=-300``, ``rotation_progress.clip=2``, ``obj_dropped.height=0.44``, ``entropy=0``,
    ``learning_rate_range=1e-4,1e-3``, ``episode=15``, ``goal.start_threshold=0.4``, ``object_changes.friction=0.8,1``,
    ``contacts=firm``, ``contacts.time_constant=0.01``, ``objects=box,cylinder,cylinder`` (all the task's objects whose
    names begin so; named twice, they are twice as many).
    """
    for name, text in read_pairs(words, "--change", "is_dropped=-300").items():
        task = _changed(task, name.split("."), text)
    return task


def _changed(task: Task, path: list[str], text: str) -> Task:
    """Return a task with one other number, by the dotted name of where it stands."""
    first, *rest = path
    for part in ("rewards", "endings"):
        terms: Mapping[str, Reward | Ending] = getattr(task, part)
        if first in terms:
            return replace(task, **{part: {**terms, first: _term(first, terms[first], rest, text)}})
    if first in _names(task.teacher):
        return replace(task, teacher=with_changes(task.teacher, {".".join(path): text}))
    if path == ["contacts"]:
        check_name("contacts of a task", text, CONTACTS)
        return replace(task, contacts=CONTACTS[text])
    if path == ["objects"]:
        return replace(task, objects=_objects(task, text))
    if first in _names(task):
        return with_changes(task, {".".join(path): text})
    choices = (*task.rewards, *task.endings, *_names(task.teacher), *_names(task))
    raise unknown_name(f"number of task {task.name!r}", first, choices)


def _term(name: str, term: Any, rest: list[str], text: str) -> Any:
    if not rest and isinstance(term, Reward):
        return replace(term, weight=read_value(name, text, float, term.weight))
    check_name(f"parameter of {name!r}", key := ".".join(rest), term.params)
    present = term.params[key]
    return replace(term, params={**term.params, key: read_value(f"{name}.{key}", text, kind_of(present), present)})


def _objects(task: Task, text: str) -> tuple[Any, ...]:
    """Return all objects of a task whose names begin with one of some words, in their order."""
    kinds: dict[str, list[Any]] = {}
    for shape in task.objects:
        kinds.setdefault(shape.name.partition(" ")[0], []).append(shape)
    for kind in (words := text.split(",")):
        check_name("kind of object of the task", kind, kinds)
    return tuple(shape for kind in words for shape in kinds[kind])


def _names(subject: Any) -> list[str]:
    return [field.name for field in fields(subject)]


Maker = Callable[[], Task]
_MADE: dict[str, dict[str, Maker]] = {}
_SHIPPED = {
    "in_palm_rotate": "turning", "in_hand_repose": "turning", "screwdriver": "turning", "hot_ball": "hot_ball",
}  # fmt: skip
"""Task of the package → the module that registers it, imported when the task is loaded."""


def register(name: str, config: str = "default") -> Callable[[Maker], Maker]:
    """Register a function without arguments that returns a :class:`Task`; every task needs the config ``default``.

    Example::

        @register("balance")
        def balance() -> Task:
            return Task(name="balance", ...)
    """

    def _keep(maker: Maker) -> Maker:
        shipped = name in _SHIPPED and not maker.__module__.startswith("robotics_bridge.tasks.")
        if shipped or config in _MADE.get(name, {}):
            raise UsageError(f"There is a task {name!r} with a configuration {config!r} already; take another name.")
        _MADE.setdefault(name, {})[config] = maker
        return maker

    return _keep


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
    check_name("task of yours", name, [n for n in _MADE if n not in _SHIPPED])
    del _MADE[name]


def list_tasks() -> tuple[str, ...]:
    """Return the names of all registered tasks."""
    return (*_SHIPPED, *(name for name in _MADE if name not in _SHIPPED))


def load(name: str, config: str = "default") -> Task:
    """Return a task in one of its configurations (``default``, ``published``, …)."""
    if name in _SHIPPED:
        import_module(f"robotics_bridge.tasks.{_SHIPPED[name]}")
    hint = "A task of your own: import its file first (brainbench policy: --task-file FILE)."
    check_name("task", name, list_tasks(), hint=hint)
    check_name(f"configuration of task {name}", config, _MADE[name])
    with foreign_code(f"The task {name!r}"):
        task = _MADE[name][config]()
    if not isinstance(task, Task):
        raise DataError(f"The task {name!r} is a {type(task).__name__}; what is registered returns a Task.")
    return task
