"""Runtime of elastomers: indentation, its spreading, anchored points and the sum over both, in that order.

The pressure under a pad follows from its indentation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError, check_number
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.context import ReadoutSlice, fill
from robotics_bridge.sensors.kernels.dilation import (
    CHUNK,
    ElastomerArrays,
    GelParams,
    anchor_kernel,
    indent_kernel,
    marker_kernel,
    spread_kernel,
    sum_shear,
)
from robotics_bridge.sensors.kernels.proximity import BLOCK, CloudArrays
from robotics_bridge.sensors.queries.solids import sample_cloud
from robotics_bridge.sensors.runtime import ProbeRuntime, SuiteContext
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.taxels.sensors import ElastomerTaxel, Layer

wp = warp()

_NEGLIGIBLE = 1e-7  # weight of a Gaussian from which on it is left out


class ElastomerRuntime(ProbeRuntime):
    """Serves elastomers that follow the same points and sum their dilation in the same way."""

    def __init__(self, sensors: Mapping[str, ElastomerTaxel], context: SuiteContext) -> None:
        super().__init__(sensors, 3, context)
        scene, envs = context.scene, context.num_envs
        self._sensors = list(sensors.values())
        first = self._sensors[0]
        self._raycast, self._way = first.query == "raycast", first.way
        self.recordable = self._way != "fft"
        self._layered = any(sensor.layer for sensor in self._sensors)
        self._planes = 2 if any(sensor.noise.radius for sensor in self._sensors) else 1
        count, tracked = len(self._sensors), first.tracked(scene)
        self._followed = first.points > 0 and bool(tracked)
        cloud = sample_cloud(context.solids, tracked, first.points) if self._followed else None
        self.points = cloud.struct if cloud else CloudArrays()
        """Warp structure of the surface points that are followed."""
        total_points = cloud.total if cloud else 0
        pad_geometries = [sensor.pad_geometries(scene) if self._followed else () for sensor in self._sensors]
        members = [g for one in pad_geometries for g in one]
        self._own_kinds = context.solids.kinds_of(sorted(set(members)))
        # Threads of a GPU are environments and want them side by side. A processor walks through the points of one, and
        # through its markers: a thread for each costs more.
        self.side_by_side = bool(context.device.is_cuda)
        # Only a processor finds a grid's shear cheaper by rows and columns than marker by marker.
        self.apart = self._followed and self._way != "direct" and not self.side_by_side
        self._blocks = -(-total_points // BLOCK)
        total, blocks = max(count * self._blocks * BLOCK, 1), max(count * self._blocks, 1)
        rows, columns = (max(side) for side in zip(*map(_sides, self.slices.values()), strict=True))
        pads = ElastomerArrays()
        pads.gels, pads.blocks = self._describe(pad_geometries), self._blocks
        pads.weights, pads.reach = self._weigh()
        pads.tracked, pads.own = context.array(tracked or [0], int), context.array(members or [0], int)
        pads.indentation = context.zeros((2 * self._planes, envs, self.count))
        pads.spread = context.zeros((3 * self._planes, envs, self.count) if self._way != "direct" else (1, 1, 1))
        pads.stamp, pads.dragged = (context.array(np.full((envs, count), -1), int) for _ in range(2))
        pads.held, pads.moved = (context.zeros((blocks, envs), int) for _ in range(2))
        pads.anchor = self._by_point((total, 3, envs), float)
        pads.drive, pads.order = self._by_point((total, envs), float), self._by_point((total, envs), wp.uint8)
        shapes = {"drag": (envs, self.count), "along": (envs, -(-columns // 4), CHUNK), "across": (envs, rows, CHUNK)}
        for (name, shape), dtype in zip(shapes.items(), (wp.vec2f, wp.vec4f, wp.vec2f), strict=True):
            setattr(pads, name, context.zeros(shape if self.apart else (1,) * len(shape), dtype))
        self.pads = pads
        """Warp structure of gels, sums and anchors."""
        self.lasting = [pads.stamp, pads.dragged, *([pads.anchor, pads.held] if total_points else [])]
        self._spectra: list[Any] = []

    def _by_point(self, shape: tuple[int, ...], dtype: Any) -> Any:
        """Return zeros [..., B] whose fastest axis in memory is B on a GPU, and the points of one on a processor."""
        if self.side_by_side:
            return self.context.zeros(shape, dtype)
        order = (*range(1, len(shape)), 0)
        return self.context.zeros((shape[-1], *shape[:-1]), dtype).transpose(order)

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c, pads, in_turn = self.context, self.pads, not self.side_by_side
        solids, pairs = c.solids.struct, c.pairs.struct
        indent = indent_kernel(self.kinds, self._raycast, self._planes, in_turn)
        self.launch(indent, self.probes, solids, pairs, self.io, pads)
        if self._way == "separable":
            self.launch(spread_kernel(self._planes, in_turn), self.probes, self.io, pads)
        elif self._way == "fft":
            self._transform()
        if self._followed:
            kernel = anchor_kernel(self._own_kinds, self._raycast, self.side_by_side)
            dim = pads.held.shape if self.side_by_side else pads.held.shape[::-1]
            c.launch(kernel, dim, pads, solids, pairs, self.points, self.io)
        if self.apart:
            c.launch(sum_shear, c.num_envs, self.probes, self.io, pads, pairs, self.points)
        way = ("direct", "separable", "fft").index(self._way)
        kernel = marker_kernel(way, self._layered, self._planes, self.mode, *self.stores, in_turn, self.apart)
        self.launch(kernel, self.probes, self.io, pads, pairs, self.points)

    def launch(self, kernel: Any, *inputs: Any) -> None:
        """Run a kernel over all environments and markers."""
        self.context.launch(kernel, (self.context.num_envs, self.count if self.side_by_side else 1), *inputs)

    def _describe(self, pad_geometries: list[tuple[int, ...]]) -> Any:
        """Return the structures of the gels; ``own`` are the geometries of each pad."""
        gels, owned = [], 0
        for index, (sensor, place) in enumerate(zip(self._sensors, self.slices.values(), strict=True)):
            probes, layer = sensor.probes, sensor.layer or Layer()
            rows, columns = _sides(place)
            widening = layer.expansion if isinstance(layer.expansion, tuple) else (layer.expansion,) * 2
            pitch = probes.pitch or (0.0, 0.0)
            along, across, normal = _axes(sensor)
            gel = fill(
                GelParams, sensor, layer, layered=sensor.layer is not None, expansion=widening,
                frame=layer.frame or (0.0, 0.0), start=place.start, rows=rows, columns=columns, step_y=pitch[0],
                step_x=pitch[1], slot=self.slots[index], own_first=owned, own_last=owned + len(pad_geometries[index]),
                along=along, across=across, normal=normal, center=probes.position[probes.active].mean(axis=0),
            )  # fmt: skip
            owned += len(pad_geometries[index])
            gels.append(gel)
        return self.context.array(gels, GelParams)

    def _weigh(self) -> tuple[Any, Any]:
        """Return one-dimensional weights [S, 2, K] along columns and rows, and how far [S, 2] they count."""
        if self._way != "separable":
            return self.context.zeros((1, 1, 1)), self.context.zeros((1, 1), int)
        reach = np.zeros((len(self._sensors), 2), np.int32)
        columns = []
        for row, sensor in zip(reach, self._sensors, strict=True):
            shape, pitch = sensor.probes.shape, sensor.probes.pitch or (1.0, 1.0)
            for axis, (step, length) in enumerate(((pitch[1], shape[1]), (pitch[0], shape[0]))):
                # Distance at which exp(−λ_d r²) falls to the negligible weight; beyond it, markers are not asked.
                far = math.sqrt(-math.log(_NEGLIGIBLE) / sensor.dilate_spread) if sensor.dilate_spread else math.inf
                row[axis] = length - 1 if step * length <= far else min(length - 1, math.ceil(far / step))
                columns.append((sensor.dilate_spread, step))
        weights = np.zeros((len(reach), 2, int(reach.max()) + 1), np.float32)
        away = np.arange(weights.shape[2])
        for index, (spread, step) in enumerate(columns):
            weights[index // 2, index % 2] = np.exp(-spread * (away * step) ** 2)
        return self.context.array(weights, float), self.context.array(reach, int)

    def _transform(self) -> None:
        """Convolve h with the three dilation kernels in Fourier space, zero outside the grid."""
        height, out = wp.to_torch(self.pads.indentation), wp.to_torch(self.pads.spread)
        if not self._spectra:
            self._spectra = [_spectrum(sensor, height.device) for sensor in self._sensors]
        for place, (size, spectrum) in zip(self.slices.values(), self._spectra, strict=True):
            rows, columns = place.layout
            span = place.span
            for plane in range(self._planes):
                h = height[plane, :, span].unflatten(1, (rows, columns))
                # Padding to 3 n − 2 along each side holds the full linear convolution, so that nothing wraps around the
                # edges. Two transforms serve three kernels: the tangential ones share that of h.
                flat = torch.fft.rfft2(h, s=size)
                bulge = height[self._planes + plane, :, span].unflatten(1, (rows, columns))
                raised = torch.fft.rfft2(bulge, s=size)
                for channel, signal in enumerate((flat, flat, raised)):
                    field = torch.fft.irfft2(signal * spectrum[channel], s=size)
                    out[3 * plane + channel, :, span] = field[
                        :, rows - 1 : 2 * rows - 1, columns - 1 : 2 * columns - 1
                    ].flatten(1)


def _sides(place: ReadoutSlice) -> tuple[int, int]:
    return (place.layout[0], place.layout[1]) if len(place.layout) == 2 else (1, place.count)


def _axes(sensor: ElastomerTaxel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the unit vectors of a grid: the way columns grow, the way rows grow, and out of the pad."""
    probes = sensor.probes
    normal = probes.normal[probes.active].mean(axis=0)
    normal = normal / max(float(np.linalg.norm(normal)), 1e-12)
    along = np.cross([0.0, 1.0, 0.0], normal) if abs(normal[1]) < 0.9 else np.cross([0.0, 0.0, 1.0], normal)
    if len(probes.shape) == 2:
        corners = probes.position.reshape(*probes.shape, 3)
        if probes.shape[1] > 1:
            along = corners[0, -1] - corners[0, 0]
        elif probes.shape[0] > 1:
            along = np.cross(corners[-1, 0] - corners[0, 0], normal)
    along = along - normal * (along @ normal)
    along = along / max(float(np.linalg.norm(along)), 1e-12)
    across = np.cross(normal, along)
    if len(probes.shape) == 2 and (corners[-1, 0] - corners[0, 0]) @ across < 0:
        # Rows of a mirrored grid, or of one that is counted from the top, grow the other way.
        across = -across
    return along, across, normal


