"""Surfaces to draw, and how light finds them: objects as triangles with creased normals, whiskers as tapered tubes.

Visible points and shadows are found by rays against a tree of boxes, because pictures are wanted on machines that have
Python packages only: 3-D packages draw through OpenGL or Vulkan drivers of the system, and matplotlib sorts whole
polygons instead of pixels, so that thin whiskers show through objects. Metres, world axes.

Letters: F triangle, V vertex, n ring of a tube, k corner of a ring.

A camera makes of points in the world (metres) points in a picture (pixels): x to the right, y down, the origin at the
upper left corner of the first pixel. *Nearness* grows towards the camera and is linear across the picture of a plane:
1/distance in perspective, minus the distance otherwise.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import usable_processors, warp
from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.limits import Limit, limited
from brainbench.core.rotations import Length, Point, Vector, euler_matrix, to_matrices
from brainbench.geometry import Mesh, convex_hull
from brainbench.stimuli.motion.trajectories import Path, Spin
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Part, RigidMotion, Sphere
from brainbench.stimuli.objects.procedural.bodies import transported_normals
from brainbench.stimuli.objects.solid import PlacedObject

VIEWS: dict[str, Vector] = {
    "top": (0.0, 0.0, 1.0),
    "bottom": (0.0, 0.0, -1.0),
    "side": (1.0, 0.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "front": (0.0, 1.0, 0.0),
    "back": (0.0, -1.0, 0.0),
    "oblique": (0.42, -0.72, 0.55),
}
"""Directions from the target to the camera, in world axes (x right, y rostral, z dorsal): ``side`` looks
at the animal's right side, ``front`` into its face."""


