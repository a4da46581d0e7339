"""Tables of a TOML file from which known keys are taken, each checked and converted; the rest is an error."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from brainbench.core.errors import UsageError, unknown_name

MILLI = 1e-3
"""Metres in a millimetre, seconds in a millisecond."""

_REQUIRED = object()


class TomlTable:
    """One TOML table from which known keys are taken; whatever is left is an error."""

    def __init__(self, name: str, data: Mapping[str, Any]) -> None:
        self.name = name
        self._rest = dict(data)
        self._known: list[str] = []

    def take(self, key: str, convert: Callable[[Any], Any], default: Any = _REQUIRED) -> Any:
        """Return the converted value of a key, or the default without it.

        Raises:
            UsageError: the key is missing and has no default, or its value is of another kind.
        """
        self._known.append(key)
        if key not in self._rest:
            if default is _REQUIRED:
                raise UsageError(f"{self.name} needs the key {key!r}.")
            return default
        value = self._rest.pop(key)
        try:
            return convert(value)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{key!r} of {self.name} must be {error}; received {value!r}.") from error

    def table(self, key: str) -> TomlTable:
        """Return a table within this one, empty when there is none."""
        return TomlTable(f"[{key}]", self.take(key, mapping, {}))

    def finish(self) -> None:
        """Refuse keys that nobody took.

        Raises:
            UsageError: there is one; the message has the nearest known key.
        """
        for key in self._rest:
            raise unknown_name(f"key of {self.name}", key, sorted(self._known))


def text(value: Any) -> str:
    """Return a text."""
    if not isinstance(value, str):
        raise TypeError("a text")
    return value


def whole(value: Any) -> int:
    """Return a whole number."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError("a whole number")
    return value


def number(factor: float) -> Callable[[Any], float]:
    """Return a converter of finite numbers, which multiplies by ``factor``."""

    def convert(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise TypeError("a finite number")
        return value * factor

    return convert


def listed(item: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, ...]]:
    """Return a converter of lists of ``item``."""

    def convert(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise TypeError("a list")
        return tuple(map(item, value))

    return convert


def length(value: Any) -> float:
    """Return metres of a number in millimetres."""
    return number(MILLI)(value)


def vector(factor: float) -> Callable[[Any], tuple[float, float, float]]:
    """Return a converter of three numbers, which multiplies by ``factor``."""

    def convert(value: Any) -> tuple[float, float, float]:
        if not isinstance(value, list) or len(value) != 3:
            raise TypeError("three numbers in brackets")
        x, y, z = map(number(factor), value)
        return x, y, z

    return convert


def mapping(value: Any) -> Mapping[str, Any]:
    """Return a table."""
    if not isinstance(value, dict):
        raise TypeError("a table")
    return value


def tables(value: Any) -> list[Mapping[str, Any]]:
    """Return a list of tables."""
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise TypeError("a list of tables in double brackets")
    return value
