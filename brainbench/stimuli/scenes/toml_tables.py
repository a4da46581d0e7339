"""Tables of a TOML file, whose known keys are checked, converted and built into objects; other keys are an error."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeVar

from brainbench.core.errors import UsageError, check_name, unknown_name

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
        """Return the converted value of a key, or the default without it."""
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
        """Call ``make`` with the values of some keys, and ``others``; a parameter without its key keeps its default."""
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


def _converter(kind: str, fits: Callable[[Any], bool], convert: Callable[[Any], Any] = lambda value: value) -> Convert:
    """Return a converter of values that fit; for others it raises a TypeError that says what they must be."""

    def checked(value: Any) -> Any:
        if not fits(value):
            raise TypeError(kind)
        return convert(value)

    return checked


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


text = _converter("a text", lambda value: isinstance(value, str))
whole = _converter("a whole number", lambda value: isinstance(value, int) and not isinstance(value, bool))
boolean = _converter("true or false", lambda value: isinstance(value, bool))
mapping = _converter("a table", lambda value: isinstance(value, dict))
tables = _converter(
    "a list of tables in double brackets",
    lambda value: isinstance(value, list) and all(isinstance(item, dict) for item in value),
)


def choice(kind: str, options: Collection[str]) -> Convert:
    """Return a converter of texts that takes one of ``options``, and its value where these are a mapping."""

    def convert(value: Any) -> Any:
        check_name(kind, text(value), options)
        return options[value] if isinstance(options, Mapping) else value

    return convert


def number(factor: float = 1.0) -> Convert:
    """Return a converter of finite numbers, which multiplies by ``factor``."""
    return _converter("a finite number", _is_number, lambda value: value * factor)


def listed(item: Convert) -> Convert:
    """Return a converter of lists of ``item``."""
    return _converter("a list", lambda value: isinstance(value, list), lambda value: tuple(map(item, value)))


def vector(factor: float) -> Convert:
    """Return a converter of three numbers, which multiplies by ``factor``."""
    three = "three numbers in brackets"
    fits = _converter(three, lambda value: isinstance(value, list) and len(value) == 3, tuple)
    return lambda value: tuple(map(number(factor), fits(value)))
