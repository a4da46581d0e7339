"""Parsed JSON and TOML as typed values, and what is wrong with them in words."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, get_args

import msgspec

from brainbench.core.errors import DataError, UsageError, brief, check_each, listing
from brainbench.core.limits import check_value

T = TypeVar("T")
Table = TypeVar("Table", bound=msgspec.Struct)
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


_TABLES = {"list": "a list of tables in double brackets", "tuple": "a list of tables", "dict": "a table"}
"""Beginnings of types of tables, in words."""


def read_table(kind: type[Table], data: Any, name: str) -> Table:
    """Return the data of a TOML file, or of one table in it, as a structure; tables within become structures too.

    Errors say which key of ``name`` is unknown, missing or of another kind.
    """
    if not isinstance(data, Mapping):
        raise UsageError(f"{name} must be a table; received {brief(data)}.")
    fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    check_each(f"key of {name}", data, sorted(fields))
    for key, field in fields.items():
        if field.required and key not in data:
            raise UsageError(f"{name} needs the key {key!r}.")
    return kind(**{fields[key].name: _read_key(fields[key].type, value, key, name) for key, value in data.items()})


def _read_key(kind: Any, value: Any, key: str, name: str) -> Any:
    tables = [part for part in (kind, *get_args(kind)) if isinstance(part, type) and issubclass(part, msgspec.Struct)]
    inner = tables[0] if tables else None
    if inner is kind:
        return read_table(kind, value, f"[{key}] of {name}")
    if inner is not None and isinstance(value, list):
        return tuple(read_table(inner, entry, f"[[{key}]] of {name}") for entry in value)
    check_value(f"{key!r} of {name}", value, kind)
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        word = next(word for start, word in _TABLES.items() if start in str(kind))
        word = "a table of tables, one for each name" if isinstance(value, Mapping) else word
        raise UsageError(f"{key!r} of {name} must be {word}; received {brief(value)}.") from error
