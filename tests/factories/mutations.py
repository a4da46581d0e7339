"""Damage to files, the same for the same seed: bytes that change, and JSON values of another kind or size."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

ODD: tuple[Any, ...] = (
    math.nan, math.inf, -math.inf, 1e308, -1e308, 10**400, 2**63, -1, 0, 0.5, True, None, "", "nan", "x" * 5000, [], {},
    [[]], {"a": {}}, [math.nan] * 3, "../../etc/passwd", "os:system", "\x00",
)  # fmt: skip


def mutate(value: Any, seed: int) -> Any:
    """Return a JSON value with one to three places changed, removed, doubled or moved."""
    random = np.random.default_rng(seed)
    for _ in range(int(random.integers(1, 4))):
        places = _places(value)
        if not places:
            break
        holder, key = places[int(random.integers(len(places)))]
        kind = int(random.integers(4))
        if kind == 0 and isinstance(holder, dict):
            del holder[key]
        elif kind == 1 and isinstance(holder, list):
            holder.append(holder[key])
        elif kind == 2 and isinstance(holder[key], (int, float)):
            holder[key] = holder[key] * 10.0 ** int(random.integers(-300, 300))
        else:
            holder[key] = ODD[int(random.integers(len(ODD)))]
    return value


def mutate_text(data: bytes, seed: int) -> bytes:
    """Return bytes with bits turned, parts cut out, doubled or overwritten, or the end missing."""
    random = np.random.default_rng(seed)
    changed = bytearray(data)
    for _ in range(int(random.integers(1, 6))):
        place = int(random.integers(len(changed))) if changed else 0
        kind = int(random.integers(5))
        if kind == 0 and changed:
            changed[place] ^= 1 << int(random.integers(8))
        elif kind == 1:
            del changed[place : place + int(random.integers(1, 40))]
        elif kind == 2:
            changed[place:place] = changed[place : place + int(random.integers(1, 40))]
        elif kind == 3:
            changed[place : place + 8] = random.bytes(8)
        elif random.random() < 0.3:
            del changed[place:]
    return bytes(changed)


def _places(value: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        found += [(value, key), *_places(item)]
    return found
