"""Other values in words: ``links=12``, ``goal.threshold=0.2``; each is read as the annotation of its field says.

The words of a command, of a preset (``fast,links=12``) and of a list of faults are all read here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from brainbench.core.errors import UsageError, brief, check_name, check_once
from brainbench.core.limits import annotation_of

T = TypeVar("T")


def read_pairs(words: Iterable[str], where: str, example: str) -> dict[str, str]:
    """Return name → text of words ``name=text``; ``where`` names the option or text that they stand in.

    >>> read_pairs(["links=12", "solver = dynamic"], "--change", "links=12")
    {'links': '12', 'solver': 'dynamic'}
    """
    pairs = []
    for word in words:
        name, sign, text = (part.strip() for part in word.partition("="))
        if not (name and sign):
            raise UsageError(f"{where} takes name=value, such as {example}; received {brief(word)}.")
        pairs.append((name, text))
    check_once(where, [name for name, _ in pairs])
    return dict(pairs)


def with_changes(options: T, changes: Mapping[str, str]) -> T:
    """Return a frozen dataclass with other values; a name reaches fields of its parts by dots."""
    for name, text in changes.items():
        options = _changed(options, name.split("."), text)
    return options


def read_value(name: str, text: str, annotation: Any, present: Any = None) -> Any:
    """Return the value that a text states for an annotation; ``present`` is the value in its place, for messages."""
    kinds = [kind for kind in _arms(annotation) if kind is not NoneType]
    if text == "none" and len(kinds) < len(_arms(annotation)):
        return None
    readable = [kind for kind in kinds if kind in _READ or get_origin(kind) in (Literal, tuple)]
    if not readable:
        raise UsageError(f"{name!r} is more than a number; change it in Python, with dataclasses.replace.")
    for kind in readable:
        try:
            return _read(text, kind)
        except (KeyError, ValueError):
            continue
    words = " or ".join(_words(kind) for kind in readable)
    now = "" if present is None else f", for instance {brief(present)}"
    raise UsageError(f"{name!r} takes {words}{now}; received {brief(text)}.")


def kind_of(value: Any) -> Any:
    """Return the annotation of what may stand in place of a value that has none of its own."""
    if isinstance(value, tuple) and all(isinstance(inner, int | float) for inner in value):
        return tuple[int, ...] if value and all(isinstance(inner, int) for inner in value) else tuple[float, ...]
    return float if value is None else type(value)


def _changed(options: Any, path: list[str], text: str) -> Any:
    first, *rest = path
    check_name(f"field of {type(options).__name__}", first, [field.name for field in fields(options)])
    present = getattr(options, first)
    if not rest:
        return replace(options, **{first: read_value(first, text, annotation_of(type(options), first), present)})
    if not is_dataclass(present):
        raise UsageError(f"{first!r} has no parts; received {brief('.'.join(path))}.")
    return replace(options, **{first: _changed(present, rest, text)})


def _arms(annotation: Any) -> list[Any]:
    """Return the kinds that an annotation allows, without what is said of them."""
    if get_origin(annotation) is Annotated:
        return _arms(annotation.__origin__)
    if get_origin(annotation) in (Union, UnionType):
        return [arm for kind in get_args(annotation) for arm in _arms(kind)]
    return [annotation]


def _read(text: str, kind: Any) -> Any:
    if get_origin(kind) is Literal:
        return text  # the class itself names the nearest choice
    if get_origin(kind) is tuple:
        (inner,) = _arms(get_args(kind)[0])
        return tuple(_READ[inner][0](part.strip()) for part in text.split(","))
    return _READ[kind][0](text)


def _words(kind: Any) -> str:
    if get_origin(kind) is tuple:
        return "numbers joined by commas"
    return _READ[kind][1]


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError
    return number


def _whole(text: str) -> int:
    number = _number(text)
    if number != int(number):
        raise ValueError
    return int(number)


_READ: dict[Any, tuple[Any, str]] = {
    str: (str, "a text"),
    bool: (lambda text: {"true": True, "false": False}[text.lower()], "true or false"),
    int: (_whole, "a whole number"),
    float: (_number, "a number"),
}
"""Kind → its reader, and its name in messages."""
