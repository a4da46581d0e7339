"""Seeded changes of a valid file that keep its kind: the text still parses, and something in it is not as it should be.

Documents lose, double, rename and move their keys and values; tables their rows and columns; Python files their
statements. What has another structure (HDF5, weights) is changed by :mod:`tests.factories.damage`.
"""

from __future__ import annotations

import csv
import io
import json
import math
import random
import tomllib
from collections.abc import Callable
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import Any

from tests.factories.damage import SPECIAL, damage

ODD: tuple[Any, ...] = (
    math.nan, math.inf, -math.inf, 1e308, -1e308, 1e-320, 2**31, -(2**31), 2**63, -1, 0, 0.5, True, None, "", " ",
    "nan", "x" * 5000, [], {}, [[]], {"a": {}}, [None], [math.nan] * 3, "../../etc/passwd", "os:system", "\x00",
    "\u202e", "\ud800", "1", 10**400, [[0] * 3] * 1000,
)  # fmt: skip
"""What takes the place of a value."""
CELLS = (
    "nan", "inf", "-inf", "1e308", "-1", "0", "", "x", "1,5", "1e400", "0x10", "١٢", "9" * 400, "1_000", "\u200b1",
    "true", "-1e-320", "1e18", "a\x00b", "''", "2147483648.0",
)  # fmt: skip
"""What takes the place of a cell of a table."""
TWINS = str.maketrans({"a": "а", "e": "е", "o": "о", "i": "і", "x": "х", "p": "р", "c": "с"})
"""Latin letters and the Cyrillic ones that look like them."""
STATEMENTS = (
    "raise ValueError('x' * 5000)",
    "raise SystemExit(0)",
    "import no_such_module",
    "undefined_name",
    "def f(:",
    "1 / 0",
    "'\\ud800'.encode()",
    "(lambda f: f(f))(lambda f: f(f))",
    "\x00",
    "raise type('E', (Exception,), {'__str__': lambda self: 1 / 0})",
    "import sys; sys.exit('bye')",
    "from . import x",
    "raise UnicodeDecodeError('utf-8', b'x', 0, 1, '\\x1b[31m')",
    "  indented = 1",
    "return 3",
    "await x",
)
"""What stands in a Python file in place of a line."""


def restructure(path: Path, seed: int) -> str:
    """Change a file in place and say how; equal seeds do the same."""
    chance = random.Random(seed)
    change = _CHANGES.get(path.suffix)
    if change is None:
        return damage(path, seed + SPECIAL)
    what = [change(path, chance) for _ in range(chance.choice((1, 1, 1, 2)))]
    if chance.random() < 0.05:
        data = path.read_bytes()
        path.write_bytes(data[: chance.randrange(len(data) + 1)])
        what.append("cut off")
    return ", ".join(what)


def mutate(value: Any, seed: int) -> Any:
    """Return a JSON value with one to three places changed, removed, doubled or moved."""
    chance = random.Random(seed)
    for _ in range(chance.randint(1, 3)):
        _alter(value, chance)
    return value


def _alter(value: Any, chance: random.Random) -> str:
    """Change one place in a nested value."""
    places = _places(value)
    if not places:
        return "nothing"
    return _change(*chance.choice(places), chance)


def _change(holder: Any, key: Any, chance: random.Random) -> str:
    """Change what stands at a key or index of a mapping or list."""
    kinds = ["odd"] * 5
    if isinstance(holder, dict):
        kinds += ["drop", "drop", "rename", "extra"]
    else:
        kinds += ["drop", "double", "swap"]
    if isinstance(holder[key], (int, float)) and not isinstance(holder[key], bool):
        kinds += ["scale"] * 3 + ["sign", "text"]
    if isinstance(holder[key], list) and holder[key]:
        kinds += ["empty", "nest", "repeat", "shorter"]
    if isinstance(holder[key], str):
        kinds += ["twin", "upper", "long"]
    kind, old = chance.choice(kinds), holder[key]
    if kind == "odd":
        holder[key] = chance.choice(ODD)
    elif kind == "drop":
        del holder[key]
    elif kind == "rename":
        holder[chance.choice((key.translate(TWINS), key.upper(), f"{key} ", "__class__"))] = holder.pop(key)
    elif kind == "extra":
        holder[chance.choice(("x", "__proto__", "", "é", key + "_"))] = old
    elif kind == "double" and isinstance(holder, list):
        holder.append(old)
    elif kind == "swap":
        holder[key], holder[0] = holder[0], holder[key]
    elif kind == "scale":
        holder[key] = old * 10.0 ** chance.randint(-300, 300) if abs(old) < 1e8 else -old
    else:
        changes: dict[str, Callable[[], Any]] = {
            "sign": lambda: -old,
            "text": lambda: str(old),
            "empty": list,
            "nest": lambda: [old],
            "repeat": lambda: old * 300,
            "shorter": lambda: old[:-1],
            "twin": lambda: old.translate(TWINS),
            "upper": old.upper if kind == "upper" else str,
            "long": lambda: old * 999,
        }
        holder[key] = changes[kind]()
    return f"{kind} {str(key)[:20]}"


def _places(value: Any) -> list[tuple[Any, Any]]:
    places: list[tuple[Any, Any]] = []
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in pairs:
        places += [(value, key), *_places(inner)]
    return places


