"""Values of a JSON file, read one at a time with their kind and range; errors name the place in the file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError, check_name
from brainbench.core.reading.texts import read_mapping

_SHOWN = 80
_ABSENT = object()


@dataclass(frozen=True)
class Values:
    """Names and values somewhere in a file. Every method raises :class:`DataError` where a value is not as asked."""

    where: str
    """The file."""
    values: Mapping[str, Any]
    prefix: str = ""
    """Place in the file, with a dot at its end."""

    @classmethod
    def read(cls, path: Path) -> Values:
        """Read a JSON file; raise DataError if it cannot be read, or holds no names and values."""
        return cls(path.name, read_mapping(path, "JSON file of names and values"))

    def error(self, name: str, allowed: str, received: Any) -> DataError:
        """Return the error for a value, of which 80 characters are shown."""
        shown = "missing" if received is _ABSENT else repr(received)
        shown = shown if len(shown) <= _SHOWN else f"{shown[:_SHOWN]}…"
        return DataError(f"{self.prefix + str(name)[:_SHOWN]!r} in {self.where!r} is {shown}; allowed: {allowed}.")

    def get(self, name: str, good: Callable[[Any], bool], allowed: str) -> Any:
        """Return a value for which ``good`` holds."""
        value = self.values.get(name, _ABSENT)
        if not good(value):
            raise self.error(name, allowed, value)
        return value

    def part(self, name: str) -> Values:
        """Return names and values that stand under a name."""
        found = self.get(name, lambda value: isinstance(value, dict), "names and values")
        return Values(self.where, found, f"{self.prefix}{name}.")

    def text(self, name: str, options: Iterable[str] = ()) -> str:
        """Return a text, one of the options if there are any."""
        known = tuple(options)

        def good(value: Any) -> bool:
            return isinstance(value, str) and (value in known if known else 0 < len(value) <= 4096)

        return self.get(name, good, ", ".join(known) or "a text of at most 4096 characters")

    def texts(self, name: str, most: int) -> tuple[str, ...]:
        """Return different texts, at least one."""

        def good(value: Any) -> bool:
            texts = _list(value, 1, most) and all(isinstance(item, str) and item for item in value)
            return texts and len(set(value)) == len(value)

        return tuple(self.get(name, good, f"1 to {most} different names"))

    def whole(self, name: str, low: int, high: int) -> int:
        """Return a whole number."""
        allowed = f"a whole number from {low} to {high}"
        return self.get(name, lambda value: type(value) is int and low <= value <= high, allowed)

    def number(self, name: str, low: float, high: float) -> float:
        """Return a finite number."""
        return float(self.get(name, lambda value: _within(value, low, high), f"a number from {low:.4g} to {high:.4g}"))

    def numbers(self, name: str, count: int, low: float, high: float) -> tuple[float, ...]:
        """Return so many finite numbers."""

        def good(value: Any) -> bool:
            return _list(value, count, count) and all(_within(item, low, high) for item in value)

        return tuple(map(float, self.get(name, good, f"{count} numbers from {low:.4g} to {high:.4g}")))

    def _shape(self, name: str, received: Any, most: int) -> tuple[int, ...]:
        sizes = received if _list(received, 1, 3) else [0]
        count = 1
        for size in sizes:
            count *= min(size, most + 1) if type(size) is int and size > 0 else 0
        if not 0 < count <= most:
            raise self.error(name, f"one to three sizes, together at most {most:,} numbers", received)
        return tuple(sizes)

    def shapes(self, name: str, most: int) -> dict[str, tuple[int, ...]]:
        """Return group → shape of a list of [group, shape], each group once."""

        def good(value: Any) -> bool:
            rows = isinstance(value, list) and all(isinstance(row, list) and len(row) == 2 for row in value)
            names = [row[0] for row in value] if rows else []
            return all(isinstance(key, str) and key for key in names) and len(set(names)) == len(names) > 0

        found = self.get(name, good, "a list of [group, shape], each group once")
        return {key: self._shape(f"{name}.{key}", shape, most) for key, shape in found}

    def fields(self, kind: type) -> dict[str, Any]:
        """Return all values as those of a dataclass's fields, by the annotation of each; UsageError for others."""
        known = {item.name: str(item.type) for item in fields(kind)}
        for name in self.values:
            check_name(f"setting in {self.where!r}", str(name)[:_SHOWN], known)
        required = {item.name for item in fields(kind) if item.default is item.default_factory is MISSING}
        if missing := sorted(required - set(self.values)):
            raise self.error(missing[0], known[missing[0]], _ABSENT)
        found = {}
        for name, annotation in ((name, known[name]) for name in self.values):
            plain, _, optional = annotation.partition(" | ")
            good, empty = _KINDS.get(plain, _KINDS["str"]), bool(optional)
            found[name] = self.get(name, lambda value, g=good, e=empty: g(value) or (e and value is None), annotation)
        return found


def _list(value: Any, low: int, high: int) -> bool:
    return isinstance(value, list) and low <= len(value) <= high


def _within(value: Any, low: float, high: float) -> bool:
    # Every comparison with NaN is false; True and False are no numbers here.
    return type(value) in (int, float) and low <= value <= high


_KINDS: dict[str, Callable[[Any], bool]] = {
    "str": lambda value: isinstance(value, str) and len(value) <= 400,
    "bool": lambda value: isinstance(value, bool),
    "int": lambda value: type(value) is int and abs(value) <= 10**12,
    "float": lambda value: _within(value, -1e12, 1e12),
    "Mapping[str, Any]": lambda value: isinstance(value, dict),
    "HandCalibration": lambda value: value is None or isinstance(value, dict),
    "tuple[int, ...]": lambda value: (
        _list(value, 1, 32) and all(type(item) is int and 0 < item <= 65536 for item in value)
    ),
    "tuple[float, float]": lambda value: _list(value, 2, 2) and all(_within(item, -1e12, 1e12) for item in value),
    "tuple[float, float, float]": lambda value: (
        _list(value, 3, 3) and all(_within(item, -1e12, 1e12) for item in value)
    ),
}
"""Annotation of a field → whether a JSON value is of its kind; literals are texts, which their class checks."""
