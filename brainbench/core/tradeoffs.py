"""Trade-offs between error and cost: measured points, their Pareto front, and the cheapest good enough."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from brainbench.core.errors import UsageError


@dataclass(frozen=True)
class TradeoffPoint:
    """One measured setting."""

    error: float
    """Relative error against the reference, by the rule stated beside the table (0.01 = 1 %)."""
    cost: float
    """Cost, in the unit stated beside the table; only ratios between points matter."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings, by name."""


def pareto_front(points: Iterable[TradeoffPoint]) -> list[TradeoffPoint]:
    """Return the points that no other beats in both error and cost, cheapest first.

    Points whose error or cost is not finite failed and are left out; of equal points one stays.

    >>> [p.error for p in pareto_front([TradeoffPoint(0.1, 1), TradeoffPoint(0.2, 2), TradeoffPoint(0.01, 5)])]
    [0.1, 0.01]
    """
    usable = [point for point in points if math.isfinite(point.error) and math.isfinite(point.cost)]
    front: list[TradeoffPoint] = []
    for point in sorted(usable, key=lambda point: (point.cost, point.error)):
        if not front or point.error < front[-1].error:
            front.append(point)
    return front


def cheapest(points: Iterable[TradeoffPoint], error: float) -> TradeoffPoint:
    """Return the cheapest point whose error is at most ``error``."""
    front = pareto_front(points)
    if not front:
        raise UsageError("No measured setting is usable, so none can be chosen automatically.")
    for point in front:
        if point.error <= error:
            return point
    best = front[-1]
    raise UsageError(
        f"No measured setting reaches an error of {error:g}; the most accurate one has {best.error:.3g} "
        f"({', '.join(f'{name} {value}' for name, value in best.settings.items())}). Ask for at least that."
    )
