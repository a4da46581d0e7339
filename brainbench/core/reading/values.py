"""Parsed JSON as typed values, and what is wrong with it in words."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import msgspec

from brainbench.core.errors import DataError, listing

T = TypeVar("T")
_WORDS = {
    "float": "a number", "int": "an integer", "str": "text", "bool": "true or false", "null": "null",
    "object": "an object", "array": "a list",
}  # fmt: skip


def typed_values(
    kind: type[T] | Any, data: Any, where: str, *, choices: Mapping[str, Sequence[Any]] | None = None, advice: str = ""
) -> T:
    """Return parsed JSON as a type.

    ``where`` names the whole in messages, ``choices`` are the values that fields of these names take, and ``advice``
    ends the message.
    """
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise DataError(f"{fault_in_words(str(error), data, where, choices or {})}.{advice}") from error


def fault_in_words(fault: str, data: Any, where: str, choices: Mapping[str, Sequence[Any]]) -> str:
    """Say what msgspec found wrong with parsed JSON: the place, what stands there and what is allowed there.

    >>> fault_in_words("Expected `float | null`, got `str` - at `$.score.p`", {"score": {"p": "high"}}, "a record", {})
    "score.p is 'high'; expected a number or null"
    """
    message, _, path = fault.partition(" - at `$")
    place = path.strip("`.")
    if missing := re.search(r"missing required field `(\w+)`", message):
        return f"{place or where} lacks {missing[1]!r}"
    allowed = message.partition(", got")[0].replace("Expected", "expected")
    if message.startswith("Invalid enum value") and (values := choices.get(place.rpartition(".")[2])):
        allowed = f"expected one of {listing(values)}"
    allowed = re.sub(
        r"`([a-z |]+)`", lambda kinds: " or ".join(_WORDS.get(kind, kind) for kind in kinds[1].split(" | ")), allowed
    )
    if "[...]" in place:  # an entry of a mapping, whose name is not told
        return f"an entry of {place.replace('[...]', '') or where} is wrong: {allowed}"
    for step in re.findall(r"[^.\[\]]+", place):
        data = data[int(step)] if isinstance(data, list) else data[step]
    return f"{place or where} is {repr(data)[:60]}; {allowed}"
