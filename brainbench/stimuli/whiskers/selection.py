"""Naming whiskers: ``all``, ``C2,D1``, ``C0-C3``, ``C*``."""

from __future__ import annotations

import re
from collections.abc import Sequence

from brainbench.core.errors import UsageError, unknown_name

ROWS = "ABCDE"
"""Letters of the whisker rows, dorsal to ventral."""

_RANGE = re.compile(r"([A-Ea-e])(\d+)\s*-\s*([A-Ea-e])(\d+)")


def match_whiskers(pattern: str, names: Sequence[str], rows: Sequence[int], cols: Sequence[int]) -> list[int]:
    """Return the ascending indices of the whiskers that ``pattern`` names.

    Args:
        pattern: ``all``, or terms joined by commas: a name (``C2``), a row (``C*``), a column
            (``*2``), or a range within a row or a column (``C0-C3``, ``A1-E1``; gaps are skipped).
            Case does not matter. In an array with both sides ``C2`` names both and ``RC2`` one.
        names: unique names, ``C2`` or with a side ``RC2``.
        rows, cols: grid row (0 for A) and column of each whisker.
    """
    terms = [term.strip() for term in pattern.split(",") if term.strip()]
    if not terms:
        raise UsageError(f"The whisker selection {pattern!r} is empty; write 'all', 'C0-C3', 'C*' or 'C2,D1'.")
    short = [f"{ROWS[row]}{col}" for row, col in zip(rows, cols, strict=True)]
    cells = list(zip(rows, cols, strict=True))
    return sorted({index for term in terms for index in _match(term, list(names), short, cells)})


def _match(term: str, names: list[str], short: list[str], cells: list[tuple[int, int]]) -> list[int]:
    """Return the indices that one term names."""
    if term.lower() == "all":
        return list(range(len(names)))
    span = _RANGE.fullmatch(term)
    if span is None:
        shape = re.compile(".*".join(map(re.escape, term.split("*"))), re.IGNORECASE)
        matches = [i for i, name in enumerate(names) if shape.fullmatch(name) or shape.fullmatch(short[i])]
        if not matches:
            raise unknown_name("whisker", term, dict.fromkeys([*short, *names]))
        return matches
    row0, col0, row1, col1 = span.groups()
    for end in (row0 + col0, row1 + col1):
        _match(end, names, short, cells)
    first, last = (ROWS.index(row0.upper()), int(col0)), (ROWS.index(row1.upper()), int(col1))
    if (first[0] != last[0] and first[1] != last[1]) or first > last:
        raise UsageError(
            f"The whisker range {term!r} must ascend within one row (C0-C3) or one column (A1-E1);"
            " join several terms with commas."
        )
    return [i for i, (row, col) in enumerate(cells) if first[0] <= row <= last[0] and first[1] <= col <= last[1]]
