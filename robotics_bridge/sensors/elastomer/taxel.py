"""ElastomerTaxel: displacement of markers on a soft pad, by dilation and by anchored shear (thesis 4.17–4.21)."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError, unknown_name
from robotics_bridge.sensors.elastomer.kernels.anchors import anchor_kernel
from robotics_bridge.sensors.elastomer.kernels.shear import CHUNK, sum_shear
from robotics_bridge.sensors.noise.model import TAXEL_KNOBS
from robotics_bridge.sensors.queries.surface_points import sample_cloud
from robotics_bridge.sensors.sensor import ProbeRuntime, QueryRequirements, QuerySensor
from robotics_bridge.sensors.taxels.kernels.proximity import BLOCK, CloudArrays

if TYPE_CHECKING:
    from robotics_bridge.physics.scene import TouchScene
    from robotics_bridge.physics.state import HandState
    from robotics_bridge.sensors.sensor import Context, ReadoutSlice

_NEGLIGIBLE = 1e-7


@dataclass(frozen=True, kw_only=True)
class Layer:
    """Terms of a real gel pad that the published equations lack; derived in docs/tactile.md.

    Raises:
        UsageError: a number lies outside its range.
    """

    poisson: float = 0.45
    """Poisson ratio ν: how compressible the gel is (0 to 0.5). It shapes the shear field."""
    softening: float = 1e-3
    """Radius over which a surface point spreads its traction (m)."""
    thickness: float = 0.0
    """Of a layer bonded to a rigid base (m); 0 means a half-space."""
    recoil: float = 0.0
    """κ: how much of the push past its middle turns round, by 1 − κ λ_d r². The net push is 1 − 2κ of the published
    one: at ½ the gel takes all that is displaced up, above it is drawn in, as under any load on a compressible body."""
    expansion: float | tuple[float, float] = 0.0
    """Lateral strain of the pad per metre of its mean indentation (1/m), or along and across: what the gel cannot
    compress, it widens."""
    frame: tuple[float, float] | None = None
    """Half widths (m), along and across, of the clamped frame where the widening vanishes; None means free edges."""

    def __post_init__(self) -> None:
        if not 0 <= self.poisson <= 0.5:
            raise UsageError(f"A Poisson ratio of a gel lies between 0 and 0.5; received {self.poisson!r}.")
        if not self.softening > 0 or self.thickness < 0:
            raise UsageError(
                f"softening is positive and thickness not negative (m); received {self.softening!r} and "
                f"{self.thickness!r}."
            )
        if not 0 <= self.recoil <= 2:
            raise UsageError(f"recoil lies between 0 (as published) and 2; received {self.recoil!r}.")
        if self.frame is not None and not min(self.frame) > 0:
            raise UsageError(f"The half widths of a frame are positive (m); received {self.frame!r}.")


@dataclass(frozen=True, kw_only=True)
class ElastomerTaxel(QuerySensor):
    """Marker displacement [N, 3] in the link frame (m).

    The pad is the surface of the link's own geometries (or the plane of the probes, if the link has none). What
    indents it pushes markers apart (4.19); points that slide along it drag them (4.20). Defaults are the published
    parameters; ``layer`` replaces the Gaussian shear kernel by that of an elastic layer.

    Raises:
        UsageError: the way to sum dilation is unknown or does not fit the probes or the layer, or a length is negative.
    """

    dilate_scale: float = 100.0
    """s_d, 1/m."""
    dilate_spread: float = 8000.0
    """λ_d, 1/m²."""
    shear_scale: float = 100.0
    """s_s, 1/m (the published configuration file has 200)."""
    shear_spread: float = 2000.0
    """λ_s, 1/m²."""
    exponent: float = 1.2
    """α of the bulge along the normal."""
    points: int = 1000
    """Surface points of what is tracked that are followed for shear; 0 leaves shear out."""
    enter: float = 1e-5
    """Depth (m) at which a point anchors."""
    leave: float = 1e-4
    """Height (m) above the pad at which it lets go."""
    layer: Layer | None = None
    dilation: Literal["auto", "separable", "fft", "direct"] = "auto"
    """How sources are summed. Planar grids: ``separable`` passes (``auto``), or ``fft``. Curved ones: ``direct``."""

    channels: ClassVar[int] = 3
    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS

    def __post_init__(self) -> None:
        super().__post_init__()
        ways = ("auto", "separable", "fft", "direct")
        if self.dilation not in ways:
            raise unknown_name("way to sum dilation", self.dilation, ways)
        if self.dilation in ("separable", "fft") and not self.planar:
            raise UsageError(
                f"dilation={self.dilation!r} needs a regular planar grid (Probes.grid); these probes are "
                "placed freely. Use 'auto' or 'direct'."
            )
        if self.dilation == "separable" and self.layer and self.layer.recoil:
            raise UsageError("A layer with recoil has no separable dilation; use dilation='auto', 'fft' or 'direct'.")
        if self.points < 0 or min(self.dilate_spread, self.shear_spread, self.enter, self.leave) < 0:
            raise UsageError("points, spreads and the thresholds of an elastomer must not be negative.")

    @property
    def planar(self) -> bool:
        """Whether its markers form a regular planar grid without fillers."""
        probes = self.probes
        return probes.pitch is not None and len(probes.shape) == 2 and bool(probes.active.all())

    @property
    def way(self) -> str:
        """How its dilation is summed."""
        if self.dilation != "auto":
            return self.dilation
        if not self.planar:
            return "direct"
        return "fft" if self.layer and self.layer.recoil else "separable"

    def group(self) -> Hashable:
        """Sensors of one class and equal group share one runtime and its kernels."""
        return (self.query, self.way, self.points, self.track, "" if self.track else self.link)

    def own(self, scene: TouchScene) -> tuple[int, ...]:
        """Return the geometries of its own link that can be indented."""
        return tuple(g for g in scene.geometries_of(self.link) if scene.geometries[g].kind != "other")

    def asks(self, scene: TouchScene) -> QueryRequirements:
        """Return what must be built for it."""
        asks = super().asks(scene)
        own = frozenset(self.own(scene)) if self.points else frozenset()
        if self.query == "sdf":
            return QueryRequirements(fields=asks.fields | own)
        return QueryRequirements(trees=asks.trees | own)

    @classmethod
    def build(cls, sensors: Mapping[str, Self], context: Context) -> ElastomerRuntime:
        """Return the runtime that serves these sensors together."""
        return ElastomerRuntime(sensors, context)


class ElastomerRuntime(ProbeRuntime):
    """Serves elastomers that follow the same points and sum their dilation in the same way.

    Args:
        sensors: Of one group, by name; those of a group share what decides which kernels run.
        context: Of the suite: scene, environments, device, clock and geometries.
    """

    def __init__(self, sensors: Mapping[str, ElastomerTaxel], context: Context) -> None:
        super().__init__(sensors, 3, context)
        wp, device, scene, envs = warp(), context.device, context.scene, context.num_envs
        self._sensors = list(sensors.values())
        first = self._sensors[0]
        self._raycast, self._way = first.query == "raycast", first.way
        self.recordable = self._way != "fft"
        self._layered = any(sensor.layer for sensor in self._sensors)
        self._planes = 2 if any(sensor.noise.radius for sensor in self._sensors) else 1
        count, tracked = len(self._sensors), first.tracked(scene)
        self._followed = first.points > 0 and bool(tracked)
        self._tracked = wp.array(np.array(tracked or [0], np.int32), dtype=wp.int32, device=device)
        cloud = sample_cloud(scene, tracked, first.points, context.solids.rows, device) if self._followed else None
        self._points = cloud.struct if cloud else CloudArrays()
        self._total = cloud.total if cloud else 0
        own = [sensor.own(scene) if self._followed else () for sensor in self._sensors]
        self._own_kinds = context.solids.kinds_of(sorted({g for members in own for g in members}))
        members = np.array([g for one in own for g in one] or [0], np.int32)
        self._own = wp.array(members, dtype=wp.int32, device=device)

        def floats(*shape: int) -> Any:
            return wp.zeros(shape, dtype=wp.float32, device=device)

        self._height = floats(2 * self._planes, envs, self.count)
        self._spread = floats(3 * self._planes, envs, self.count) if self._way != "direct" else floats(1, 1, 1)
        self._stamp = wp.full((envs, count), -1, dtype=wp.int32, device=device)
        self._dragged = wp.full((envs, count), -1, dtype=wp.int32, device=device)
        self._blocks = -(-self._total // BLOCK)
        total = max(count * self._blocks * BLOCK, 1)
        # Threads of a GPU are environments and want them side by side; a processor walks through the points of one.
        self._side_by_side = device.is_cuda
        self._anchor = floats(total, 3, envs) if self._side_by_side else floats(envs, total, 3).transpose((1, 2, 0))
        self._drive = floats(total, envs) if self._side_by_side else floats(envs, total).transpose((1, 0))
        order = wp.zeros((total, envs) if self._side_by_side else (envs, total), dtype=wp.uint8, device=device)
        self._order = order if self._side_by_side else order.transpose((1, 0))
        # A processor starts a thread for every marker at a cost that markers in turn do not have.
        self._in_turn = not device.is_cuda
        # Only a processor finds a grid's shear cheaper by rows and columns than marker by marker.
        self._apart = self._followed and self._way != "direct" and self._in_turn
        sides = [_sides(place) for place in self.places.values()]
        rows, columns = (max(side) for side in zip(*sides, strict=True))
        drag = (envs, self.count), (envs, -(-columns // 4), CHUNK), (envs, rows, CHUNK)
        self._drag, self._along, self._across = (
            wp.zeros(shape if self._apart else (1,) * len(shape), dtype=kind, device=device)
            for shape, kind in zip(drag, (wp.vec2f, wp.vec4f, wp.vec2f), strict=True)
        )
        stores = (max(count * self._blocks, 1), envs)
        self._held, self._moved = (wp.zeros(stores, dtype=wp.int32, device=device) for _ in range(2))
        exponents = np.array([sensor.exponent for sensor in self._sensors], np.float32)
        self._exponents = wp.array(exponents, dtype=wp.float32, device=device)
        self._weights, self._reach = self._weigh()
        self._gels = self._describe(own)
        self._spectra: list[Any] = []

    @property
    def state_bytes(self) -> int:
        """Lasting memory per environment [bytes]: readings and anchors."""
        return super().state_bytes + 4 * (3 * self._total + self._blocks + 2) * len(self._sensors)

    @property
    def scratch_bytes(self) -> int:
        """Memory per environment [bytes] that every update writes anew: heights, their sums and drives of points."""
        spread = 3 * self._planes if self._way != "direct" else 0
        followed = (5 * self._total + 4 * self._blocks) * len(self._sensors)
        if self._apart:
            followed += 8 * self.count + CHUNK * (16 * self._along.shape[1] + 8 * self._across.shape[1])
        return followed + 4 * self.count * (2 * self._planes + spread)

    def update(self, state: HandState, dt: float) -> None:
        """Read the state."""
        from robotics_bridge.sensors.elastomer.kernels import dilation as kernels

        wp, c = warp(), self.context
        self.begin(state, dt)
        solids, pairs = c.solids.struct, c.pairs.struct
        indent = kernels.indent_kernel(self.kinds, self._raycast, self._planes, self._in_turn)
        inputs = [self.probes, solids, pairs, self.io, self.knobs, self._stamp, self._exponents, self._height]
        self.launch(indent, *inputs)
        if self._way == "separable":
            inputs = [self.probes, self.io, self._gels, self._weights, self._reach, self._stamp, self._height]
            self.launch(kernels.spread_kernel(self._planes, self._in_turn), *inputs, self._spread)
        elif self._way == "fft":
            self._transform()
        if self._followed:
            inputs = [self._gels, self._own, self._tracked, solids, pairs, self._points, self.io]
            inputs += [self._blocks, self._anchor, self._held, self._moved, self._dragged, self._drive, self._order]
            kernel = anchor_kernel(self._own_kinds, self._raycast, self._side_by_side, self._in_turn)
            dim = (self._held.shape[0], c.num_envs)
            wp.launch(kernel, dim=dim if self._side_by_side else dim[::-1], inputs=inputs, device=c.device)
        shear = [self._moved, self._dragged, self._anchor, self._drive, self._order]
        if self._apart:
            inputs = [self.probes, self.io, self._gels, self._blocks, self._tracked, pairs, self._points, *shear]
            inputs += [self._along, self._across, self._drag]
            wp.launch(sum_shear, dim=c.num_envs, inputs=inputs, device=c.device)
        way = ("direct", "separable", "fft").index(self._way)
        kernel = kernels.marker_kernel(
            way, self._layered, self._planes, self.mode, *self.stores, self._in_turn, self._apart
        )
        inputs = [self.probes, self.io, self.knobs, self._gels, self._weights, self._reach, self._stamp, self._height]
        inputs += [self._spread, self._blocks, self._tracked, pairs, self._points]
        self.launch(kernel, *inputs, *shear, self._drag)
        self.finish(dt)

    def launch(self, kernel: Any, *inputs: Any) -> None:
        """Run a kernel over all environments and markers."""
        dim = (self.context.num_envs, 1 if self._in_turn else self.count)
        warp().launch(kernel, dim=dim, inputs=inputs, device=self.context.device)

    def _describe(self, own: list[tuple[int, ...]]) -> Any:
        from robotics_bridge.sensors.elastomer.kernels.dilation import GelParams

        wp = warp()
        slots = self.probes.slot.numpy()
        gels, owned = [], 0
        for index, (sensor, place) in enumerate(zip(self._sensors, self.places.values(), strict=True)):
            gel, probes, layer = GelParams(), sensor.probes, sensor.layer or Layer()
            rows, columns = _sides(place)
            widening = layer.expansion if isinstance(layer.expansion, tuple) else (layer.expansion,) * 2
            along, across, normal = _axes(sensor)
            values = {
                "dilate": sensor.dilate_scale,
                "shear": sensor.shear_scale,
                "spread": sensor.dilate_spread,
                "smear": sensor.shear_spread,
                "exponent": sensor.exponent,
                "enter": sensor.enter,
                "leave": sensor.leave,
                "layered": int(sensor.layer is not None),
                "poisson": layer.poisson,
                "softening": layer.softening,
                "thickness": layer.thickness,
                "recoil": layer.recoil,
                "expansion_x": widening[0],
                "expansion_y": widening[1],
                "frame_x": layer.frame[0] if layer.frame else 0.0,
                "frame_y": layer.frame[1] if layer.frame else 0.0,
                "start": place.start,
                "rows": rows,
                "columns": columns,
                "step_y": probes.pitch[0] if probes.pitch else 0.0,
                "step_x": probes.pitch[1] if probes.pitch else 0.0,
                "link": self.context.scene.link_index(sensor.link),
                "slot": int(slots[place.start]),
                "own_first": owned,
                "own_last": owned + len(own[index]),
            }
            owned += len(own[index])
            for name, value in values.items():
                setattr(gel, name, value)
            for name, value in (("along", along), ("across", across), ("normal", normal)):
                setattr(gel, name, wp.vec3f(*value.tolist()))
            gel.center = wp.vec3f(*probes.position[probes.active].mean(axis=0).tolist())
            gels.append(gel)
        return wp.array(gels, dtype=GelParams, device=self.context.device)

    def _weigh(self) -> tuple[Any, Any]:
        """One-dimensional weights [S, 2, K] along columns and rows, and how far [S, 2] they count."""
        wp, device = warp(), self.context.device
        if self._way != "separable":
            return wp.zeros((1, 1, 1), dtype=wp.float32, device=device), wp.zeros((1, 1), dtype=wp.int32, device=device)
        reach = np.zeros((len(self._sensors), 2), np.int32)
        columns = []
        for row, sensor in zip(reach, self._sensors, strict=True):
            shape, pitch = sensor.probes.shape, sensor.probes.pitch or (1.0, 1.0)
            for axis, (step, length) in enumerate(((pitch[1], shape[1]), (pitch[0], shape[0]))):
                far = math.sqrt(-math.log(_NEGLIGIBLE) / sensor.dilate_spread) if sensor.dilate_spread else math.inf
                row[axis] = length - 1 if step * length <= far else min(length - 1, math.ceil(far / step))
                columns.append((sensor.dilate_spread, step))
        weights = np.zeros((len(reach), 2, int(reach.max()) + 1), np.float32)
        away = np.arange(weights.shape[2])
        for index, (spread, step) in enumerate(columns):
            weights[index // 2, index % 2] = np.exp(-spread * (away * step) ** 2)
        return wp.array(weights, device=device), wp.array(reach, device=device)

    def _transform(self) -> None:
        """Convolve h with the three dilation kernels in Fourier space, zero outside the grid."""
        import torch

        wp = warp()
        height, out = wp.to_torch(self._height), wp.to_torch(self._spread)
        if not self._spectra:
            self._spectra = [_spectrum(sensor, height.device) for sensor in self._sensors]
        for place, (size, spectrum) in zip(self.places.values(), self._spectra, strict=True):
            rows, columns = place.layout
            span = slice(place.start, place.start + place.count)
            for plane in range(self._planes):
                h = height[plane, :, span].unflatten(1, (rows, columns))
                flat = torch.fft.rfft2(h, s=size)
                bulge = height[self._planes + plane, :, span].unflatten(1, (rows, columns))
                raised = torch.fft.rfft2(bulge, s=size)
                for channel, signal in enumerate((flat, flat, raised)):
                    field = torch.fft.irfft2(signal * spectrum[channel], s=size)
                    out[3 * plane + channel, :, span] = field[
                        :, rows - 1 : 2 * rows - 1, columns - 1 : 2 * columns - 1
                    ].flatten(1)


def _sides(place: ReadoutSlice) -> tuple[int, int]:
    """Rows and columns of a sensor's markers."""
    return (place.layout[0], place.layout[1]) if len(place.layout) == 2 else (1, place.count)


def _axes(sensor: ElastomerTaxel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors of a grid: the way columns grow, the way rows grow, and out of the pad."""
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
    return along, np.cross(normal, along), normal


def _spectrum(sensor: ElastomerTaxel, device: Any) -> tuple[tuple[int, int], Any]:
    """Padded size of a grid and the spectra [3, …] of its kernels: along, across and normal."""
    import torch

    rows, columns = sensor.probes.shape
    pitch = sensor.probes.pitch or (1.0, 1.0)
    y = torch.arange(1 - rows, rows, device=device)[:, None] * pitch[0]
    x = torch.arange(1 - columns, columns, device=device)[None, :] * pitch[1]
    reach = sensor.dilate_spread * (x**2 + y**2)
    bell = torch.exp(-reach)
    push = bell * (1 - (sensor.layer.recoil if sensor.layer else 0.0) * reach)
    size = (3 * rows - 2, 3 * columns - 2)
    return size, torch.fft.rfft2(torch.stack([x * push, y * push, bell]), s=size)
