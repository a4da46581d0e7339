"""Pressure of rigid bodies on an elastomer: Hertz's problem for the indentation of the last update, of any shape.

The pad is an elastic half-space. Letters: B environment, R and C rows and columns of markers.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import torch

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.elastomer.runtime import ElastomerRuntime
from robotics_bridge.sensors.elastomer.taxel import ElastomerTaxel
from robotics_bridge.sensors.suite import SensorSuite

_STEPS = 300
_ACCURACY = 1e-5
"""Change of the pressure in a step, as a part of its norm, at which it is taken as found."""


def contact_pressure(
    suite: SensorSuite, name: str, *, modulus: float, poisson: float = 0.5, state: HandState | None = None
) -> torch.Tensor:
    """Return the pressure (Pa) [B, R, C] on the cells of an elastomer's grid; it is never negative.

    Environments that diverged, or whose pressure was not found, are NaN.

    Under a ball of radius r that is pressed in by δ it is Hertz's, with the total 4/3 E √r δ^1.5 / (1 − ν²), as long as
    the contact is at least five markers across and small beside the thickness of the pad.

    Args:
        suite: that read the sensor.
        name: of an ElastomerTaxel on a regular planar grid.
        modulus: Young's modulus E of the gel (Pa).
        poisson: its Poisson ratio ν.
        state: that was read. With it, pressures are scaled so that they add up to the normal forces of the engine's
            contacts between the pad's link and what the sensor tracks; the modulus then plays no part.
    """
    runtime = cast(ElastomerRuntime, suite.runtime_of(name, ElastomerTaxel, "elastomer"))
    sensor = cast(ElastomerTaxel, suite.sensors[name])
    check_number("modulus (Pa)", modulus, above=0)
    check_number("poisson", poisson, least=0, most=0.5)
    pitch = sensor.probes.pitch
    if not sensor.planar or pitch is None or min(sensor.probes.shape) < 2:
        raise UsageError(f"The pressure on {name!r} needs a regular planar grid of markers (Probes.grid).")
    place = runtime.slices[name]
    height = warp().to_torch(runtime.pads.height)[0, :, place.span].unflatten(1, place.layout).double()
    compliance = (1 - poisson**2) / (math.pi * modulus) * _love(place.layout, pitch)
    pressure = _solve(height, torch.as_tensor(compliance, device=height.device))
    if state is not None:
        load = _load(suite, sensor, state).double()
        total = pressure.sum((1, 2)) * pitch[0] * pitch[1]
        pressure = pressure * (load / total.clamp_min(1e-30)).where(total > 0, 0.0)[:, None, None]
    return pressure.masked_fill(suite.diverged[:, None, None], math.nan).float()


def _love(layout: tuple[int, ...], pitch: tuple[float, float]) -> np.ndarray:
    """Return π E / (1 − ν²) times the displacement of cells [2 R − 1, 2 C − 1] under unit pressure on the middle one.

    Love's solution for a rectangle (Johnson 1985, Contact Mechanics, eq. 3.25).
    """
    y = np.arange(1 - layout[0], layout[0])[:, None] * pitch[0]
    x = np.arange(1 - layout[1], layout[1])[None, :] * pitch[1]

    def corner(along: np.ndarray, across: np.ndarray) -> np.ndarray:
        # Sum over corners of along · asinh(across / |along|) + across · asinh(along / |across|): never a log of zero,
        # because corners of cells do not lie on axes through the middles of others.
        return along * np.arcsinh(across / np.abs(along)) + across * np.arcsinh(along / np.abs(across))

    a, b = pitch[1] / 2, pitch[0] / 2
    return corner(x + a, y + b) - corner(x - a, y + b) - corner(x + a, y - b) + corner(x - a, y - b)


def _solve(height: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    """Return p ≥ 0 [B, R, C] under which the surface sinks by ``height`` where p > 0, and by no less elsewhere.

    Conjugate gradients on the set in contact (Polonsky & Keer 1999), convolutions in Fourier space. NaN where they do
    not converge.
    """
    rows, columns = height.shape[1:]
    size = (3 * rows - 2, 3 * columns - 2)
    spectrum = torch.fft.rfft2(kernel, s=size)

    def sink(p: torch.Tensor) -> torch.Tensor:
        full = torch.fft.irfft2(torch.fft.rfft2(p, s=size) * spectrum, s=size)
        return full[:, rows - 1 : 2 * rows - 1, columns - 1 : 2 * columns - 1]

    def dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a * b).sum((1, 2), keepdim=True)

    tiny = torch.finfo(height.dtype).tiny
    p = height / kernel.sum()
    way, before, keep = torch.zeros_like(p), torch.ones_like(p[:, :1, :1]), torch.zeros_like(p[:, :1, :1])
    for _ in range(_STEPS):
        gap = sink(p) - height
        inside = p > 0
        residual = gap * inside
        square = dot(residual, residual)
        way = (residual + keep * square / before.clamp_min(tiny) * way) * inside
        step = dot(residual, way) / dot(sink(way), way).clamp_min(tiny)
        new = (p - step * way).clamp_min(0)
        # Cells without pressure that the body would overlap come into contact, and the search begins anew.
        overlap = (new == 0) & (gap < 0) & ~inside
        new = torch.where(overlap, -step * gap, new)
        keep = (~overlap.any(dim=1, keepdim=True).any(dim=2, keepdim=True)).to(p.dtype)
        change, p, before = (new - p).norm(dim=(1, 2)), new, square
        # By environment: beside a large pressure in one, a small one elsewhere would never count.
        found = change <= _ACCURACY * p.norm(dim=(1, 2))
        if found.all():
            break
    return p.masked_fill(~found[:, None, None], math.nan)


def _load(suite: SensorSuite, sensor: ElastomerTaxel, state: HandState) -> torch.Tensor:
    """Return the normal forces [B] (N) of the contacts between a sensor's link and what it tracks."""
    wp, scene = warp(), suite.scene
    device = wp.to_torch(state.contact_force).device
    number = len(scene.geometries)
    own, tracked = (torch.zeros(number, dtype=torch.bool, device=device) for _ in range(2))
    own[list(scene.geometries_of(sensor.link))], tracked[list(sensor.tracked(scene))] = True, True
    pair = wp.to_torch(state.contact_geom).long()
    count = wp.to_torch(state.contact_count)
    valid = (torch.arange(len(pair), device=device) < count) & (pair >= 0).all(dim=1)
    first, second = pair.clamp_min(0).unbind(1)
    valid &= (own[first] & tracked[second]) | (own[second] & tracked[first])
    force = wp.to_torch(state.contact_force).where(valid, 0.0)
    env = wp.to_torch(state.contact_env).long().where(valid, 0)
    return torch.zeros(suite.num_envs, device=device).index_add_(0, env, force)
