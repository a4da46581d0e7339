"""JSON, TOML and YAML of bounded size, depth and digits; no value is NaN or infinite."""

from __future__ import annotations

import json
import math
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError, brief, listing, needing, repeats
from brainbench.core.reading.regular import MOST_TEXT, check_file, readable

MOST_LEVELS = 64  # levels of nesting
LARGEST_WHOLE = 2**63 - 1  # largest magnitude of a whole number


def read_text(path: str | os.PathLike[str], kind: str = "text file", *, most: int = MOST_TEXT) -> str:
    """Read UTF-8 text."""
    file = check_file(path, kind, most=most)
    with readable(path, kind):
        return file.read_text(encoding="utf-8-sig")


def parse_json(text: str, name: str) -> Any:
    """Parse JSON text; ``name`` is that of its file in messages."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        """Return the pairs of one object as a mapping; a name that stands twice is a :class:`DataError`."""
        if len(values := dict(pairs)) < len(pairs):
            raise DataError(f"{brief(name)} has {listing(repeats(key for key, _ in pairs))} twice in one object.")
        return values

    # Python's parser takes NaN and Infinity, which JSON does not know, and 1e400, which is infinite.
    with readable(name, "JSON text"):
        return check_values(json.loads(text, object_pairs_hook=unique), name)


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """Parse TOML text; ``name`` is that of its file in messages. Errors are those of :func:`parse_json`."""
    with readable(name, "TOML text"):
        return check_values(tomllib.loads(text), name)


def read_json(path: str | os.PathLike[str], kind: str = "file") -> Any:
    """Read JSON."""
    return parse_json(read_text(path, kind), os.fspath(path))


def read_toml(path: str | os.PathLike[str], kind: str = "file") -> dict[str, Any]:
    """Read TOML; errors are those of :func:`read_json`."""
    return parse_toml(read_text(path, kind), os.fspath(path))


def read_yaml(path: str | os.PathLike[str], kind: str = "file") -> Any:
    """Read YAML."""
    with needing("pyyaml", extra="hub", purpose="Reading YAML settings"):
        import yaml
    text, name = read_text(path, kind), os.fspath(path)
    with readable(path, "YAML text"):
        # Deep texts take the time of their depth squared; a few aliases of aliases stand for any number of values.
        level = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            level += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if level > MOST_LEVELS:
                raise DataError(f"{brief(name)} is nested too deeply: more than {MOST_LEVELS} levels.")
            if isinstance(event, yaml.AliasEvent):
                raise DataError(f"{brief(name)} repeats values by alias (*name); write them out instead.")
        _check_keys(yaml.compose(text, yaml.SafeLoader), name)
        return check_values(yaml.safe_load(text), name)


def _check_keys(node: Any, name: str) -> None:
    """Raise DataError if a mapping inside a node of YAML has a key twice."""
    if node is None or node.id == "scalar":
        return
    pairs = node.value if node.id == "mapping" else [(None, item) for item in node.value]
    if twice := repeats(key.value for key, _ in pairs if key is not None and key.id == "scalar"):
        raise DataError(f"{brief(name)} has {listing(twice)} twice in one mapping.")
    for _, inner in pairs:
        _check_keys(inner, name)


def read_mapping(path: str | os.PathLike[str], kind: str = "file") -> dict[str, Any]:
    """Read names and values from a TOML, JSON or YAML file, which its ending tells apart."""
    suffix = Path(path).suffix.lower()
    read = read_json if suffix == ".json" else read_yaml if suffix in (".yaml", ".yml") else read_toml
    values = read(path, kind)
    if not isinstance(values, dict):
        raise DataError(f"{brief(os.fspath(path))} holds a {type(values).__name__}, not names and values.")
    return values


def check_values(value: Any, name: str, place: tuple[str | int, ...] = ()) -> Any:
    """Return nested plain data whose numbers are all finite and not too large; ``place`` is where it stands."""
    if type(value) is float:
        if not math.isfinite(value):
            raise DataError(f"{_place(name, place)} is {value}; a finite number is needed.")
    elif type(value) is int:
        if abs(value) > LARGEST_WHOLE:
            raise DataError(f"{_place(name, place)} is a number of about 2^{value.bit_length()}; the largest is 2^63.")
    elif type(value) is str:
        _encode(value, name, place)
    elif isinstance(value, (Mapping, list)):
        if len(place) >= MOST_LEVELS:
            raise DataError(f"{brief(name)} is nested too deeply: more than {MOST_LEVELS} levels.")
        if isinstance(value, Mapping):
            for key in value:
                _encode(str(key), name, place)
        elif value and type(value[0]) is float and {*map(type, value)} == {float} and math.isfinite(sum(value)):
            return value  # Most of a large file are numbers in order.
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            kind = type(inner)
            plain = inner is None or kind is bool or (kind is float and math.isfinite(inner))
            if not (plain or (isinstance(inner, str) and inner.isascii())):
                check_values(inner, name, (*place, key))
    return value


def _encode(text: str, name: str, place: tuple[str | int, ...]) -> None:
    if not text.isascii():
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise DataError(f"{_place(name, place)} holds half of a surrogate pair, which is no text.") from error


def _place(name: str, place: tuple[str | int, ...]) -> str:
    inside = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in place).removeprefix(".")
    return f"{brief(inside)} in {brief(name)}" if inside else brief(name)