def _spectrum(sensor: ElastomerTaxel, device: Any) -> tuple[tuple[int, int], Any]:
    """Return the padded size of a grid and the spectra [3, …] of its kernels: along, across and normal."""
    rows, columns = sensor.probes.shape
    pitch = sensor.probes.pitch or (1.0, 1.0)
    # Kernels of 4.19 over all offsets between two markers, with the layer's factor 1 − κ λ_d r² on the tangential ones.
    y = torch.arange(1 - rows, rows, device=device)[:, None] * pitch[0]
    x = torch.arange(1 - columns, columns, device=device)[None, :] * pitch[1]
    reach = sensor.dilate_spread * (x**2 + y**2)
    bell = torch.exp(-reach)
    push = bell * (1 - (sensor.layer.recoil if sensor.layer else 0.0) * reach)
    size = (3 * rows - 2, 3 * columns - 2)
    return size, torch.fft.rfft2(torch.stack([x * push, y * push, bell]), s=size)


_STEPS = 300
_ACCURACY = 1e-5  # change of the pressure in a step, as a part of its norm, at which it is taken as found


def contact_pressure(
    suite: SensorSuite, name: str, *, modulus: float, poisson: float = 0.5, state: HandState | None = None
) -> torch.Tensor:
    """Return the pressure (Pa) [B, R, C] on the cells of an elastomer's grid; it is never negative.

    Environments that diverged, or whose pressure was not found, are NaN.

    Under a ball of radius r that is pressed in by δ it is Sneddon's (1965), and Hertz's for a small δ, with the total
    4/3 E √r δ^1.5 / (1 − ν²), as long as the contact is at least five markers across and small beside the thickness of
    the pad.

    Args:
        suite: that read the sensor.
        name: of an ElastomerTaxel on a regular planar grid.
        modulus: Young's modulus E of the gel (Pa).
        poisson: its Poisson ratio ν.
        state: that was read. With it, pressures are scaled so that they add up to the normal forces of the engine's
            contacts between the pad's link and what the sensor tracks; the modulus then plays no part.
    """
    check_number("modulus (Pa)", modulus, above=0)
    check_number("poisson", poisson, least=0, most=0.5)
    sensor, pitch, _kernel, pressure = _pressed(suite, name)
    pressure = pressure * (math.pi * modulus / (1 - poisson**2))
    if state is not None:
        load = _load(suite, sensor, state).double()
        total = pressure.sum((1, 2)) * pitch[0] * pitch[1]
        pressure = pressure * (load / total.clamp_min(1e-30)).where(total > 0, 0.0)[:, None, None]
    return pressure.masked_fill(suite.diverged[:, None, None], math.nan).float()


