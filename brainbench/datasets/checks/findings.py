"""The form in which every check of recordings reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from brainbench.core.errors import listing

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Worst first."""
LONGEST_SESSION = 48 * 3600.0
"""Times that span more than this (s) are no seconds."""


@dataclass(frozen=True)
class Finding:
    """One fault that a check found."""

    severity: Severity
    check: str
    """Name: file, units, spikes, duplicates, refractory, silent, tables, times, labels, order, coverage or clock."""
    message: str
    """The fault, in numbers."""
    advice: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    """The measurements behind it, for programs."""
    where: str = ""
    """The session, or the file; filled in by the checkup."""


def share(part: int, whole: int) -> str:
    """Return a part of a whole for a message: ``"3 of 40 (8 %)"``."""
    return f"{part} of {whole} ({100 * part / max(whole, 1):.0f} %)"


def some(names: list[str], limit: int = 5) -> str:
    """Return the first few names and how many more there are."""
    return listing(names, limit=limit, quoted=False)
