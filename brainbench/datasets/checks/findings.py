"""What a check of recordings says."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Worst first."""


@dataclass(frozen=True)
class Finding:
    """One thing that was found."""

    severity: Severity
    check: str
    """Which check: file, units, spikes, duplicates, refractory, silent, tables, times, labels, coverage, clock."""
    where: str
    """The session, or the file."""
    message: str
    """What was found, in numbers."""
    advice: str = ""
    """What to do."""
    values: dict[str, Any] = field(default_factory=dict)
    """The measurements behind it, for programs."""


def share(part: int, whole: int) -> str:
    """Write a part of a whole for a message: ``"3 of 40 (8 %)"``."""
    return f"{part} of {whole} ({100 * part / max(whole, 1):.0f} %)"


def repeats(names: list[str]) -> list[str]:
    """Names that occur more than once, sorted."""
    return sorted(name for name, number in Counter(names).items() if number > 1)


def some(names: list[str], limit: int = 5) -> str:
    """Name the first few and say how many more there are."""
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")
