"""Chart of a table of :mod:`brainbench.stimuli.tradeoff`: error against cost, per backend and collision geometry."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from brainbench.stimuli.figures.canvas import new_figure, save_figure
from brainbench.stimuli.tradeoff import collision_points, front, preset_of


def plot_tradeoff(points: Iterable[dict[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Draw error against cost, with the front of each backend and the presets, to an image whose suffix is the format.

    A second panel has the collision geometries of a concave object, where the table has any.
    """
    measured = [{"solver": "dynamic", **point} for point in points if point["error"] is not None]
    hollow, bench = collision_points(measured), [point for point in measured if not point.get("collision")]
    figure = new_figure(1100 if hollow else 700, 450)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(1, 2 if hollow else 1, squeeze=False)[0]
    for number, group in enumerate(sorted({(point["solver"], point["backend"]) for point in bench})):
        _draw_bench(axes[0], [p for p in bench if (p["solver"], p["backend"]) == group], f"C{number}")
    if hollow:
        _draw_collisions(axes[1], hollow)
    return save_figure(figure, Path(path), dpi=150)


def _draw_bench(axes: Any, points: Sequence[dict[str, Any]], colour: str) -> None:
    """Draw the bench tests of one backend and solver, with its front."""
    still = points[0]["solver"] == "quasistatic"
    label = f"{points[0]['backend']}{', without inertia' if still else ''}"
    best = front(points)
    axes.scatter([p["cost"] for p in points], [p["error"] for p in points], s=16, color=colour, label=label)
    axes.step([p.cost for p in best], [p.error for p in best], where="post", color=colour, lw=1, zorder=0)
    for point in points:
        place = (point["cost"], point["error"])
        axes.annotate(
            preset_of(point), place, xytext=(5, 5), textcoords="offset points", color=colour, fontsize="small"
        )
    _label(axes, "bench tests, and the front of each backend", "largest relative error")


def _draw_collisions(axes: Any, points: Sequence[dict[str, Any]]) -> None:
    """Draw one colour per collision geometry and one marker per backend."""
    geometries = sorted({point["collision"] for point in points})
    for marker, backend in zip("os^Dv", sorted({point["backend"] for point in points}), strict=False):
        for number, geometry in enumerate(geometries):
            some = [point for point in points if (point["backend"], point["collision"]) == (backend, geometry)]
            axes.scatter([p["cost"] for p in some], [p["error"] for p in some], s=22, marker=marker, color=f"C{number}")
        axes.scatter([], [], s=22, marker=marker, color="0.5", label=backend)
    for number, geometry in enumerate(geometries):
        axes.scatter([], [], s=22, marker="s", color=f"C{number}", label=geometry)
    _label(axes, "whisking into a hollow, by collision geometry", "relative error of the base moment")


def _label(axes: Any, title: str, error: str) -> None:
    axes.set(xscale="log", yscale="log", title=title, xlabel="processor seconds per whisker-second", ylabel=error)
    axes.margins(x=0.12)
    axes.legend(frameon=False, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncol=4)
