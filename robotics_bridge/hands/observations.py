"""Observations of a policy from the sensors of a hand: the tactile types of the thesis (tables 4.3, 4.6), and the
centre of pressure of each link.

Readings are those of one sensor per link, in the layout's order. Letters: B environment, N probe of a link, L link.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from brainbench.core.errors import UsageError, check_each, check_name
from robotics_bridge import sensors
from robotics_bridge.hands.layouts import Layout
from robotics_bridge.sensors.sensor import Sensor

PATCH_FORCE_SCALE = 1e4  # from summed depth (m) to the reading of the real finger tip (4.29)
TAXELS_IN_CONTACT = 2  # more taxels than this must touch for a link to count as touching (table 4.6)

HOLDING: Mapping[str, Any] = {"total": "engine", "friction": 1.0}
"""Settings of force taxels whose tangential reading is what holds an object (coefficient of rubber on a solid, 1)."""
_LAW = ("convention", "total", "friction", "twist")


@dataclass(frozen=True)
class ObservationType:
    """One row of table 4.3."""

    sensor: str | None
    """Name of the sensor class, None for no touch."""
    per_link: bool
    """One value or vector per link instead of per taxel."""
    channels: int
    """Per taxel or link."""


OBSERVATIONS: dict[str, ObservationType] = {
    "none": ObservationType(None, True, 0),
    # Contact of each taxel, and of each link: more than two of its taxels touch.
    "bool": ObservationType("ContactProbe", False, 1),
    "agg_bool": ObservationType("ContactProbe", True, 1),
    # Depth of each taxel (m), and the force of each link from summed depths.
    "depth": ObservationType("ContactDepthProbe", False, 1),
    "agg_force": ObservationType("ContactDepthProbe", True, 3),
    # Force, and force and torque, of each taxel (N, N·m).
    "force": ObservationType("KinematicTaxel", False, 3),
    "force_torque": ObservationType("KinematicTaxel", False, 6),
    # Displacement of each marker (m); force and torque from nearby surface.
    "elastomer": ObservationType("ElastomerTaxel", False, 3),
    "proximity": ObservationType("ProximityTaxel", False, 6),
    # Force of each link (N), the point at which it acts (m) and the torque about its normal there (N·m).
    "center_of_pressure": ObservationType("KinematicTaxel", True, 7),
}
"""Name → type."""


def observation_type(name: str) -> ObservationType:
    """Return an observation type by name; raise UsageError if there is none of this name."""
    check_name("observation type", name, OBSERVATIONS)
    return OBSERVATIONS[name]


PROXIMITY_RADIUS = 0.01  # sensing radius of proximity taxels (table 4.6) [m]


def sensors_for(
    name: str, layout: Layout, *, noisy: bool = False, track: tuple[str, ...] = (), **knobs: Any
) -> dict[str, Sensor]:
    """Return the sensors of an observation type, one per link and named by it, with the published parameters.

    Args:
        name: One of :data:`OBSERVATIONS`; ``none`` needs no sensors.
        layout: Link → probes.
        noisy: With the published imperfections of the type (table 4.12), the release threshold included.
        track: Links that are looked at; empty means everything that may touch.
        **knobs: Further settings of the sensor class, e.g. ``convention="thesis"`` or ``points=500``. Force taxels hold
            what they touch and add up to the engine's contact forces (:data:`HOLDING`), unless a convention, a total, a
            friction or a ``twist`` is stated, which means the law; other classes ignore ``twist``.
    """
    kind = observation_type(name)
    if kind.sensor is None:
        return {}
    settings: dict[str, Any] = {"track": track, **knobs}
    if kind.sensor == "KinematicTaxel" and all(knobs.get(name) is None for name in _LAW):
        settings |= HOLDING
    elif kind.sensor == "KinematicTaxel" and settings.get("total") is None:
        settings["total"] = "law"
    if kind.sensor != "KinematicTaxel":
        # Only a force law has it; tasks and stored students state theirs for any type.
        settings.pop("twist", None)
    if noisy:
        preset = "force" if name == "center_of_pressure" else name
        settings["noise"] = sensors.Noise.preset(f"published-{preset}")
        if kind.sensor == "ContactProbe":
            settings.setdefault("release", 2e-4)
    if kind.sensor == "ElastomerTaxel" and any(not probes.active.all() for probes in layout.values()):
        # A grid with fillers is no regular one; its sources are summed directly.
        settings.setdefault("dilation", "direct")
    make, sensors_of = getattr(sensors, kind.sensor), {}
    names = [field.name for field in fields(make) if field.name not in ("link", "probes")]
    check_each(f"setting of {kind.sensor}", settings, names)
    for link, probes in layout.items():
        placed = probes.with_radius(PROXIMITY_RADIUS) if kind.sensor == "ProximityTaxel" else probes
        sensors_of[link] = make(link=link, probes=placed, **settings)
    return sensors_of


def observe(name: str, readings: Mapping[str, torch.Tensor], layout: Layout) -> torch.Tensor:
    """Turn the readings of a hand's sensors into one observation [B, F] (equations 4.29, 4.30).

    Fillers are left out, so that F counts active taxels only.

    Args:
        name: One of :data:`OBSERVATIONS`.
        readings: Link → reading [B, N], [B, N, C], [B, ny, nx] or [B, ny, nx, C] of its sensor.
        layout: Link → probes; fixes the order.
    """
    kind = observation_type(name)
    if kind.sensor is None:
        batch = next((reading.shape[0] for reading in readings.values()), 0)
        return torch.zeros(batch, 0)
    if not layout:
        raise UsageError("An observation needs at least one link with probes; received none.")
    make = getattr(sensors, kind.sensor)
    parts = []
    for link, probes in layout.items():
        check_name("link among the readings", link, readings)
        reading, channels = readings[link], (make.channels,) if make.channels else ()
        if tuple(reading.shape[1:]) not in {(*probes.shape, *channels), (len(probes), *channels)}:
            wanted = ", ".join(map(str, ("B", *probes.shape, *channels)))
            raise UsageError(
                f"The reading {name!r} of link {link!r} with its {len(probes)} probes has the shape ({wanted}); "
                f"received {tuple(reading.shape)}."
            )
        active = torch.as_tensor(probes.active.copy(), device=reading.device)
        parts.append(reading.reshape(reading.shape[0], len(probes), make.channels or 1)[:, active].float())
    taxels = torch.cat(parts, dim=1)
    return ObservationMap(name, layout, taxels.device)(taxels).flatten(1)


class ObservationMap:
    """From the active taxels of a layout, link by link [B, N, C], to their observation [B, items, channels]."""

    def __init__(self, name: str, layout: Layout, device: Any = "cpu") -> None:
        kind = observation_type(name)
        counts = [int(probes.active.sum()) for probes in layout.values()]
        links = np.repeat(np.arange(len(counts)), counts)
        self._name, self._channels = name, kind.channels
        self.items: int = len(counts) if kind.per_link else len(links)
        """Active taxels, or links."""
        self._pool = None
        self._patches: list[tuple[torch.Tensor, ...]] = []
        if name == "center_of_pressure":
            for number, probes in enumerate(layout.values()):
                arrays = (probes.position[probes.active], probes.normal[probes.active])
                patch = [torch.as_tensor(array, dtype=torch.float32, device=device) for array in arrays]
                self._patches.append((torch.as_tensor(np.flatnonzero(links == number), device=device), *patch))
        elif kind.per_link:
            pool = np.zeros((len(links), self.items, kind.channels))
            # Sum over the taxels of a link as one matrix product: counts of contacts, or 10⁴ Σ d n with axes z, y, x
            # (4.29).
            normal = np.concatenate([probes.normal[probes.active] for probes in layout.values()])
            pool[np.arange(len(links)), links] = 1.0 if name == "agg_bool" else PATCH_FORCE_SCALE * normal[:, ::-1]
            self._pool = torch.as_tensor(pool, dtype=torch.float32, device=device).flatten(1)

    def __call__(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the observation; a graph can record it."""
        if self._patches:
            parts = [
                center_of_pressure(taxels.index_select(1, members), place, normal)
                for members, place, normal in self._patches
            ]
            return torch.stack(parts, dim=1)
        if self._pool is None:
            return taxels[..., : self._channels]
        # One product for all links: no sum has to be taken by index, whose order differs from run to run on a GPU.
        pooled = (taxels[..., 0] @ self._pool).unflatten(1, (self.items, self._channels))
        return (pooled > TAXELS_IN_CONTACT).float() if self._name == "agg_bool" else pooled


def center_of_pressure(values: torch.Tensor, place: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    """Return force, point and torsion [B, 7] of wrenches [B, N, 6] of a link, in its frame; zeros without a touch.

    ``place`` and ``normal`` [N, 3] are those of its taxels. The point is their mean by normal force; the torsion is the
    torque about it, along their mean normal by force.
    """
    weight = (values[..., :3] * normal).sum(dim=-1).abs()
    total = weight.sum(dim=1, keepdim=True)
    share = weight / total.clamp_min(1e-12)
    force, point = values[..., :3].sum(dim=1), share @ place
    axis = torch.nn.functional.normalize(share @ normal, dim=1)
    moment = values[..., 3:].sum(dim=1) - torch.linalg.cross(point, force)
    return torch.cat([force, point, (moment * axis).sum(dim=1, keepdim=True)], dim=1) * (total > 0)
