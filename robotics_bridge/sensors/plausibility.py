"""Warnings of sensors that can hardly be meant: lengths in millimetres, and probes that nothing can reach."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np

from brainbench.core.rotations import to_matrices
from robotics_bridge.physics.scene import TouchScene
from robotics_bridge.sensors.probes.placement import Probes, enclosing_sphere
from robotics_bridge.sensors.probes.sensors import ContactProbe, SurfaceDistanceProbe
from robotics_bridge.sensors.sensor import ProbeSensor, Sensor
from robotics_bridge.sensors.temperature.grid import TemperatureGrid

LARGEST = 3.0
"""Radius (m) around the probes of one sensor, or around a touched mesh, above which numbers look like millimetres."""
WIDEST = 0.3
"""Sensing radius (m) of a taxel above which it does, if it also exceeds the patch of its sensor."""
DEEPEST = 0.05
"""Depth (m) at which a contact begins above which it does."""
_CONVEX = ("sphere", "capsule", "ellipsoid", "cylinder", "box")


def warn_of(scene: TouchScene, sensors: Mapping[str, Sensor]) -> None:
    """Warn once of lengths that look like millimetres, and of each sensor whose probes mostly lie inside its link."""
    probing = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, ProbeSensor)}
    sizes = [(f"the probes of {name!r}", enclosing_sphere(sensor.probes)[1]) for name, sensor in probing.items()]
    tracked = {g for sensor in probing.values() for g in sensor.tracked(scene)}
    sizes += [(f"the mesh {mesh.name!r}", mesh.diagonal / 2) for g in tracked if (mesh := scene.geometries[g].mesh)]
    for name, sensor in sensors.items():
        if isinstance(sensor, TemperatureGrid) and sensor.low is not None and sensor.high is not None:
            sizes.append((f"the grid of {name!r}", float(np.linalg.norm(np.subtract(sensor.high, sensor.low))) / 2))
    found = [(what, f"{2 * size:g} m across") for what, size in sizes if size > LARGEST]
    for name, sensor in probing.items():
        widest = float(sensor.probes.radius.max(initial=0.0))
        patch = float(np.ptp(np.reshape(sensor.probes.position, (-1, 3)), axis=0).max())
        if widest > max(WIDEST, patch) and not isinstance(sensor, SurfaceDistanceProbe):
            found.append((f"the sensing radius of {name!r}", f"{widest:g} m"))
        if isinstance(sensor, ContactProbe) and sensor.threshold > DEEPEST:
            found.append((f"the threshold of {name!r}", f"{sensor.threshold:g} m"))
    if found:
        what, size = found[0]
        _warn(f"{what[:1].upper()}{what[1:]}: {size}. Lengths are in metres; scale millimetres by 1e-3.")
    for name, sensor in probing.items():
        buried = int(_buried(scene, sensor.link, sensor.probes).sum())
        # Some may lie where parts of a link overlap; distances are read from anywhere.
        if 2 * buried > int(sensor.probes.active.sum()) and not isinstance(sensor, SurfaceDistanceProbe):
            _warn(
                f"{buried} of {len(sensor.probes)} probes of {name!r} lie deeper inside their own link {sensor.link!r} "
                "than their sensing radius, so that nothing can touch them; place them on its surface."
            )


def _warn(text: str) -> None:
    warnings.warn(text, RuntimeWarning, stacklevel=4)


def _buried(scene: TouchScene, link: str, probes: Probes) -> np.ndarray:
    """Return a mask [N] of active probes whose sensing sphere lies within one convex solid of their link."""
    found = np.zeros(len(probes), bool)
    for geometry in (scene.geometries[g] for g in scene.geometries_of(link)):
        if geometry.kind in _CONVEX:
            local = (np.asarray(probes.position) - geometry.position) @ to_matrices(geometry.quaternion)
            # Depth in a convex solid is the least of h(d) − x · d over directions d, h its support function. Finitely
            # many directions overestimate it, by less than a fiftieth of its size.
            reach = geometry.reach(_DIRECTIONS)
            depth = (reach - local @ _DIRECTIONS.T).min(axis=1)
            found |= probes.active & (depth > probes.radius + 0.02 * reach.max())
    return found


def _spread(count: int) -> np.ndarray:
    """Return unit vectors [count + 6, 3], evenly spread and along the axes."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn, flat = np.pi * (1 + np.sqrt(5)) * np.arange(count), np.sqrt(1 - z**2)
    return np.concatenate([np.c_[flat * np.cos(turn), flat * np.sin(turn), z], np.eye(3), -np.eye(3)])


_DIRECTIONS = _spread(200)