def _document(path: Path, chance: random.Random) -> str:
    try:
        value = json.loads(path.read_text())
    except ValueError:  # a change before this one
        return "nothing"
    if chance.random() < 0.08:
        path.write_text(chance.choice(("[]", "{}", "null", "3", '"x"', f"[{path.read_text()}]", '{"a":1,"a":2}')))
        return "whole"
    what = _alter(value, chance)
    text = json.dumps(value)
    if chance.random() < 0.08 and isinstance(value, dict) and value:
        name = chance.choice(list(value))
        text, what = text[:-1] + f", {json.dumps(name)}: {json.dumps(value[name])}}}", f"{name[:20]} twice"
    path.write_text(text)
    return what


def _table(path: Path, chance: random.Random) -> str:
    """Change a cell, a row or a column of a table, its unit, or how it is written."""
    rows: list[Any] = list(csv.reader(io.StringIO(path.read_bytes().decode(errors="replace").replace("\0", ""))))
    rows = [row for row in rows if row] or [[""]]
    kind = chance.choice(("cell", "cell", "text", "row", "column", "scale", "short", "long", "semicolons", "mark"))
    turned = kind in ("column", "scale")
    if turned:
        rows = [list(column) for column in zip_longest(*rows, fillvalue="")]
    place, what = chance.randrange(len(rows)), kind
    row = rows[place]
    if kind in ("row", "column"):
        what = f"{kind}: {_change(rows, place, chance)}"
    elif kind == "text":
        what = f"{kind}: {_change(row, chance.randrange(len(row)), chance)}"
    elif kind == "cell":
        row[chance.randrange(len(row))] = chance.choice(CELLS)
    elif kind == "scale":
        factor = 10.0 ** chance.choice((-300, -9, -6, -3, 3, 6, 9, 12, 290))
        for index, cell in enumerate(row):
            with suppress(ValueError):
                row[index] = repr(float(cell) * factor)
    elif kind == "short":
        del row[chance.randrange(len(row)) :]
    elif kind == "long":
        row += ["1"] * chance.choice((1, 100))
    lists = [row if isinstance(row, list) else [row] for row in rows]
    stream = io.StringIO()
    writer = csv.writer(stream, delimiter=";" if kind == "semicolons" else ",")
    writer.writerows(zip_longest(*lists, fillvalue="") if turned else lists)
    text = ("\ufeff\ufeff" if kind == "mark" else "") + stream.getvalue()
    path.write_bytes(text.encode(errors="replace"))
    return what


def _code(path: Path, chance: random.Random) -> str:
    lines = path.read_text(errors="replace").splitlines() or [""]
    place = chance.randrange(len(lines))
    kind = chance.choice(("insert", "insert", "replace", "drop", "twin", "name", "bytes"))
    statement = chance.choice(STATEMENTS)
    indent = lines[place][: len(lines[place]) - len(lines[place].lstrip())]
    if kind == "insert":
        lines.insert(place, indent + statement)
    elif kind == "replace":
        lines[place] = indent + statement
    elif kind == "drop":
        del lines[place]
    elif kind == "twin":
        lines[place] = lines[place].translate(TWINS)
    elif kind == "name":
        words = ("None", "3", "()", "lambda *a, **k: None", "object()", "[]", "float('nan')", "-1", "'x'")
        lines.append(f"{chance.choice(('Mine', 'TASK', 'register', 'torch'))} = {chance.choice(words)}")
    path.write_text("\n".join(lines) + "\n")
    if kind == "bytes":
        path.write_bytes(path.read_bytes() + chance.choice((b"\xff\xfe", b"\0", b"# coding: no\n", b"'''")))
    return f"{kind} {statement[:30]}"


def _words(path: Path, chance: random.Random) -> str:
    """Change a text that a user types: parts of it are cut out, doubled, or others."""
    text = path.read_text(errors="replace")
    place = chance.randrange(len(text) + 1)
    end = min(len(text), place + chance.randint(0, 8))
    pieces = (
        "", "/", "//", "..", "../..", "@", ":", "\x00", "\x1b[31m", "\u202e", "%2e%2e", " ", "~", "~nobody/x", "а",
        "-", "\n", "x" * 5000, "C:\\", "hf-hub:", "local-dir:", "file:///", "https://", "*", "\U0001f600", text,
    )  # fmt: skip
    piece = chance.choice(pieces)
    path.write_text(text[:place] + piece + text[end:], errors="replace")
    return f"{piece[:10]!r} at {place}"


def _settings(path: Path, chance: random.Random) -> str:
    """Change TOML: it is written again with its tables in one line each."""
    try:
        value = tomllib.loads(path.read_text())
    except ValueError:  # a change before this one
        return "nothing"
    what = _alter(value, chance)
    lines = [f"{json.dumps(key)} = {_toml(inner)}\n" for key, inner in value.items()]
    path.write_text("".join(lines), errors="replace")
    return what


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    return '"none"' if value is None else json.dumps(value, ensure_ascii=False)


_CHANGES: dict[str, Callable[[Path, random.Random], str]] = {
    ".toml": _settings,
    ".json": _document,
    ".csv": _table,
    ".py": _code,
    ".txt": _words,
}
