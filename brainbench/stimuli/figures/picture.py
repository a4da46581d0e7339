"""One instant of a recorded scene after the other as a picture, all with the same camera and the same colours."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.figures.camera import Camera, Lens
from brainbench.stimuli.figures.canvas import MOMENT_MAP, ROW_COLORS, UNSTABLE_COLOR, Style, round_up
from brainbench.stimuli.figures.raster import RasterLayer, Triangles, draw
from brainbench.stimuli.figures.shading import floor, lamp, paint, shade
from brainbench.stimuli.figures.surfaces import DrawnSurface, ball, object_surface, smoothed, tube
from brainbench.stimuli.whisker_shapes import Recording

OBJECT_COLOR = (0.76, 0.80, 0.85)
_PER_LINK = 6
_THINNEST = 0.55
_SINKS = 0.004


class Picture:
    """Draws the instants of a recording, all with the same camera and the same colours."""

    def __init__(self, recording: Recording, camera: Camera | None = None, style: Style | None = None) -> None:
        self.recording = recording
        self.camera = camera or Camera()
        self.style = style or Style()
        self._surfaces: list[DrawnSurface] = [object_surface(item) for item in recording.scene.objects]
        self._still = all(surface.motion is None for surface in self._surfaces)
        self._cached: tuple[Triangles, RasterLayer] | None = None

    @cached_property
    def lens(self) -> Lens:
        """The camera at its place, framing whiskers and the parts of objects near them."""
        return self.camera.lens(self._framed, self.style.size)

    @cached_property
    def moment_limit(self) -> float:
        """Moment at the upper end of the colours [N·m]."""
        if self.style.moment_limit is not None:
            return self.style.moment_limit
        largest = max((float(np.nanmax(item, initial=0.0)) for item in self.recording.moments), default=0.0)
        return round_up(largest) if largest else 1e-9

    def frame(self, index: int) -> NDArray[np.uint8]:
        """Return the picture [H, W, 3] at one instant of the recording, without text."""
        style, lens = self.style, self.lens.supersampled(self.style.supersampling)
        objects, solid = self._objects(index, lens)
        whiskers = self._whiskers(index, lens)
        throwing = Triangles.joined([objects, whiskers])
        light = lamp(lens, style.supersampling, self._shown, throwing, style.opacity)
        low = self._shown[:, 2].min() - 0.03 * self.lens.width
        ground = floor(self.lens, light, float(low)).repeat(style.supersampling, 0).repeat(style.supersampling, 1)
        image = np.repeat(ground[..., None], 3, axis=2)
        thin = draw(whiskers, lens)
        near, front = (layer.nearness.reshape(-1)[thin.pixels] for layer in (thin, solid))
        # A contact lets a tip sink in by micrometres; drawn exactly, it would vanish in the face it lies on.
        behind = near + lens.nearness_of(_SINKS * self.lens.width, near) <= front
        colors = shade(thin, lens, light, gloss=0.25, bias=16.0)
        image.reshape(-1, 3)[thin.pixels[behind]] = colors[behind]
        paint(solid, shade(solid, lens, light, gloss=0.06), image, style.opacity)
        image.reshape(-1, 3)[thin.pixels[~behind]] = colors[~behind]
        factor = style.supersampling
        total = sum(image[row::factor, column::factor] for row in range(factor) for column in range(factor))
        return np.round(255 / factor**2 * np.asarray(total)).astype(np.uint8)

    def _objects(self, index: int, lens: Lens) -> tuple[Triangles, RasterLayer]:
        """Return the triangles of the objects and what the camera sees of them; found once when nothing moves."""
        if self._cached is not None and self._still:
            return self._cached
        time = float(self.recording.times[index])
        triangles = Triangles.joined([surface.at(time, OBJECT_COLOR) for surface in self._surfaces])
        self._cached = triangles, draw(triangles, lens)
        return self._cached

    def _whiskers(self, index: int, lens: Lens) -> Triangles:
        from matplotlib import colormaps
        from matplotlib.colors import to_rgb

        found = []
        recording = self.recording
        whiskers = zip(recording.scene.mounts, recording.joints, recording.moments, strict=True)
        for which, (mount, joints, moments) in enumerate(whiskers):
            points, row, known = joints[index], np.array(to_rgb(ROW_COLORS[mount.row])), True
            if not np.isfinite(points).all():
                points, row, known = recording.unbent(which, index), np.array(to_rgb(UNSTABLE_COLOR)), False
            along = np.column_stack([points, np.linspace(0.0, 1.0, len(points)), np.nan_to_num(moments[index])])
            *line, share, bending = smoothed(along, _PER_LINK).T
            line = np.stack(line, axis=-1)
            radii = self.style.thickness * mount.whisker.radius(share * mount.whisker.arc_length)
            thinnest = _THINNEST * self.style.supersampling * lens.pixel_size(line)
            colors = np.broadcast_to(row, line.shape)
            if self.style.color == "moment" and known:
                colors = colormaps[MOMENT_MAP](np.clip(bending / self.moment_limit, 0, 1))[:, :3]
            found.append(tube(line, np.maximum(radii, thinnest), colors))
            ink = 0.45 * row if self.style.color == "row" else np.full(3, 0.25)
            found.append(ball(points[0], 1.6 * max(radii[0], float(thinnest[0])), ink))
        return Triangles.joined(found)

    @cached_property
    def _framed(self) -> NDArray[np.float64]:
        """Points [n, 3] that the picture must show: all whiskers, and objects as far as they are near these."""
        whiskers = self._whisker_points
        if not len(whiskers):
            return self._object_points
        low, high = whiskers.min(axis=0), whiskers.max(axis=0)
        room = 0.3 * float(np.linalg.norm(high - low))
        points = self._object_points
        near = np.clip(points, low - room, high + room)
        return np.concatenate([whiskers, near])

    @cached_property
    def _shown(self) -> NDArray[np.float64]:
        return np.concatenate([self._whisker_points, self._object_points, np.zeros((0, 3))])

    @cached_property
    def _whisker_points(self) -> NDArray[np.float64]:
        points = np.concatenate([joints.reshape(-1, 3) for joints in self.recording.joints])
        return points[np.isfinite(points).all(axis=1)]

    @cached_property
    def _object_points(self) -> NDArray[np.float64]:
        """Corners of the objects [n, 3] at the first, middle and last instant."""
        times = self.recording.times
        moments = {0, len(times) // 2, len(times) - 1}
        found = [
            surface.at(float(times[index]), OBJECT_COLOR).corners.reshape(-1, 3)
            for surface in self._surfaces
            for index in ({0} if surface.motion is None else moments)
        ]
        return np.concatenate([np.zeros((0, 3)), *found])
