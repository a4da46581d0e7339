"""Other numbers for a task in words, as they stand in commands: ``is_dropped=-300``, ``goal.threshold=0.2``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from typing import Any

from brainbench.core.errors import check_name, unknown_name
from brainbench.core.overrides import kind_of, read_pairs, read_value, with_changes
from robotics_bridge.tasks.contact_model import CONTACTS
from robotics_bridge.tasks.task import Ending, Reward, Task


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
