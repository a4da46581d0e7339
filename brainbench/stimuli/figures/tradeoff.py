"""Chart of a table of :mod:`brainbench.stimuli.tradeoff`: error against cost, per backend and collision geometry."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from brainbench.core.figures.style import COLORS, panels, plain_log_ticks, save_figure
from brainbench.stimuli.tradeoff import ERROR, collision_points, front, preset_of


def plot_tradeoff(points: Iterable[dict[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Draw error against cost, with the front of each backend and the presets, to an image whose suffix is the format.

    A second panel has the collision geometries of a concave object, where the table has any.
    """
    measured = [{"solver": "dynamic", **point} for point in points if point[ERROR] is not None]
    hollow, bench = collision_points(measured), [point for point in measured if not point.get("collision")]
    figure, (axes,) = panels(1, 2 if hollow else 1, (10.5 if hollow else 6, 4.6))
    for number, group in enumerate(sorted({(point["solver"], point["backend"]) for point in bench})):
        _draw_bench(axes[0], [p for p in bench if (p["solver"], p["backend"]) == group], COLORS[number])
    _label(axes[0], "whiskers in contact, against a converged simulation", "relative error that 90 % stay below")
    if hollow:
        _draw_collisions(axes[1], hollow)
    return save_figure(figure, Path(path), dpi=150)


def _draw_bench(axes: Any, points: Sequence[dict[str, Any]], colour: str) -> None:
    """Draw the bench tests of one backend and solver, with its front."""
    still = points[0]["solver"] == "quasistatic"
    label = f"{points[0]['backend']}{', without inertia' if still else ''}"
    best = front(points)
    axes.scatter([p["cost"] for p in points], [p[ERROR] for p in points], s=14, color=colour, alpha=0.45, lw=0)
    line = {"where": "post", "color": colour, "lw": 1.2, "ms": 4, "label": label}
    axes.step([p.cost for p in best], [p.error for p in best], "o-", **line)
    for point in points:
        if name := preset_of(point):
            place, box = (point["cost"], point[ERROR]), {"facecolor": "white", "alpha": 0.6, "lw": 0, "pad": 0}
            axes.plot(*place, "o", ms=8, mfc="none", mec=colour)
            shift = {"xytext": (6, 5), "textcoords": "offset points", "ha": "left"}
            axes.annotate(name, place, color=colour, fontsize=8.5, bbox=box, **shift)


def _draw_collisions(axes: Any, points: Sequence[dict[str, Any]]) -> None:
    """Draw one colour per collision geometry and one marker per backend."""
    geometries = sorted({point["collision"] for point in points})
    for marker, backend in zip("os^Dv", sorted({point["backend"] for point in points}), strict=False):
        for number, geometry in enumerate(geometries):
            some = [point for point in points if (point["backend"], point["collision"]) == (backend, geometry)]
            place = [p["cost"] for p in some], [p[ERROR] for p in some]
            axes.scatter(*place, s=22, marker=marker, color=COLORS[number])
        axes.scatter([], [], s=22, marker=marker, color="0.5", label=backend)
    for number, geometry in enumerate(geometries):
        parts = f"convex parts, concavity {geometry.partition('-')[2]}"
        name = {"exact": "exact surface", "hull": "convex hull"}.get(geometry, parts)
        axes.scatter([], [], s=22, marker="s", color=COLORS[number], label=name)
    _label(axes, "hollow objects, by collision surface", "relative error that 90 % stay below")


def _label(axes: Any, title: str, error: str) -> None:
    axes.set(xscale="log", yscale="log", title=title, ylabel=error)
    axes.set_xlabel("processor time per second of one whisker (s/s)")
    plain_log_ticks(axes)
    axes.margins(x=0.12, y=0.12)
    axes.legend(frameon=False, fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncol=2)
