"""A trade-off study: every setting is measured once, into a table that goes on where it stopped."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError
from brainbench.core.figures import COLORS, panels, plain_log_ticks, save_figure
from brainbench.core.files import read_json, write_json, write_text
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


def run_study(
    study: Study, path: str | os.PathLike[str] | None = None, *, progress: Progress | None = None
) -> list[Row]:
    """Measure the settings that the table at ``path`` lacks, writing it whole after each; return all its rows."""
    head = {"made_by": study.name, **study.about, **study.fixed, "machine": platform.machine()}
    rows: list[Row] = []
    if path is not None and Path(path).exists():
        table = read_json(path)
        if not isinstance(table, dict) or any(table.get(key) != value for key, value in study.fixed.items()):
            words = ", ".join(f"{key} {value}" for key, value in study.fixed.items())
            raise DataError(
                f"{os.fspath(path)!r} was not measured with {words}; write to another file, or delete it to measure "
                "everything again."
            )
        rows = list(table["points"])
    missing = [setting for setting in study.settings if not any(_is_of(row, setting) for row in rows)]
    for setting in track(missing, "measuring settings", progress):
        rows.append({**setting, **study.measure(setting)})
        if path is not None:
            write_json(path, {**head, "points": rows})
    return rows


def front(rows: Iterable[Row], error: str, settings: Sequence[str]) -> list[TradeoffPoint]:
    """Return, with their settings, the rows that none beats in both ``error`` and cost, cheapest first."""
    return pareto_front(
        TradeoffPoint(_number(row[error]), _number(row["cost"]), {name: row.get(name) for name in settings})
        for row in rows
    )


def write_csv(rows: Iterable[Row], path: str | os.PathLike[str]) -> Path:
    """Write rows as comma-separated values, atomically; what is not known stays empty."""
    import pandas as pd

    # Columns of objects, so that whole numbers stay whole beside missing ones.
    return write_text(path, pd.DataFrame(list(rows), dtype=object).sort_index(axis=1).to_csv(index=False))


@dataclass(frozen=True)
class Panel:
    """One chart of error against cost."""

    title: str
    xlabel: str
    ylabel: str
    error: str
    """Column of the error."""
    rows: Sequence[Row]
    series: Callable[[Row], str] = lambda row: ""
    """Name of the series that a row belongs to; each has a colour and a front."""
    label: Callable[[Row], str] = lambda row: ""
    """Text beside the point of a row; empty for none."""


def draw_study(charts: Sequence[Panel], path: Path) -> Path:
    """Draw charts side by side, into a file whose suffix is the format."""
    figure, (axes,) = panels(1, len(charts), (4.6 * len(charts) + 1, 4.6))
    for chart, axis in zip(charts, axes, strict=True):
        usable = [row for row in chart.rows if row[chart.error] is not None and row["cost"] is not None]
        names = sorted({chart.series(row) for row in usable})
        for number, name in enumerate(names):
            rows, colour = [row for row in usable if chart.series(row) == name], COLORS[number % len(COLORS)]
            best = front(rows, chart.error, ())
            axis.scatter(
                [row["cost"] for row in rows], [row[chart.error] for row in rows], s=18, color=colour, alpha=0.6
            )
            axis.step(
                [point.cost for point in best], [point.error for point in best], color=colour, where="post", lw=1.2
            )
            axis.plot([], [], "o-", color=colour, label=name)
            for side, row in enumerate(row for row in rows if chart.label(row)):
                # On alternate sides, because neighbours are close.
                shift = {"xytext": (6, 5 if side % 2 else -11), "textcoords": "offset points"}
                axis.annotate(chart.label(row), (row["cost"], row[chart.error]), color=colour, fontsize=8.5, **shift)
        axis.set(xscale="log", yscale="log", title=chart.title, xlabel=chart.xlabel, ylabel=chart.ylabel)
        plain_log_ticks(axis)
        axis.margins(0.15)
        if any(names):
            axis.legend(frameon=False, fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncol=2)
    return save_figure(figure, path, dpi=150)


def _is_of(row: Row, setting: Mapping[str, Any]) -> bool:
    # A table may be older than a setting, whose default it then has.
    return all(row.get(name, value) == value for name, value in setting.items())


def _number(value: float | None) -> float:
    return math.inf if value is None else value
