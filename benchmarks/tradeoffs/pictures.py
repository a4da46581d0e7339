"""The pictures of error against cost in docs/images, from the tables that ship."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.patheffects import withStroke

from brainbench.core.figures import COLORS, panels, save_figure
from brainbench.core.files import read_json
from brainbench.core.tradeoffs import TradeoffPoint, pareto_front
from brainbench.stimuli.engines.fidelity import RESOLUTION, Fidelity, list_presets

Row = dict[str, Any]
SIDES = (6, 5, "left"), (-6, -3, "right"), (6, -11, "left"), (-6, -11, "right")
"""Places of labels beside their points (points of the page), and how they are aligned."""
HALO = withStroke(linewidth=2.5, foreground="white")
TABLES = {
    "whisker": Path("brainbench/stimuli/fidelity_table.json"),
    "tactile": Path("robotics_bridge/sensors/fidelity_table.json"),
}


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
    # A series has one colour in all charts.
    series = sorted({chart.series(row) for chart in charts for row in chart.rows})
    for chart, axis in zip(charts, axes, strict=True):
        usable = [row for row in chart.rows if row[chart.error] is not None and row["cost"] is not None]
        names = sorted({chart.series(row) for row in usable})
        for name in names:
            rows = [row for row in usable if chart.series(row) == name]
            colour = COLORS[series.index(name) % len(COLORS)]
            best = pareto_front(TradeoffPoint(row[chart.error], row["cost"]) for row in rows)
            axis.scatter(
                [row["cost"] for row in rows], [row[chart.error] for row in rows], s=18, color=colour, alpha=0.6
            )
            axis.step(
                [point.cost for point in best], [point.error for point in best], color=colour, where="post", lw=1.2
            )
            axis.plot([], [], "o-", color=colour, label=name)
            # On four sides in turn, because neighbours are close.
            for row, side in zip((row for row in rows if chart.label(row)), cycle(SIDES)):
                place = {"xytext": side[:2], "textcoords": "offset points", "ha": side[2], "path_effects": [HALO]}
                axis.annotate(chart.label(row), (row["cost"], row[chart.error]), color=colour, fontsize=8.5, **place)
        axis.set(xscale="log", yscale="log", title=chart.title, xlabel=chart.xlabel, ylabel=chart.ylabel)
        plain_log_ticks(axis)
        axis.margins(0.15)
        if any(names):
            axis.legend(frameon=False, fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncol=2)
    return save_figure(figure, path, dpi=150)


def whisker_charts(rows: Sequence[Row]) -> list[Panel]:
    """Return the charts of a table: by engine, and by collision geometry where the table has any."""
    words = "processor time per second of one whisker (s/s)", "relative error that 90 % stay below", "error_90"
    presets = {tuple(vars(Fidelity.preset(name))[item] for item in RESOLUTION): name for name in list_presets()}
    bench, hollow = ([row for row in rows if bool(row.get("collision")) is concave] for concave in (False, True))
    in_contact = Panel(
        "an object on one side", *words, bench,
        series=lambda row: row["backend"] + ("" if row.get("solver", "dynamic") == "dynamic" else ", without inertia"),
        label=lambda row: presets.get(tuple(row.get(item) for item in RESOLUTION), ""),
    )  # fmt: skip
    by_surface = Panel(
        "hollow objects, by collision surface", *words, hollow,
        series=lambda row: f"{row['collision']}, {row['backend']}",
    )  # fmt: skip
    hard = [row for row in bench if row.get("hard_90")]
    both = replace(in_contact, title="both sides, slips and releases", error="hard_90", rows=hard)
    return [in_contact, *([both] if hard else []), *([by_surface] if hollow else [])]


def tactile_charts(rows: Sequence[Row]) -> list[Panel]:
    """Return the chart of each part of a table."""
    titles = {
        "mesh": "distance to 4,608 triangles,\nby cells of the distance field",
        "points": "proximity taxels,\nby number of surface points",
        "taxels": "pad of taxels,\nby number of taxels",
    }
    words = "time per environment and update (µs)", "relative error of the force (RMS)", "error"

    def label(row: Row) -> str:
        if row["part"] == "mesh":
            return f"{row['resolution']}³" if row["resolution"] else "no field: each triangle"
        return f"{row.get('points') or row['taxels']:,}"

    return [
        Panel(title, *words, [row for row in rows if row["part"] == part], label=label)
        for part, title in titles.items()
    ]


def plain_log_ticks(axes: Any) -> None:
    """Label logarithmic axes with 1, 2 and 5 of each decade, or its 1 alone over many decades, as plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 300 * low else (1,)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def draw_tables(folder: Path) -> None:
    """Draw every table that ships."""
    for (name, table), charts in zip(TABLES.items(), (whisker_charts, tactile_charts), strict=True):
        print(draw_study(charts(read_json(table)["points"]), folder / f"{name}-tradeoff.png"))