def gel_surface(suite: SensorSuite, name: str) -> torch.Tensor:
    """Return how far (m) [B, R, C] the surface of an elastomer is pushed in at each marker, beside contacts too.

    Where a body touches, that is its overlap; elsewhere the surface of a half-space under the pressure of
    :func:`contact_pressure`, whatever the modulus. Environments that diverged are NaN.
    """
    _sensor, _pitch, kernel, pressure = _pressed(suite, name)
    return _sink(pressure, kernel).masked_fill(suite.diverged[:, None, None], math.nan).float()


def _pressed(suite: SensorSuite, name: str) -> tuple[ElastomerTaxel, tuple[float, float], torch.Tensor, torch.Tensor]:
    """Return a sensor, its pitch, the kernel of :func:`_love`, and the pressure [B, R, C] for π E / (1 − ν²) = 1."""
    runtime = cast(ElastomerRuntime, suite.runtime_of(name, ElastomerTaxel, "elastomer"))
    sensor = cast(ElastomerTaxel, suite.sensors[name])
    pitch = sensor.probes.pitch
    if not sensor.planar or pitch is None or min(sensor.probes.shape) < 2:
        raise UsageError(f"The pressure on {name!r} needs a regular planar grid of markers (Probes.grid).")
    place = runtime.slices[name]
    height = warp().to_torch(runtime.pads.indentation)[0, :, place.span].unflatten(1, place.layout).double()
    kernel = torch.as_tensor(_love(place.layout, pitch), device=height.device)
    return sensor, pitch, kernel, _solve(_depth(height, pitch), kernel)


