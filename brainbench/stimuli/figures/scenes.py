"""Pictures and films of scenes: whiskers as tapered tubes among shaded objects, without a display or OpenGL."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, check_name, listing
from brainbench.core.figures.style import check_format
from brainbench.core.progress import Progress, track
from brainbench.core.reading.ranges import check_fields
from brainbench.stimuli.engines import DEFAULT_ENGINE
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.figures.annotation import Annotation
from brainbench.stimuli.figures.camera import Camera, Lens
from brainbench.stimuli.figures.canvas import MOMENT_MAP, ROW_COLORS, UNSTABLE_COLOR, round_up
from brainbench.stimuli.figures.films import require_writer, write_film
from brainbench.stimuli.figures.raster import RasterLayer, Triangles, draw
from brainbench.stimuli.figures.shading import floor, lamp, paint, shade
from brainbench.stimuli.figures.surfaces import DrawnSurface, ball, object_surface, smoothed, tube
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.scenes.scene import Scene
from brainbench.stimuli.whisker_shapes import Recording, record

_LOG = logging.getLogger(__name__)

COLORINGS = ("row", "moment")
FORMATS = (".png", ".gif", ".mp4")
FILM_SIZE = (800, 600)
OBJECT_COLOR = (0.76, 0.80, 0.85)
_PER_LINK = 6
_THINNEST = 0.55
_SINKS = 0.004


@dataclass(frozen=True)
class Style:
    """Colours, size and quality of a picture of a scene; what is out of range is a :class:`UsageError`."""

    color: Literal["row", "moment"] = "row"
    """Whiskers by row, or by their local elastic bending moment."""
    moment_limit: float | None = None
    """Moment at the upper end of the colours [N·m]; None takes the largest that is shown."""
    thickness: float = 2.0
    """Whiskers are drawn so many times as thick as they are, and never thinner than a pixel."""
    opacity: float = 1.0
    """Opacity of the objects, from 0 to 1; whiskers behind them shine through."""
    size: tuple[int, int] = (1280, 960)
    """Width and height in pixels."""
    supersampling: int = 2
    """Samples per pixel and direction; smooths edges at its square of the cost."""
    frames_per_second: float = 25.0
    """Frames per second of a film."""

    def __post_init__(self) -> None:
        check_name("colouring", self.color, COLORINGS)
        check_fields(self, "moment_limit", "thickness", above=0)
        check_fields(self, "opacity", least=0, most=1)
        if len(self.size) != 2 or not all(64 <= value <= 8192 for value in self.size):
            raise UsageError(f"The size of a picture is 64 to 8192 pixels each way; received {self.size!r}.")
        if self.supersampling not in (1, 2, 3, 4):
            raise UsageError(f"supersampling is 1, 2, 3 or 4; received {self.supersampling!r}.")
        check_fields(self, "frames_per_second", above=0, most=120)


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


def render(
    scene: Scene,
    out: str | os.PathLike[str],
    *,
    times: ArrayLike | None = None,
    camera: Camera | None = None,
    style: Style | None = None,
    fidelity: Fidelity | str | None = None,
    backend: WhiskerEngine | str = DEFAULT_ENGINE,
    progress: Progress | None = None,
    cache: bool = True,
) -> Path:
    """Draw a scene into a picture (``.png``) or a film (``.gif``, ``.mp4``).

    Args:
        scene, out: what to draw, and the file to write; it is replaced only by a finished one.
        times: instants to draw [s], one for a picture; :func:`still_time` or :func:`film_times` when None.
        camera, style: an oblique perspective that frames whiskers and objects when None; films are smaller than
            pictures.
        fidelity, backend, progress, cache: as for :func:`brainbench.stimuli.whisker_shapes.record`.
    """
    path = Path(out)
    suffix = check_format(path, FORMATS)
    style = style or (Style() if suffix == ".png" else Style(size=FILM_SIZE))
    if times is None:
        times = [still_time(scene)] if suffix == ".png" else film_times(scene)
    times = np.atleast_1d(np.asarray(times, dtype=float))
    if suffix == ".png" and len(times) != 1:
        raise UsageError(f"A .png shows one instant; received {len(times)}: write a film ({listing(FORMATS[1:])}).")
    require_writer(suffix)
    asked, last = times.max(initial=0.0) * MILLI, float(scene.frames.times[-1]) * MILLI
    if asked > last + 1e-6:
        raise UsageError(
            f"The scene {scene.label!r} ends at {last:g} ms; received the instant {asked:g} ms: choose an earlier one, "
            "or give the scene more frames."
        )
    recording = record(scene, times, fidelity=fidelity, backend=backend, progress=progress, cache=cache)
    if recording.unstable:
        _LOG.warning("unstable whiskers are drawn black and unbent from then on: %s", listing(recording.unstable))
    picture = Picture(recording, camera, style)
    annotation = Annotation(picture)
    if suffix == ".png":
        return annotation.save(path)
    frames = (annotation.frame(index) for index in track(range(len(times)), "drawing frames", progress))
    sample = [annotation.frame(index) for index in {0, len(times) // 2, len(times) - 1}] if suffix == ".gif" else []
    return write_film(path, frames, style, palette_from=sample)


def still_time(scene: Scene) -> float:
    """Return the instant [s] that tells most: the first full protraction, or half the last frame's time."""
    last = float(scene.frames.times[-1])
    if isinstance(scene.whisking, Whisking):
        period = 1 / scene.whisking.frequency
        peak = period * (math.ceil(max(scene.whisking.onset / period - 0.5, 0) - 1e-9) + 0.5)
        if peak <= last:
            return peak
    return last / 2


def film_times(scene: Scene, start: float = 0.0, stop: float | None = None, step: float = 0.002) -> Sequence[float]:
    """Return instants [n] (s) from ``start`` to ``stop`` (None: 150 ms later, or the scene's end) every ``step``."""
    stop = min(float(scene.frames.times[-1]), start + 0.15) if stop is None else stop
    if not (math.isfinite(step) and step > 0 and math.isfinite(stop) and 0 <= start < stop):
        raise UsageError(
            f"A film runs from 0 s or later to a later time in positive steps; received {start:g} s to {stop:g} s "
            f"in steps of {step:g} s."
        )
    count = int((stop - start) / step + 1e-6) + 1
    if count > 10_000:
        raise UsageError(f"A film of {count:,} frames is refused (at most 10,000); choose longer steps.")
    return [start + step * index for index in range(count)]
