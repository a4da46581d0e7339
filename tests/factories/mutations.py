"""Damage to bytes, the same for the same seed."""

from __future__ import annotations

import numpy as np


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