def _depth(height: torch.Tensor, pitch: tuple[float, float]) -> torch.Tensor:
    """Return how deep bodies reach below each marker [B, R, C], from the distances to their surfaces at the markers.

    A ball about a marker up to the nearest surface lies inside its body, whose own surface is the envelope of all.
    """
    square, most = height.clamp_min(0) ** 2, float(height.nan_to_num(0.0, 0.0).max())
    # Squares of depths are h² less the squares of both offsets, so one axis follows the other.
    for axis, step in enumerate(pitch, start=1):
        # Half of the slope of the square is how far from a ball's centre its deepest point lies, between markers too.
        (slope,), deepest = torch.gradient(square, spacing=step, dim=axis), square.clone()
        reach = min(int(most / step) + 1, square.shape[axis] - 1)
        for place in range(-reach, reach + 1):
            part = axis, max(0, place), square.shape[axis] - abs(place)
            lean = slope.narrow(*part) / 2 - place * step
            nearer = lean.clamp(-step / 2, step / 2)
            depth = square.narrow(*part) - (place * step) ** 2 + nearer * (2 * lean - nearer)
            target = deepest.narrow(axis, max(0, -place), part[2])
            target.copy_(torch.maximum(target, depth))
        square = deepest
    return square.sqrt()


def _love(layout: tuple[int, ...], pitch: tuple[float, float]) -> np.ndarray:
    """Return π E / (1 − ν²) times the displacement of cells [2 R − 1, 2 C − 1] under unit pressure on the middle one.

    Love's solution for a rectangle (Johnson 1985, Contact Mechanics, eq. 3.25).
    """
    y = np.arange(1 - layout[0], layout[0])[:, None] * pitch[0]
    x = np.arange(1 - layout[1], layout[1])[None, :] * pitch[1]

    def _corner(along: np.ndarray, across: np.ndarray) -> np.ndarray:
        # Sum over corners of along · asinh(across / |along|) + across · asinh(along / |across|): never a log of zero,
        # because corners of cells do not lie on axes through the middles of others.
        return along * np.arcsinh(across / np.abs(along)) + across * np.arcsinh(along / np.abs(across))

    a, b = pitch[1] / 2, pitch[0] / 2
    return _corner(x + a, y + b) - _corner(x - a, y + b) - _corner(x + a, y - b) + _corner(x - a, y - b)


