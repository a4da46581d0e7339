"""Tables of a TOML file, whose known keys are checked, converted and built into objects; other keys are an error."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeVar

from brainbench.core.errors import UsageError, unknown_name

MILLI = 1e-3
"""Metres in a millimetre, seconds in a millisecond."""
DEGREE = math.pi / 180
"""Radians in a degree."""

Convert = Callable[[Any], Any]
"""Converter of a value to SI units; a value of another kind is a TypeError that says what it must be."""
Keys = Mapping[str, tuple[str, Convert]]
"""By parameter of what is built: its key in the file, and the converter of its value."""

Built = TypeVar("Built")
_REQUIRED = object()


class TomlTable:
    """One TOML table from which known keys are taken; whatever is left is an error."""

    def __init__(self, name: str, data: Mapping[str, Any]) -> None:
        self.name = name
        self._rest = dict(data)
        self._known: list[str] = []

    def take(self, key: str, convert: Convert, default: Any = _REQUIRED) -> Any:
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
        except TypeError as error:
            raise UsageError(f"{key!r} of {self.name} must be {error}; received {value!r}.") from error

    def read(self, keys: Keys) -> dict[str, Any]:
        """Return the converted values of the keys that the table has, by parameter."""
        missing = object()
        values = {name: self.take(key, convert, missing) for name, (key, convert) in keys.items()}
        return {name: value for name, value in values.items() if value is not missing}

    def build(self, make: Callable[..., Built], keys: Keys, **others: Any) -> Built:
        """Call ``make`` with the values of some keys, and ``others``; a parameter without its key keeps its default.

        Raises:
            UsageError: the key of a parameter without default is missing, or a value is of another kind.
        """
        parameters = inspect.signature(make).parameters
        values = self.read(keys)
        for name, (key, _) in keys.items():
            if name not in values and parameters[name].default is inspect.Parameter.empty:
                raise UsageError(f"{self.name} needs the key {key!r}.")
        return make(**values, **others)

    def table(self, key: str) -> TomlTable:
        """Return a table within this one, empty when there is none."""
        return TomlTable(f"[{key}]", self.take(key, mapping, {}))

    def finish(self) -> None:
        """Refuse keys that nobody took, with a :class:`UsageError` that has the nearest known key."""
        for key in self._rest:
            raise unknown_name(f"key of {self.name}", key, sorted(self._known))


def text(value: Any) -> str:
    """Return a text."""
    if not isinstance(value, str):
        raise TypeError("a text")
    return value


def choice(kind: str, options: Collection[str]) -> Convert:
    """Return a converter of texts that takes one of ``options``, and its value where these are a mapping."""

    def convert(value: Any) -> Any:
        if text(value) not in options:
            raise unknown_name(kind, value, options)
        return options[value] if isinstance(options, Mapping) else value

    return convert


def whole(value: Any) -> int:
    """Return a whole number."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError("a whole number")
    return value


def number(factor: float = 1.0) -> Callable[[Any], float]:
    """Return a converter of finite numbers, which multiplies by ``factor``."""

    def convert(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise TypeError("a finite number")
        return value * factor

    return convert


def listed(item: Convert) -> Callable[[Any], tuple[Any, ...]]:
    """Return a converter of lists of ``item``."""

    def convert(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise TypeError("a list")
        return tuple(map(item, value))

    return convert


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
