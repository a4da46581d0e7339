"""Exactness of sensors, with measured error and cost: query, resolution of distance fields, surface points.

The shipped table is made by ``brainbench tradeoff tactile`` (:mod:`robotics_bridge.sensors.tradeoff`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Literal

from brainbench.core.errors import check_name
from brainbench.core.files import read_json
from brainbench.core.reading.ranges import check_fields
from brainbench.core.tradeoffs import TradeoffPoint, cheapest
from robotics_bridge.sensors.sensor import Sensor

TABLE = Path(__file__).with_name("fidelity_table.json")
"""The measured settings that ship with the package."""


@dataclass(frozen=True)
class SensorFidelity:
    """Settings that trade exactness for speed; the rest of a sensor is its own."""

    query: Literal["sdf", "raycast"] = "sdf"
    """Way to ask meshes for their distance: sampled fields, or the nearest triangle."""
    resolution: int = 64
    """Cells of a distance field along the longest edge of its mesh."""
    points: int = 2000
    """Surface points of tracked objects, for proximity and elastomer taxels."""

    def __post_init__(self) -> None:
        check_name("query", self.query, ("sdf", "raycast"))
        check_fields(self, "resolution", least=4, most=512, whole=True)
        check_fields(self, "points", least=1, whole=True)

    @classmethod
    def preset(cls, name: str) -> SensorFidelity:
        """Return ``fast``, ``balanced`` or ``accurate``; an unknown name raises UsageError."""
        check_name("tactile fidelity", name, PRESETS)
        return PRESETS[name]

    @classmethod
    def auto(cls, error: float) -> SensorFidelity:
        """Return the cheapest measured settings whose relative force errors are at most ``error``."""
        meshes = cheapest(_points("mesh"), error).settings
        points = cheapest(_points("points"), error).settings
        return cls(meshes["query"], meshes["resolution"] or 64, points["points"])

    def apply(self, sensors: Mapping[str, Sensor]) -> dict[str, Sensor]:
        """Return the sensors with these settings in place of their own, where they have them."""
        out = {}
        for name, sensor in sensors.items():
            own = {field.name for field in fields(sensor)}
            # An elastomer without points has been told to leave shear out.
            wanted = {"query": self.query} | ({"points": self.points} if getattr(sensor, "points", 0) else {})
            changed = {key: value for key, value in wanted.items() if key in own}
            out[name] = replace(sensor, **changed) if changed else sensor
        return out


Fidelity = SensorFidelity
"""Its public name, ``robotics_bridge.sensors.Fidelity``."""

PRESETS: dict[str, SensorFidelity] = {
    "fast": SensorFidelity("sdf", 32, 500),
    "balanced": SensorFidelity("sdf", 64, 2000),
    "accurate": SensorFidelity("raycast", 128, 16_000),
}
"""Named settings; the table says what each costs and errs."""


@cache
def _points(part: str) -> list[TradeoffPoint]:
    rows = [row for row in read_json(TABLE)["points"] if row["part"] == part]
    return [TradeoffPoint(row["error"], row["cost"], row) for row in rows]