def _sink(pressure: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    """Return by how much the surface sinks [B, R, C]: pressures convolved with the kernel, in Fourier space."""
    rows, columns = pressure.shape[1:]
    size = (3 * rows - 2, 3 * columns - 2)
    full = torch.fft.irfft2(torch.fft.rfft2(pressure, s=size) * torch.fft.rfft2(kernel, s=size), s=size)
    return full[:, rows - 1 : 2 * rows - 1, columns - 1 : 2 * columns - 1]


def _solve(height: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    """Return p ≥ 0 [B, R, C] under which the surface sinks by ``height`` where p > 0, and by no less elsewhere.

    Conjugate gradients on the set in contact (Polonsky & Keer 1999). NaN where they do not converge.
    """

    def _dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a * b).sum((1, 2), keepdim=True)

    tiny = torch.finfo(height.dtype).tiny
    p = height / kernel.sum()
    way, before, keep = torch.zeros_like(p), torch.ones_like(p[:, :1, :1]), torch.zeros_like(p[:, :1, :1])
    for _ in range(_STEPS):
        gap = _sink(p, kernel) - height
        inside = p > 0
        residual = gap * inside
        square = _dot(residual, residual)
        way = (residual + keep * square / before.clamp_min(tiny) * way) * inside
        step = _dot(residual, way) / _dot(_sink(way, kernel), way).clamp_min(tiny)
        new = (p - step * way).clamp_min(0)
        # Cells without pressure that the body would overlap come into contact, and the search begins anew.
        overlap = (new == 0) & (gap < 0) & ~inside
        new = torch.where(overlap, -step * gap, new)
        keep = (~overlap.any(dim=1, keepdim=True).any(dim=2, keepdim=True)).to(p.dtype)
        change, p, before = (new - p).norm(dim=(1, 2)), new, square
        # By environment: beside a large pressure in one, a small one elsewhere would never count.
        converged = change <= _ACCURACY * p.norm(dim=(1, 2))
        if converged.all():
            break
    return p.masked_fill(~converged[:, None, None], math.nan)


def _load(suite: SensorSuite, sensor: ElastomerTaxel, state: HandState) -> torch.Tensor:
    """Return the normal forces [B] (N) of the contacts between a sensor's link and what it tracks."""
    wp, scene = warp(), suite.scene
    device = wp.to_torch(state.contact_force).device
    number = len(scene.geometries)
    on_pad, tracked = (torch.zeros(number, dtype=torch.bool, device=device) for _ in range(2))
    on_pad[list(scene.geometries_of(sensor.link))], tracked[list(sensor.tracked(scene))] = True, True
    pair = wp.to_torch(state.contact_geom).long()
    count = wp.to_torch(state.contact_count)
    valid = (torch.arange(len(pair), device=device) < count) & (pair >= 0).all(dim=1)
    first, second = pair.clamp_min(0).unbind(1)
    valid &= (on_pad[first] & tracked[second]) | (on_pad[second] & tracked[first])
    force = wp.to_torch(state.contact_force).where(valid, 0.0)
    env = wp.to_torch(state.contact_env).long().where(valid, 0)
    return torch.zeros(suite.num_envs, device=device).index_add_(0, env, force)
