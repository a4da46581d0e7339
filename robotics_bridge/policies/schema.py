"""Parsed JSON as classes whose annotations state kinds and ranges; errors name the place in the file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from brainbench.core.errors import DataError, check_each, repeats, shown

JOINTS = 255
"""Most joints; a frame counts them in one byte."""
MOST_NUMBERS = 10_000_000
"""Most numbers of all observations, and of a policy's memory."""
Name = Annotated[str, Meta(min_length=1, max_length=4096)]
Names = Annotated[tuple[Name, ...], Meta(min_length=1, max_length=JOINTS)]
Sizes = Annotated[tuple[Annotated[int, Meta(ge=1, le=MOST_NUMBERS)], ...], Meta(min_length=1, max_length=3)]
Groups = Annotated[tuple[tuple[Name, Sizes], ...], Meta(min_length=1)]
"""Group and shape of each observation; a list, since JSON keeps the order of lists alone."""

T = TypeVar("T")


def from_json(kind: type[T], values: Any, where: str) -> T:
    """Return parsed JSON of ``where``, a file or a place in one, as a class."""
    if is_dataclass(kind) and isinstance(values, Mapping):
        check_each(f"setting in {where!r}", values, kind.__dataclass_fields__)
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        fault, _, place = str(error).partition(" - at `$")
        found = values
        for step in re.findall(r"\w+|\[\.\.\.\]", place):
            if step == "[...]":  # an entry of a mapping, whose name is not told
                break
            found = found[int(step)] if isinstance(found, list) else found[step]
        raise wrong(where, place.strip(".`"), found, fault) from error


def wrong(where: str, place: str, received: Any, allowed: str) -> DataError:
    """Return the error for a value at a place of a file."""
    what = f"{place!r} in {where!r}" if place else repr(where)
    return DataError(f"{what} is {shown(received)}: {allowed.rstrip('.')}.")


def shapes_of(groups: Groups, where: str, place: str) -> dict[str, tuple[int, ...]]:
    """Return group → shape; DataError if a group stands there twice or all together have too many numbers."""
    shapes = dict(groups)
    if len(shapes) < len(groups):
        raise wrong(where, place, repeats(name for name, _ in groups), "each group stands there once")
    if (numbers := sum(map(math.prod, shapes.values()))) > MOST_NUMBERS:
        raise wrong(where, place, numbers, f"at most {MOST_NUMBERS:,} numbers are allowed")
    return shapes