@limited(of="{} of a camera")
class Camera:
    """Viewpoint, projection and frame of a picture; what is unknown or out of range is a :class:`UsageError`."""

    view: str | Vector = "oblique"
    """top, bottom, side, left, front, back, oblique, or the direction x,y,z to the camera (world)."""
    projection: Literal["perspective", "orthographic"] = "perspective"
    """``perspective``, or ``orthographic`` for measuring."""
    target: Point | None = None
    """Point in the middle of the picture [m, world]; None frames what is shown."""
    width: Length | None = None
    """Width of the picture in the plane of the target [m]; None frames what is shown."""
    field_of_view: Annotated[float, Limit(above=0, below=math.pi, unit="rad")] = math.radians(24)
    """Horizontal opening angle of the perspective [rad]."""

    def __post_init__(self) -> None:
        if isinstance(self.view, str) and self.view not in VIEWS:
            raise unknown_name("view", self.view, VIEWS)
        if not any(self.view):
            raise UsageError("The view of a camera is a direction; (0, 0, 0) is none.")

    @property
    def axes(self) -> NDArray[np.float64]:
        """Unit vectors [3, 3] to the right, up and towards the camera, as rows (world)."""
        towards = np.asarray(VIEWS[self.view] if isinstance(self.view, str) else self.view, dtype=float)
        towards = towards / np.linalg.norm(towards)
        # Dorsal is up, except in pictures from above or below, where rostral is.
        up = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
        right = np.cross(up, towards)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(towards, right), towards])

    def lens(self, points: ArrayLike, size: tuple[int, int]) -> Lens:
        """Fit the camera to points [n, 3] (m, world) that must be in the picture where target or width are None.

        ``size`` is the width and height of the picture in pixels.
        """
        axes = self.axes
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            points = np.zeros((1, 3))
        local = points @ axes.T
        middle = axes.T @ (local.min(axis=0) + local.max(axis=0)) / 2 if self.target is None else np.array(self.target)
        local = (points - middle) @ axes.T
        margin, aspect = 1.12, size[0] / size[1]
        half = max(np.abs(local[:, 0]).max(), np.abs(local[:, 1]).max() * aspect, 1e-6)
        ratio = math.tan(self.field_of_view / 2)
        if self.projection == "perspective":
            # A point nearer than the target looks larger: its distance is short of the camera's by its depth.
            extent = np.maximum(np.abs(local[:, 0]), np.abs(local[:, 1]) * aspect)
            half = max(float((extent + ratio * local[:, 2]).max()), 1e-6)
        width = 2 * margin * half if self.width is None else self.width
        distance = width / 2 / ratio if self.projection == "perspective" else None
        return Lens(axes, middle, width, size, distance)


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera at its place."""

    axes: NDArray[np.float64]
    """Unit vectors [3, 3] to the right, up and towards the camera, as rows (world)."""
    target: NDArray[np.float64]
    """[3] point (m, world) in the middle of the picture."""
    width: float
    """Width of the picture in the plane of the target [m]."""
    size: tuple[int, int]
    """Width and height in pixels."""
    distance: float | None
    """From the camera to the target [m]; None for an orthographic camera."""

    @property
    def scale(self) -> float:
        """Pixels per metre in the plane of the target."""
        return self.size[0] / self.width

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return picture x, picture y (pixels) and nearness [..., 3] of points [..., 3] (m, world).

        What lies behind a perspective camera has no picture: NaN.
        """
        local = (points - self.target) @ self.axes.T
        x, y, depth = np.moveaxis(local, -1, 0)
        if self.distance is None:
            factor, nearness = np.full_like(x, self.scale), depth
        else:
            away = self.distance - depth
            # Within a fiftieth of the distance the picture would grow without bound: that counts as behind.
            nearness = np.divide(1.0, away, out=np.full_like(away, np.nan), where=away > 0.02 * self.distance)
            factor = self.scale * self.distance * nearness
        return np.stack([self.size[0] / 2 + factor * x, self.size[1] / 2 - factor * y, nearness], axis=-1)

    def unproject(self, x: ArrayLike, y: ArrayLike, nearness: ArrayLike) -> NDArray[np.float64]:
        """Return the points [n, 3] (m, world) whose picture is at x, y (pixels) with this nearness [n]."""
        x, y, nearness = (np.asarray(values, dtype=float) for values in (x, y, nearness))
        if self.distance is None:
            depth, factor = nearness, 1 / self.scale
        else:
            depth, factor = self.distance - 1 / nearness, 1 / (self.scale * self.distance * nearness)
        local = np.stack([(x - self.size[0] / 2) * factor, (self.size[1] / 2 - y) * factor, depth], axis=-1)
        return self.target + local @ self.axes

    def pixel_size(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the length [...] (m) that one pixel covers at each of the points [..., 3] (m, world)."""
        depth = (points - self.target) @ self.axes[2]
        if self.distance is None:
            return np.full(depth.shape, 1 / self.scale)
        return np.maximum(self.distance - depth, 0.02 * self.distance) / (self.distance * self.scale)

    def supersampled(self, factor: int) -> Lens:
        """Return the lens for a picture with ``factor`` times as many pixels each way."""
        return replace(self, size=(self.size[0] * factor, self.size[1] * factor))


AMBIENT, KEY = 0.58, 0.50
FLOOR_SHADE = 0.22
SHADOW_DETAIL = 1.2
_PENUMBRA = np.array([(0, 0), (-2, -1), (1, -2), (2, 1), (-1, 2)])
"""Steps to the side of a point's rays to the lamp, in details of its shadows: edges become soft."""
_BLOCK = 1 << 17
_FIELDS = ("corners", "normals", "colors")


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles with a normal at each corner and one colour each."""

    corners: NDArray[np.float64]
    """[F, 3, 3] m, world."""
    normals: NDArray[np.float64]
    """[F, 3, 3] unit vectors; the side they point to does not matter."""
    colors: NDArray[np.float64]
    """[F, 3] red, green, blue from 0 to 1."""

    @classmethod
    def joined(cls, items: list[Triangles]) -> Triangles:
        """Return the triangles of all items."""
        none = Triangles(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        return cls(*(np.concatenate([getattr(item, name) for item in (none, *items)]) for name in _FIELDS))


class RayTree:
    """Triangles in a tree of boxes, for rays seen from around ``centre`` [3] (m) at a scale of ``unit`` (m)."""

    def __init__(self, corners: NDArray[np.float64], centre: NDArray[np.float64], unit: float) -> None:
        # Rays are in single precision: coordinates near one keep its digits.
        self._centre, self._unit, self._mesh = centre, unit, None
        if len(corners):
            wp, local = warp(), self.local(corners).reshape(-1, 3)
            self._extent = 1.01 * unit * float(np.linalg.norm(local, axis=1).max())
            points = wp.array(local, dtype=wp.vec3, device="cpu")
            self._mesh = wp.Mesh(points, wp.array(np.arange(3 * len(corners), dtype=np.int32), device="cpu"))

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return points [..., 3] (m, world) in the units of the rays."""
        return ((points - self._centre) / self._unit).astype(np.float32)

    def first_hits(self, lens: Lens) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the first triangle on each pixel's ray [H·W] (−1 for none), and weights [H·W, 3] of its corners."""
        from brainbench.stimuli.figures.kernels.rays import first_hit

        count = lens.size[0] * lens.size[1]
        face, weights = np.full(count, -1, dtype=np.int32), np.zeros((count, 3), dtype=np.float32)
        if self._mesh is None:
            return face, weights
        wp = warp()
        rays = [wp.vec3(*(value / self._unit).tolist()) for value in self._pixel_rays(lens)]

        def _cast(mesh: Any, first: int, last: int) -> None:
            outputs = [face[first:last], weights[first:last]]
            wp.launch(first_hit, last - first, [mesh.id, lens.size[0], first, *rays], outputs, device="cpu")

        self._in_blocks(count, _cast)
        return face, weights

    def blocked(self, points: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether a triangle lies in ``direction`` [3] of each of the points [n, 3] (m, world)."""
        from brainbench.stimuli.figures.kernels.rays import blocked

        wp = warp()
        start, dark = self.local(points), np.zeros(len(points), dtype=np.uint8)

        def _cast(mesh: Any, first: int, last: int) -> None:
            wp.launch(
                blocked, last - first, [mesh.id, start[first:last], wp.vec3(*direction.tolist())], [dark[first:last]],
                device="cpu",
            )  # fmt: skip

        self._in_blocks(len(points), _cast)
        return dark.astype(bool)

    def _in_blocks(self, count: int, cast: Any) -> None:
        """Call ``cast(mesh, first, last)`` for blocks of the rays, on all processors: Warp has one thread a launch."""
        if self._mesh is None:
            return
        warp().load_module("brainbench.stimuli.figures.kernels.rays", device="cpu")
        starts = range(0, count, _BLOCK)
        with ThreadPoolExecutor(usable_processors()) as pool:
            list(pool.map(lambda first: cast(self._mesh, first, min(first + _BLOCK, count)), starts))

    def _pixel_rays(self, lens: Lens) -> tuple[NDArray[np.float64], ...]:
        """Return origin and direction of the first pixel's ray, each with its steps to the right and down (m)."""
        right, up, towards = lens.axes
        pixel = 1 / lens.scale
        corner = ((0.5 - lens.size[0] / 2) * right - (0.5 - lens.size[1] / 2) * up) * pixel
        middle, steps, still = lens.target - self._centre, (pixel * right, -pixel * up), (np.zeros(3), np.zeros(3))
        if lens.distance is None:
            return middle + corner + self._extent * towards, *steps, -towards * self._unit, *still
        return middle + lens.distance * towards, *still, corner - lens.distance * towards, *steps


@dataclass(frozen=True, eq=False)
class VisibleSurface:
    """What is visible of some triangles at the pixels of a picture."""

    nearness: NDArray[np.float64]
    """[H, W] nearness of the surface; −∞ where there is none."""
    pixels: NDArray[np.int64]
    """[n] flat indices of the covered pixels."""
    points: NDArray[np.float64]
    """[n, 3] surface points (m, world)."""
    normals: NDArray[np.float32]
    """[n, 3] unit normals that face the camera."""
    colors: NDArray[np.float32]
    """[n, 3] colours."""


def draw(triangles: Triangles, lens: Lens) -> VisibleSurface:
    """Find the nearest triangle at each pixel, and point, normal and colour there."""
    face, weights = RayTree(triangles.corners, lens.target, lens.width).first_hits(lens)
    pixels = np.flatnonzero(face >= 0)
    face, weights = face[pixels], weights[pixels]
    points = np.einsum("nk,nki->ni", weights, triangles.corners[face])
    nearness = np.full(lens.size[0] * lens.size[1], -np.inf)
    nearness[pixels] = lens.project(points)[:, 2]
    normals = np.einsum("nk,nki->ni", weights, triangles.normals.astype(np.float32)[face])
    # Normals are turned to the camera, because thin surfaces are seen from both sides.
    towards = lens.axes[2] if lens.distance is None else lens.target + lens.distance * lens.axes[2] - points
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    length = np.where(np.sum(normals * towards, axis=1) < 0, -length, length)
    normals /= length[:, None].astype(np.float32)
    grid = nearness.reshape(lens.size[1], lens.size[0])
    return VisibleSurface(grid, pixels, points, normals, triangles.colors.astype(np.float32)[face])


@dataclass(frozen=True, eq=False)
class Light:
    """A distant lamp, and the triangles that throw shadows in its light."""

    tree: RayTree
    axes: NDArray[np.float64]
    """Unit vectors [3, 3] to the right, up and towards the lamp as it sees the scene, as rows (world)."""
    pixel: float
    """Finest detail of shadows [m]."""
    strength: float = 1.0
    """Strength of the shadows, from 0 to 1: translucent objects throw weaker ones."""

    @property
    def direction(self) -> NDArray[np.float64]:
        """[3] unit vector towards the lamp (world)."""
        return self.axes[2]

    def reaches(self, points: NDArray[np.float64], bias: float = 4.0) -> NDArray[np.float32]:
        """Return how much of the light arrives [n], 0 to 1, at points [n, 3] (m).

        What lies within ``bias`` details towards the lamp throws no shadow: a surface that the lamp grazes would shade
        itself in stripes.
        """
        dark = np.zeros(len(points), dtype=np.float32)
        for aside in _PENUMBRA @ self.axes[:2]:
            dark += self.tree.blocked(points + self.pixel * (aside + bias * self.direction), self.direction)
        return 1 - np.float32(self.strength / len(_PENUMBRA)) * dark


def lamp(lens: Lens, samples: int, points: NDArray[np.float64], triangles: Triangles, strength: float = 1.0) -> Light:
    """Return a lamp over the camera's left shoulder, fitted to the ``points`` [n, 3] (m) that can throw shadows.

    ``samples`` are those per pixel and direction, of which shadows take about one; ``triangles`` throw shadows now,
    whose ``strength`` lies between 0 and 1.
    """
    right, up, towards = lens.axes
    # High in the world as well, so that shadows fall on the floor.
    direction = 0.9 * towards + 0.35 * up - 0.8 * right + np.array([0.0, 0.0, 0.45])
    camera = Camera(view=(float(direction[0]), float(direction[1]), float(direction[2])), projection="orthographic")
    edge = int(SHADOW_DETAIL * max(lens.size) / samples)
    fitted = camera.lens(points, (edge, edge))
    return Light(RayTree(triangles.corners, lens.target, lens.width), fitted.axes, 1 / fitted.scale, strength)


def shade(
    layer: VisibleSurface, lens: Lens, light: Light, *, gloss: float = 0.0, bias: float = 4.0
) -> NDArray[np.float64]:
    """Return the colours [n, 3] of a layer's pixels: diffuse, with shadows and a highlight of strength ``gloss``."""
    facing = layer.normals @ light.direction.astype(np.float32)
    lit = np.zeros(len(facing), dtype=np.float32)
    bright = np.flatnonzero(facing > 0)
    # Three details off the surface, which would otherwise shade itself.
    lifted = layer.points[bright] + 3 * light.pixel * layer.normals[bright]
    lit[bright] = light.reaches(lifted, bias)
    # Faces that look up receive a little more of the ambient light.
    sky = 0.9 + 0.1 * layer.normals[:, 2]
    colors = layer.colors * (AMBIENT * sky + KEY * np.maximum(facing, 0) * lit)[:, None]
    if gloss:
        # Highlight by the half-way vector of light and view (Blinn 1977).
        half = light.direction + lens.axes[2]
        shine = np.maximum(layer.normals @ (half / np.linalg.norm(half)).astype(np.float32), 0) ** 40
        colors = colors + gloss * (shine * lit)[:, None]
    return np.clip(colors, 0.0, 1.0)


def floor(lens: Lens, light: Light, height: float) -> NDArray[Any]:
    """Return the brightness [H, W] of a white floor at ``height`` (m) with the shadows on it.

    Only a perspective from above shows a floor: drawings to scale stay free of it.
    """
    from scipy.ndimage import uniform_filter

    width, rows = lens.size
    bright = np.ones((rows, width), dtype=np.float32)
    if lens.distance is None or not 0.05 < lens.axes[2, 2] < 0.9:
        return bright
    # Shadows on the floor are soft: every second pixel is enough.
    y, x = np.mgrid[0:rows:2, 0:width:2]
    eye = lens.target + lens.distance * lens.axes[2]
    rays = lens.unproject(x + 1.0, y + 1.0, np.full(x.shape, 1 / lens.distance)) - eye
    down = rays[..., 2] < -1e-9
    # Where the ray of each pixel meets the plane z = height.
    points = eye + ((height - eye[2]) / rays[down, 2])[:, None] * rays[down]
    shadow = np.zeros(x.shape, dtype=np.float32)
    shadow[down] = FLOOR_SHADE * (1 - light.reaches(points))
    shadow = uniform_filter(shadow, 7, mode="nearest")
    return bright - shadow.repeat(2, axis=0).repeat(2, axis=1)[:rows, :width]


def paint(layer: VisibleSurface, colors: NDArray[Any], background: NDArray[Any], opacity: float = 1.0) -> None:
    """Lay the colours [n, 3] of a layer over ``background`` [H, W, 3], in place."""
    flat = background.reshape(-1, 3)
    flat[layer.pixels] = opacity * colors + (1 - opacity) * flat[layer.pixels]


CREASE = math.radians(35)  # neighbouring triangles at a smaller angle [rad] are shaded as one smooth surface
SIDES = 7  # corners of a whisker's cross-section
ROUND = 64  # corners of a circle of an object


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """The surface of one object."""

    corners: NDArray[np.float64]
    """[F, 3, 3] m, in the frame that ``motion`` moves; in the world without."""
    normals: NDArray[np.float64]
    """[F, 3, 3] unit vectors."""
    motion: RigidMotion | None
    """Motion of the object from there; None when it stands still."""

    def at(self, time: float, color: ArrayLike) -> Triangles:
        """Return the triangles at ``time`` (s) in one colour (red, green, blue)."""
        colors = np.broadcast_to(np.asarray(color, dtype=float), (len(self.corners), 3))
        if self.motion is None:
            return Triangles(self.corners, self.normals, colors)
        positions, quaternions = self.motion(np.array([time]))
        turn = to_matrices(quaternions)[0]
        return Triangles(self.corners @ turn.T + positions[0], self.normals @ turn.T, colors)


def object_surface(placed: PlacedObject) -> DrawnSurface:
    """Return the surface of an object: its mesh, or what whiskers touch when it has none."""
    obstacle = placed.obstacle()
    if placed.solid.mesh is None and obstacle.surface is not None:
        meshes = [obstacle.surface]
    elif placed.solid.mesh is None:
        meshes = [part_mesh(part) for part in obstacle.parts]
    else:
        place = (0.0, 0.0, 0.0) if isinstance(placed.motion, (Spin, Path)) else placed.position
        meshes = [placed.solid.mesh.transformed(euler_matrix(placed.rotation), place)]
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    return DrawnSurface(corners, np.concatenate([corner_normals(mesh) for mesh in meshes]), obstacle.motion)


def part_mesh(part: Part) -> Mesh:
    """Return the surface of one convex part; round shapes have :data:`ROUND` corners a turn."""
    from trimesh import creation
    from trimesh.geometry import align_vectors

    match part:
        case Sphere():
            solid = creation.icosphere(subdivisions=4, radius=part.radius)
            solid.apply_translation(part.centre)
        case Box():
            place = np.eye(4)
            place[:3, :3], place[:3, 3] = to_matrices(part.quaternion), part.centre
            solid = creation.box(2 * np.array(part.half_sizes), transform=place)
        case Cylinder():
            solid = creation.cylinder(part.radius, sections=ROUND, segment=[part.start, part.end])
        case Capsule():
            along = np.subtract(part.end, part.start)
            # At radius 1 and scaled afterwards: trimesh merges points by an absolute tolerance.
            solid = creation.capsule(float(np.linalg.norm(along)) / part.radius, 1.0, count=[ROUND // 2, ROUND])
            solid.apply_translation(-solid.bounds.mean(axis=0))
            solid.apply_scale(part.radius)
            solid.apply_transform(align_vectors([0.0, 0.0, 1.0], along))
            solid.apply_translation(np.add(part.start, part.end) / 2)
        case ConvexPart():
            return convex_hull(part.vertices)
    return Mesh(solid.vertices, solid.faces)


def corner_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Return unit normals [F, 3, 3] at the corners: area-weighted means over each smooth patch of the mesh."""
    from trimesh import Trimesh
    from trimesh.graph import connected_component_labels

    solid = Trimesh(mesh.vertices, mesh.faces, process=False)
    smooth = solid.face_adjacency[solid.face_adjacency_angles < CREASE]
    patch = connected_component_labels(smooth, node_count=len(mesh.faces))
    # A vertex has one normal in each patch that meets there.
    _, place = np.unique(patch[:, None] * len(mesh.vertices) + mesh.faces, return_inverse=True)
    place = place.reshape(-1)
    corners = mesh.vertices[mesh.faces]
    area = np.repeat(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), 3, axis=0)
    total = np.stack([np.bincount(place, area[:, axis]) for axis in range(3)], axis=-1)
    unit = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return unit[place].reshape(-1, 3, 3)


def tube(line: NDArray[np.float64], radii: NDArray[np.float64], colors: NDArray[np.float64]) -> Triangles:
    """Return a closed tube around points [n, 3] (m, world), with radii [n] (m) and colours [n, 3] from 0 to 1."""
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    across = transported_normals(along)
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    spokes = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * np.cross(along, across)[:, None]
    rings = line[:, None] + radii[:, None, None] * spokes
    # A hemisphere would be invisible at these sizes: the ends are closed by a point.
    caps = np.stack([line[0] - radii[0] * along[0], line[-1] + radii[-1] * along[-1]])
    rings = np.concatenate([np.broadcast_to(caps[0], (1, SIDES, 3)), rings, np.broadcast_to(caps[1], (1, SIDES, 3))])
    normals = np.concatenate([spokes[:1], spokes, spokes[-1:]])
    shades = np.tile(np.repeat(np.concatenate([colors, colors[-1:]]), SIDES, axis=0), (2, 1))
    return Triangles(_strips(rings), _strips(normals), shades)


def ball(centre: ArrayLike, radius: float, color: ArrayLike) -> Triangles:
    """Return a small ball (m, world)."""
    from trimesh import creation

    unit = creation.icosphere(subdivisions=2)
    normals = np.asarray(unit.vertices)[np.asarray(unit.faces)]
    return Triangles(radius * normals + np.asarray(centre), normals, np.broadcast_to(color, (len(normals), 3)))


def smoothed(values: NDArray[np.float64], per_link: int) -> NDArray[np.float64]:
    """Return values [n, k] along a smooth curve from those at the joints [N + 1, k] of a chain.

    A quadratic B-spline: it begins and ends with the chain, and touches each inner link at its middle, where
    a link lies on a round object. A curve through the joints would bulge into the object there.
    """
    from scipy.interpolate import BSpline

    degree = min(2, len(values) - 1)
    last = len(values) - degree
    knots = np.concatenate([np.zeros(degree), np.arange(last + 1), np.full(degree, last)])
    return BSpline(knots, values, degree)(np.linspace(0, last, (len(values) - 1) * per_link + 1))


def _strips(rings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corner values [F, 3, 3] of the triangles between successive rings [n, k, 3]."""
    following = np.roll(rings, -1, axis=1)
    a, b, c, d = rings[:-1], following[:-1], following[1:], rings[1:]
    return np.concatenate([np.stack(item, axis=2).reshape(-1, 3, 3) for item in ((a, b, c), (a, c, d))])
