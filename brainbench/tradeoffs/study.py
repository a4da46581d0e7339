"""A trade-off study: every setting is measured once, into a table that goes on where it stopped."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError
from brainbench.core.files import read_json, write_json
from brainbench.core.progress import Progress, track
from brainbench.core.tradeoffs import TradeoffPoint, pareto_front

Row = dict[str, Any]  # a measured setting: its settings, and what they gave


@dataclass(frozen=True)
class Study:
    """What is measured, and how."""

    name: str
    """Command that makes the table."""
    settings: Sequence[Mapping[str, Any]]
    """Settings of each row; a row of a table that has them is not measured again."""
    measure: Callable[[Mapping[str, Any]], Mapping[str, Any]]
    """Function from the settings of a row to the rest of it."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Head of the table: what its columns are."""
    fixed: Mapping[str, Any] = field(default_factory=dict)
    """Part of the head that must be the same for rows to share a table."""


def run_study(study: Study, path: Path, *, progress: Progress | None = None) -> list[Row]:
    """Measure the settings that the table at ``path`` lacks, writing it whole after each; return all its rows."""
    head = {"made_by": study.name, **study.about, **study.fixed, "machine": platform.machine()}
    rows: list[Row] = []
    if path.exists():
        table = read_json(path)
        if not isinstance(table, dict) or any(table.get(key) != value for key, value in study.fixed.items()):
            words = ", ".join(f"{key} {value}" for key, value in study.fixed.items())
            raise DataError(
                f"{str(path)!r} was not measured with {words}; write to another file, or delete it to measure "
                "everything again."
            )
        rows = list(table["points"])
    missing = [setting for setting in study.settings if not any(_is_of(row, setting) for row in rows)]
    for setting in track(missing, "measuring settings", progress):
        rows.append({**setting, **study.measure(setting)})
        write_json(path, {**head, "points": rows})
    return rows


def front(rows: Iterable[Row], error: str, settings: Sequence[str]) -> list[TradeoffPoint]:
    """Return, with their settings, the rows that none beats in both ``error`` and cost, cheapest first."""
    return pareto_front(
        TradeoffPoint(_number(row[error]), _number(row["cost"]), {name: row.get(name) for name in settings})
        for row in rows
    )


def _is_of(row: Row, setting: Mapping[str, Any]) -> bool:
    # A table may be older than a setting, whose default it then has.
    return all(row.get(name, value) == value for name, value in setting.items())


def _number(value: float | None) -> float:
    return math.inf if value is None else value
