"""Frozen configurations of sensors; a suite turns those of one kind into a runtime that serves them together.

:class:`Fidelity` trades the exactness of all sensors of a suite for speed.
"""

from __future__ import annotations

import abc
from collections.abc import Hashable, Mapping
from dataclasses import field, fields, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from brainbench.core.errors import UsageError, check_name
from brainbench.core.files import read_json
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.tradeoffs import TradeoffPoint, cheapest
from robotics_bridge.sensors.noise.model import BASE_KNOBS, PROBE_KNOBS, Noise
from robotics_bridge.sensors.probes.placement import Probes

if TYPE_CHECKING:
    from robotics_bridge.physics.scene import TouchScene

Convention = Literal["physical", "thesis"]


@limited(kw_only=True)
class Sensor(abc.ABC):
    """Configuration of a sensor on one link."""

    link: str
    """The link that carries it."""
    noise: Noise = field(default_factory=Noise)
    """Imperfections of the measured reading."""
    history: Annotated[int, Limit(least=0)] = 0
    """Last readings kept, at the rate of updates; 0 keeps none."""

    channels: ClassVar[int] = 0
    """Channels of a reading; 0 is a scalar per probe."""
    units: ClassVar[str] = ""
    knobs: ClassVar[frozenset[str]] = BASE_KNOBS
    """Noise knobs it has (thesis, table 4.2)."""
    shared: ClassVar[tuple[str, ...]] = ()
    """Attributes that sensors of its class have in common where one runtime and its kernels serve them."""
    runtime: ClassVar[str] = ""
    """``package.module:Class`` of the runtime that serves those of one group, imported when a suite is built."""

    def __post_init__(self) -> None:
        self.noise.check(self.knobs, type(self).__name__)

    @abc.abstractmethod
    def layout(self) -> tuple[int, ...]:
        """Return the shape (N,) or (rows, columns) of the reading of one environment, without channels."""

    @property
    def ignores_load(self) -> bool:
        """True if it reads forces that do not follow the forces of the engine, which users are told of once."""
        return False

    @property
    def needs(self) -> tuple[str, str]:
        """What it asks of everything that touches its link and a flex does not have, and what to do; or nothing."""
        return "", ""

    def for_scene(self, scene: TouchScene) -> Sensor:
        """Return the sensor with what it leaves open settled for a scene; flexes that it cannot feel are refused."""
        need, remedy = self.needs
        if need and scene.flexes:
            raise UsageError(
                f"{type(self).__name__} on link {self.link!r} asks for {need}, which the flex {scene.flexes[0]!r} does "
                f"not have: {remedy}, or use KinematicTaxel(total='engine'), which feels flexes by the engine's "
                "contacts."
            )
        return self

    def group(self) -> Hashable:
        """Return the values of :attr:`shared`."""
        return tuple(getattr(self, name) for name in self.shared)

    def queries(self, scene: TouchScene) -> frozenset[tuple[str, int]]:
        """Return ``sdf`` or ``raycast`` and the geometry of every query that must be prepared for it."""
        del scene
        return frozenset()


@limited(kw_only=True)
class ProbeSensor(Sensor):
    """A sensor made of probes that look at geometries of other links."""

    probes: Probes
    """Places of its probes, in the frame of the link."""
    track: tuple[str, ...] = ()
    """Links it looks at; empty means everything that may touch its link (and everything else, where that collides with
    nothing and contacts do not matter)."""

    knobs: ClassVar[frozenset[str]] = PROBE_KNOBS
    contact_only: ClassVar[bool] = False
    """True if it meets only geometries that the engine reports in contact with its link."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # Sensors are told apart by what they track, so that it must be hashable.
        object.__setattr__(self, "track", tuple(self.track))

    def layout(self) -> tuple[int, ...]:
        """Return the shape (N,) or (rows, columns) of the reading of one environment, without channels."""
        return self.probes.shape

    @property
    def needs(self) -> tuple[str, str]:
        """Distances, unless it looks at named links alone."""
        return "" if self.track else "distances", "name the links it looks at with track=(...)"

    @property
    def followed(self) -> tuple[object, ...]:
        """Description of the geometries it looks at: equal for sensors that look at the same."""
        return self.track, "" if self.track else self.link

    def tracked(self, scene: TouchScene) -> tuple[int, ...]:
        """Return the numbers of the geometries it looks at."""
        scene.link_index(self.link)
        if not self.track:
            return scene.candidates(self.link) if self.contact_only else scene.surroundings(self.link)
        return tuple(sorted({g for link in self.track for g in scene.geometries_of(link)}))


@limited(kw_only=True)
class QuerySensor(ProbeSensor):
    """A probe sensor that asks for distances, by fields or by triangles."""

    query: Literal["sdf", "raycast"] = "sdf"
    """``sdf``: closed forms, and for meshes sampled fields, or the nearest triangle where walls are thin for the cells.
    ``raycast``: the nearest triangle for all; primitives become triangles too."""
    pairs: Literal["contact", "all"] = "contact"
    """``contact``: geometries that the engine reports in contact with the link (published); ``all``: every tracked
    geometry within reach, for engines or links without collision."""

    shared: ClassVar[tuple[str, ...]] = ("query",)

    @property
    def contact_only(self) -> bool:  # type: ignore[override]
        """True if it meets only geometries that the engine reports in contact with its link."""
        return self.pairs == "contact"

    def queries(self, scene: TouchScene) -> frozenset[tuple[str, int]]:
        """Return the queries of what it tracks."""
        return frozenset((self.query, geometry) for geometry in self.tracked(scene))


TABLE = Path(__file__).with_name("fidelity_table.json")
"""The measured settings that ship with the package."""


@limited
class SensorFidelity:
    """Settings that trade exactness for speed; the rest of a sensor is its own."""

    query: Literal["sdf", "raycast"] = "sdf"
    """Way to ask meshes for their distance: sampled fields, or the nearest triangle."""
    resolution: Annotated[int, Limit(least=4, most=512)] = 64
    """Cells of a distance field along the longest edge of its mesh."""
    points: Count = 2000
    """Surface points of tracked objects, for proximity and elastomer taxels."""

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
            names = {field.name for field in fields(sensor)}
            # An elastomer without points has been told to leave shear out.
            wanted = {"query": self.query} | ({"points": self.points} if getattr(sensor, "points", 0) else {})
            changed = {key: value for key, value in wanted.items() if key in names}
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
