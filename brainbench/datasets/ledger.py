"""What became of everything that a source holds: found = read + left out, and why, by kind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, listing

KINDS = ("files", "animals", "sessions", "tables", "units", "trials", "spikes", "labels")
"""What is counted, from the largest to the smallest."""
QUIET = ("tables", "spikes")
"""Kinds of which most is left out by the very question: what a line of text tells of them is what was lost."""


@dataclass(frozen=True)
class LeftOut:
    """Some of one kind that was found and not read."""

    kind: str
    reason: str
    number: int = 1
    lost: bool = False
    """True for what nobody asked to leave out: no selection, no window, no mark in the file itself."""
    rows: Sequence[int] = field(default=(), repr=False)
    """Rows of their table, where a rule left them out."""


@dataclass
class Ledger:
    """The balance of one reading."""

    strict: bool = False
    """Refuse the first thing that is lost."""
    totals: Counter[str] = field(default_factory=Counter)
    read: Counter[str] = field(default_factory=Counter)
    left: list[LeftOut] = field(default_factory=list)
    incidental: set[Path] = field(default_factory=set)
    """Files that a search came upon, and nobody named."""
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    """Notes that every result must state."""
    seen: dict[Hashable, set[str]] = field(default_factory=dict)
    """Rule → the values that its column has."""
    forms: dict[tuple[str, str], set[str]] = field(default_factory=dict)
    """Column and label → how files write the value."""

    def find(self, kind: str, number: int = 1, read: int = 0) -> None:
        """Note that so many were found, and perhaps how many of them were read."""
        self.totals[kind] += number
        self.read[kind] += read

    def leave(self, kind: str, reason: str, number: int = 1, *, lost: bool = False, rows: Sequence[int] = ()) -> None:
        """Note that so many were not read, and why. Raises DataError for a lost one if the ledger is strict."""
        if lost and self.strict:
            raise DataError(reason)
        self.left.append(LeftOut(kind, reason, number, lost, rows))

    def note(self, text: str) -> None:
        """Add a note, once."""
        self.notes += [] if text in self.notes else [text]

    def apply(self, keep: NDArray[np.bool_], passes: Any, kind: str, rule: str) -> NDArray[np.bool_]:
        """Return which rows [n] of one kind remain, and enter those that only now fell out by a rule."""
        rows = np.flatnonzero(keep & ~passes).tolist()
        self.leave(kind, rule, len(rows), rows=rows)
        return keep & passes

    @property
    def removed(self) -> dict[str, int]:
        """``KIND: RULE`` → trials or units that it removed, each counted once, in the order of the rules."""
        removed: dict[str, int] = {}
        for entry in self.left:
            if entry.kind in ("trials", "units"):
                rule = f"{entry.kind}: {entry.reason}"
                removed[rule] = removed.get(rule, 0) + entry.number
        return removed

    def add(self, part: Ledger) -> Ledger:
        """Take over all that another balance holds; returns this one."""
        self.totals += part.totals
        self.read += part.read
        self.notes += part.notes
        self.doubts += part.doubts
        for name in ("seen", "forms"):
            for key, values in getattr(part, name).items():
                getattr(self, name).setdefault(key, set()).update(values)
        for entry in part.left:
            self.leave(entry.kind, entry.reason, entry.number, lost=entry.lost, rows=entry.rows)
        return self

    def close(self) -> list[str]:
        """Return a sentence for each kind whose numbers do not add up; a strict ledger raises DataError for them."""
        out = Counter[str]()
        for entry in self.left:
            out[entry.kind] += entry.number
        faults = [
            f"{self.totals[kind]:,} {kind} were found, {self.read[kind]:,} read and {out[kind]:,} left out"
            for kind in KINDS
            if self.totals[kind] != self.read[kind] + out[kind]
        ]
        if faults and self.strict:
            raise DataError(f"The balance of the recordings does not close: {'; '.join(faults)}.")
        return faults

    @property
    def skipped(self) -> list[str]:
        """Reasons why whole files and sessions are left out."""
        return [*dict.fromkeys(entry.reason for entry in self.left if entry.kind in ("files", "sessions"))]

    def stated(self) -> dict[str, Any]:
        """Return the balance as a record states it: kind → found, read, and what was left out."""
        numbers = Counter[tuple[str, str, bool]]()
        for entry in self.left:
            numbers[entry.kind, entry.reason, entry.lost] += entry.number
        return {
            kind: {
                "found": self.totals[kind],
                "read": self.read[kind],
                "left_out": [
                    {"reason": reason, "number": number, "lost": lost}
                    for (of, reason, lost), number in numbers.items()
                    if of == kind and number
                ],
            }
            for kind in KINDS
            if self.totals[kind]
        }


def balance_line(stated: Mapping[str, Any]) -> str:
    """Return a stated balance in one line: what was left out of what, and why; empty if nothing was."""
    return "; ".join(_parts(stated))


def _parts(stated: Mapping[str, Any]) -> Iterator[str]:
    before: set[str] = set()
    for kind, numbers in stated.items():
        entries = [entry for entry in numbers["left_out"] if entry["lost"] or kind not in QUIET]
        if entries:
            total = sum(entry["number"] for entry in entries)
            numbered = len(entries) > 1 and total > len(entries)
            counts = (f" ({entry['number']:,})" if numbered else "" for entry in entries)
            reasons = (entry["reason"].rstrip(".") + count for entry, count in zip(entries, counts, strict=True))
            # What a file held is left out with it, which is said once.
            texts = [text for text, entry in zip(reasons, entries, strict=True) if entry["reason"] not in before]
            before.update(entry["reason"] for entry in entries)
            yield f"{total:,} of {numbers['found']:,} {kind}" + (
                f": {listing(texts, limit=4, quoted=False)}" if texts else ""
            )
