"""Other numbers for a task in words, as they stand in commands: ``is_dropped=-300``, ``goal.threshold=0.2``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from brainbench.core.errors import UsageError, check_name, check_once, shown, unknown_name
from robotics_bridge.tasks.contact_model import CONTACTS, ContactModel
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
    words = list(words)
    check_once("--change", [word.partition("=")[0] for word in words])
    for word in words:
        name, sign, value = word.partition("=")
        if not (name and sign and value):
            raise UsageError(f"A change of a task is written name=value, e.g. is_dropped=-300; received {shown(word)}.")
        task = _one(task, name.split("."), value)
    return task


def _one(task: Task, path: list[str], value: str) -> Task:
    first, *rest = path
    for part in ("rewards", "endings"):
        terms: Mapping[str, Reward | Ending] = getattr(task, part)
        if first in terms:
            return replace(task, **{part: {**terms, first: _term(first, terms[first], rest, value)}})
    if first in _names(task.teacher):
        return replace(task, teacher=set_field(task.teacher, path, value))
    if first in _names(task):
        return set_field(task, path, value)
    known = (*task.rewards, *task.endings, *_names(task.teacher), *_names(task))
    raise unknown_name(f"number of task {task.name!r}", first, known)


def _term(name: str, term: Any, rest: list[str], value: str) -> Any:
    if not rest and isinstance(term, Reward):
        return replace(term, weight=_read(name, value, term.weight))
    check_name(f"parameter of {name!r}", key := ".".join(rest), term.params)
    return replace(term, params={**term.params, key: _read(f"{name}.{key}", value, term.params[key])})


def set_field(subject: Any, path: list[str], value: str) -> Any:
    """Return a frozen dataclass with another value of the field at the end of a path, read as the present one is."""
    first, *rest = path
    check_name(f"field of {type(subject).__name__}", first, _names(subject))
    present = getattr(subject, first)
    if rest:
        if not is_dataclass(present):
            raise UsageError(f"{first!r} has no parts; received {shown('.'.join(path))}.")
        return replace(subject, **{first: set_field(present, rest, value)})
    if isinstance(present, ContactModel):
        check_name("contacts of a task", value, CONTACTS)
        return replace(subject, **{first: CONTACTS[value]})
    if first == "objects":
        kinds: dict[str, list[Any]] = {}
        for shape in present:
            kinds.setdefault(shape.name.partition(" ")[0], []).append(shape)
        for kind in (named := value.split(",")):
            check_name("kind of object of the task", kind, kinds)
        return replace(subject, objects=tuple(shape for kind in named for shape in kinds[kind]))
    if value == "none" and any(field.name == first and field.default is None for field in fields(subject)):
        return replace(subject, **{first: None})
    return replace(subject, **{first: _read(first, value, present)})


def _names(subject: Any) -> list[str]:
    return [field.name for field in fields(subject)]


def _read(name: str, text: str, present: Any) -> Any:
    """Return a value of the kind of the present one."""
    try:
        if isinstance(present, str):
            return text
        if isinstance(present, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(present, int):
            number = _number(text)
            if number != int(number):
                raise ValueError
            return int(number)
        if present is None or isinstance(present, float):
            return _number(text)
        if isinstance(present, tuple) and all(isinstance(item, (int, float)) for item in present):
            kind = int if present and all(isinstance(item, int) for item in present) else _number
            return tuple(kind(part) for part in text.split(","))
    except (KeyError, ValueError):
        raise UsageError(f"{name!r} takes a value like {shown(present)}; received {shown(text)}.") from None
    raise UsageError(f"{name!r} is more than a number; change it with dataclasses.replace in a task file.")


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError
    return number
