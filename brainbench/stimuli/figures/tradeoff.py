"""The panels of a trade-off plot: error against cost, per backend and per collision geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from brainbench.core.tradeoffs import TradeoffPoint


def draw_bench(
    axes: Any, points: Sequence[Mapping[str, Any]], names: Sequence[str], best: Sequence[TradeoffPoint], colour: str
) -> None:
    """Draw the bench tests of one backend, each named or not, with its front."""
    if not points:
        return
    still = points[0].get("solver", "dynamic") == "quasistatic"
    label = f"{points[0]['backend']}{', without inertia' if still else ''}"
    axes.scatter([p["cost"] for p in points], [p["error"] for p in points], s=16, color=colour, label=label)
    axes.step([p.cost for p in best], [p.error for p in best], where="post", color=colour, lw=1, zorder=0)
    for point, name in zip(points, names, strict=True):
        place = (point["cost"], point["error"])
        axes.annotate(name, place, xytext=(5, 5), textcoords="offset points", color=colour, fontsize="small")
    _label(axes, "bench tests, and the front of each backend", "largest relative error")


def draw_collisions(axes: Any, points: Sequence[Mapping[str, Any]]) -> None:
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
