"""Pictures and films of scenes: whiskers as tapered tubes among shaded objects, without a display or OpenGL.

One instant of a recorded scene after the other as a picture, all with the same camera and the same colours.
Force and moment traces stand on the 5 × 7 layout of the whiskers, one small panel each, all to one scale.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import re
from collections.abc import Iterable, Sequence
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import CHANNELS, check_stimulus_set
from brainbench.core.errors import DataError, UsageError, check_name, check_number, choose_name, listing, needing
from brainbench.core.figures import DOTS_PER_INCH, INK, PALE, check_format, new_figure, save_figure
from brainbench.core.files import atomic_path
from brainbench.core.limits import Limit, Positive, Share, limited
from brainbench.core.progress import Progress, track
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.figures.surfaces import (
    Camera,
    DrawnSurface,
    Lens,
    Triangles,
    VisibleSurface,
    ball,
    draw,
    floor,
    lamp,
    object_surface,
    paint,
    shade,
    smoothed,
    tube,
)
from brainbench.stimuli.motion.jobs import MILLI
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.scenes.scene import Scene
from brainbench.stimuli.simulation import Recording, record
from brainbench.stimuli.whiskers.array import ROWS

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROW_COLORS = ("#3466ac", "#1b9aa0", "#d1495b", "#7b4fa3", "#e08e1b")
"""Colours of the whisker rows A to E."""
UNSTABLE_COLOR = "#111111"
"""Colour of whiskers whose simulation cannot be trusted."""
MOMENT_MAP = "plasma"  # colour map of bending moments, by its name in matplotlib

_Pixels = Annotated[int, Limit(least=64, most=8192)]


@limited(of="{} of a picture")
class Style:
    """Colours, size and quality of a picture of a scene; what is out of range is a :class:`UsageError`."""

    color: Literal["row", "moment"] = "row"
    """Whiskers by row, or by their local elastic bending moment."""
    moment_limit: Positive | None = None
    """Moment at the upper end of the colours [N·m]; None takes the largest that is shown."""
    thickness: Positive = 2.0
    """Whiskers are drawn so many times as thick as they are, and never thinner than a pixel."""
    opacity: Share = 1.0
    """Opacity of the objects, from 0 to 1; whiskers behind them shine through."""
    size: tuple[_Pixels, _Pixels] = (1280, 960)
    """Width and height in pixels."""
    supersampling: Annotated[int, Limit(least=1, most=4)] = 2
    """Samples per pixel and direction; smooths edges at its square of the cost."""
    frames_per_second: Annotated[float, Limit(above=0, most=120)] = 25.0
    """Frames per second of a film."""


def round_up(value: float) -> float:
    """Return the least of a few round numbers that is not below ``value``, for the end of a scale.

    >>> round_up(0.308)
    0.4
    """
    power = 10.0 ** math.floor(math.log10(value))
    steps = (1, 1.2, 1.6, 2, 2.4, 3, 4, 5, 6, 8, 10)
    return float(f"{next(step for step in steps if step * power >= value * (1 - 1e-9)) * power:.3g}")


def round_length(length: float) -> float:
    """Return the longest of 1, 2, 5 times a power of ten that is not above ``length``.

    >>> round_length(0.0073)
    0.005
    """
    power = 10.0 ** math.floor(math.log10(length) + 1e-9)
    return max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9))


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
        self._cached: tuple[Triangles, VisibleSurface] | None = None

    @cached_property
    def lens(self) -> Lens:
        """The camera at its place, framing whiskers and the parts of objects near them."""
        whiskers, points = self._shown
        if len(whiskers):
            low, high = whiskers.min(axis=0), whiskers.max(axis=0)
            room = 0.3 * float(np.linalg.norm(high - low))
            points = np.concatenate([whiskers, np.clip(points, low - room, high + room)])
        return self.camera.lens(points, self.style.size)

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
        scene = np.concatenate(self._shown)
        light = lamp(lens, style.supersampling, scene, throwing, style.opacity)
        low = scene[:, 2].min() - 0.03 * self.lens.width
        ground = floor(self.lens, light, float(low)).repeat(style.supersampling, 0).repeat(style.supersampling, 1)
        image = np.repeat(ground[..., None], 3, axis=2)
        thin = draw(whiskers, lens)
        near, front = (layer.nearness.reshape(-1)[thin.pixels] for layer in (thin, solid))
        # A contact lets a tip sink in by micrometres; drawn exactly, it would vanish in the face it lies on.
        sinks = _SINKS * self.lens.width
        # d(1/r) = −dr/r², and nearness is 1/r in perspective.
        behind = near + (sinks if lens.distance is None else sinks * near**2) <= front
        colors = shade(thin, lens, light, gloss=0.25, bias=16.0)
        image.reshape(-1, 3)[thin.pixels[behind]] = colors[behind]
        paint(solid, shade(solid, lens, light, gloss=0.06), image, style.opacity)
        image.reshape(-1, 3)[thin.pixels[~behind]] = colors[~behind]
        factor = style.supersampling
        total = sum(image[row::factor, column::factor] for row in range(factor) for column in range(factor))
        return np.round(255 / factor**2 * np.asarray(total)).astype(np.uint8)

    def _objects(self, index: int, lens: Lens) -> tuple[Triangles, VisibleSurface]:
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

        parts = []
        recording = self.recording
        whiskers = zip(recording.scene.mounts, recording.joints, recording.moments, strict=True)
        for which, (mount, joints, moments) in enumerate(whiskers):
            points, row, finite = joints[index], np.array(to_rgb(ROW_COLORS[mount.row])), True
            if not np.isfinite(points).all():
                points, row, finite = recording.unbent(which, index), np.array(to_rgb(UNSTABLE_COLOR)), False
            along = np.column_stack([points, np.linspace(0.0, 1.0, len(points)), np.nan_to_num(moments[index])])
            *line, share, bending = smoothed(along, _PER_LINK).T
            line = np.stack(line, axis=-1)
            radii = self.style.thickness * mount.whisker.radius(share * mount.whisker.arc_length)
            thinnest = _THINNEST * self.style.supersampling * lens.pixel_size(line)
            colors = np.broadcast_to(row, line.shape)
            if self.style.color == "moment" and finite and np.isfinite(moments[index]).all():
                colors = colormaps[MOMENT_MAP](np.clip(bending / self.moment_limit, 0, 1))[:, :3]
            parts.append(tube(line, np.maximum(radii, thinnest), colors))
            ink = 0.45 * row if self.style.color == "row" else np.full(3, 0.25)
            parts.append(ball(points[0], 1.6 * max(radii[0], float(thinnest[0])), ink))
        return Triangles.joined(parts)

    @cached_property
    def _shown(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points of the whiskers [n, 3], and corners of the objects at the first, middle and last instant."""
        points = np.concatenate([joints.reshape(-1, 3) for joints in self.recording.joints])
        times = self.recording.times
        moments = {0, len(times) // 2, len(times) - 1}
        corners = [
            surface.at(float(times[index]), OBJECT_COLOR).corners.reshape(-1, 3)
            for surface in self._surfaces
            for index in ({0} if surface.motion is None else moments)
        ]
        return points[np.isfinite(points).all(axis=1)], np.concatenate([np.zeros((0, 3)), *corners])


AXES = ("right", "rostral", "dorsal")


class Annotation:
    """A matplotlib figure that shows one instant of a picture after the other, with text."""

    def __init__(self, picture: Picture) -> None:
        self.picture = picture
        self.width, self.height = picture.style.size
        self.figure = new_figure(self.width, self.height)
        self.axes = self.figure.add_axes((0, 0, 1, 1))
        self.axes.set(xlim=(0, self.width), ylim=(self.height, 0))
        self.axes.axis("off")
        blank = np.full((self.height, self.width, 3), 255, dtype=np.uint8)
        self._image = self.axes.imshow(blank, extent=(0, self.width, self.height, 0), interpolation="nearest")
        self._unit = self.width / 1280
        self._edge = 36 * self._unit
        scene = picture.recording.scene
        self._text(self._edge, self._edge, scene.label, size=26, weight="bold", va="top")
        count, thick = len(scene.mounts), picture.style.thickness
        animals = f"{len(scene.split())} animals" if scene.others else scene.array.species
        caption = f"{animals}, {count} whisker{'s' if count > 1 else ''}"
        caption += "" if thick == 1 else f" drawn {thick:g}× as thick"
        self._text(self._edge, self._edge + 38 * self._unit, caption, size=15, color=PALE, va="top")
        self._time = self._text(self.width - self._edge, self._edge, "", size=22, ha="right", va="top")
        self._scale_bar()
        self._triad()
        if picture.style.color == "moment":
            self._moment_bar()
        else:
            self._row_key()

    def frame(self, index: int) -> NDArray[np.uint8]:
        """Return the annotated picture [H, W, 3] at one instant."""
        self._show(index)
        drawn: Any = self.figure.canvas
        drawn.draw()
        return np.asarray(drawn.buffer_rgba())[..., :3].copy()

    def save(self, path: Path, index: int = 0) -> Path:
        """Write the annotated picture at one instant."""
        self._show(index)
        return save_figure(self.figure, path, dpi=DOTS_PER_INCH)

    def _show(self, index: int) -> None:
        self._image.set_data(self.picture.frame(index))
        times = self.picture.recording.times
        text = f"{times[index] * 1e3:.1f} ms"
        if len(times) > 1:
            slower = 1 / (self.picture.style.frames_per_second * (times[1] - times[0]))
            text += f"   slowed {slower:.3g}×" if slower > 1 else ""
        self._time.set_text(text)

    def _text(self, x: float, y: float, text: str, *, size: float, color: str = INK, **options: Any) -> Any:
        from matplotlib.patheffects import withStroke

        points = size * self._unit * 72 / DOTS_PER_INCH
        halo = [withStroke(linewidth=0.25 * points, foreground="white", alpha=0.8)]
        return self.axes.text(x, y, text, fontsize=points, color=color, path_effects=halo, **options)

    def _line(self, xs: Any, ys: Any, color: str = INK, width: float = 3.0) -> None:
        points = width * self._unit * 72 / DOTS_PER_INCH
        self.axes.plot(xs, ys, color=color, linewidth=points, solid_capstyle="butt")

    def _scale_bar(self) -> None:
        lens = self.picture.lens
        length = round_length(0.2 * lens.width)
        left, low = self._edge, self.height - self._edge
        self._line([left, left + length * lens.scale], [low, low], width=5)
        label = f"{length * 1e3:g} mm" + ("" if lens.distance is None else " at the centre")
        self._text(left, low - 10 * self._unit, label, size=17, va="bottom")

    def _triad(self) -> None:
        """Draw arrows along the world's axes, as the camera sees them from afar."""
        reach = 58 * self._unit
        flat = (self.picture.lens.axes[:2] * [[1.0], [-1.0]]).T
        # The origin lies so far from the corner that every arrow and its name stay in the picture.
        right, low = self.width - self._edge - 100 * self._unit, self.height - self._edge - 66 * self._unit
        arrow = {"arrowstyle": "-|>", "color": PALE, "lw": 1.6 * self._unit, "shrinkA": 0, "shrinkB": 0}
        for (x, y), name in zip(flat, AXES, strict=True):
            if np.hypot(x, y) < 0.25:
                continue
            self.axes.annotate("", (right + reach * x, low + reach * y), (right, low), arrowprops=arrow)
            side = "center" if abs(x) < 0.3 else "left" if x > 0 else "right"
            height = "center" if abs(x) >= 0.3 else "bottom" if y < 0 else "top"
            place = right + 1.12 * reach * x, low + 1.12 * reach * y
            self._text(*place, name, size=14, color=PALE, ha=side, va=height)

    def _row_key(self) -> None:
        rows = sorted({mount.row for mount in self.picture.recording.scene.mounts})
        top = self._edge + 84 * self._unit
        key = [(f"row {ROWS[row]}", ROW_COLORS[row]) for row in rows]
        if self.picture.recording.unstable:
            key.append(("unstable, drawn unbent", UNSTABLE_COLOR))
        for place, (words, color) in enumerate(key):
            y = top + 26 * self._unit * place
            self._line([self._edge, self._edge + 30 * self._unit], [y, y], color, 4)
            self._text(self._edge + 40 * self._unit, y, words, size=15, va="center_baseline")

    def _moment_bar(self) -> None:
        left, top, long, wide = self._edge, self._edge + 84 * self._unit, 220 * self._unit, 16 * self._unit
        ramp = np.linspace(0, 1, 256)[None]
        self.axes.imshow(ramp, cmap=MOMENT_MAP, extent=(left, left + long, top + wide, top), aspect="auto")
        limit = self.picture.moment_limit * 1e6
        for share in (0.0, 0.5, 1.0):
            side = ("left", "center", "right")[round(2 * share)]
            self._text(left + share * long, top + 22 * self._unit, f"{share * limit:.3g}", size=14, ha=side, va="top")
        self._text(left, top + 46 * self._unit, "bending moment (µN·m)", size=14, color=PALE, va="top")
        self.axes.set(xlim=(0, self.width), ylim=(self.height, 0))


_UNCHANGED = 255  # index of a GIF's palette that means "as in the frame before"; the colours are those below it


def write_film(
    path: Path, frames: Iterable[NDArray[np.uint8]], style: Style, *, palette_from: Sequence[NDArray[np.uint8]] = ()
) -> Path:
    """Write frames [H, W, 3] to a ``.gif`` that repeats for ever, or to an ``.mp4`` (H.264); the suffix chooses.

    Args:
        path, frames: file to write, and pictures of one size.
        style: size and frames per second.
        palette_from: frames whose colours the 255 colours of a GIF are chosen from.
    """
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with atomic_path(path) as temporary:
        write(temporary, frames, style, palette_from)
    return path


def require_writer(suffix: str) -> None:
    """Raise a :class:`MissingDependencyError` unless pictures of this format (``.png``, …) can be made here."""
    needed = [("matplotlib", "matplotlib", "Drawing pictures")]
    if suffix == ".mp4":
        needed.append(("imageio_ffmpeg", "imageio-ffmpeg", "Writing an MP4"))
    for module, package, purpose in needed:
        with needing(package, extra="report", purpose=purpose):
            import_module(module)


def _write_gif(path: Path, frames: Iterable[NDArray[np.uint8]], style: Style, palette_from: Sequence[Any]) -> None:
    from PIL import GifImagePlugin, Image

    # Half by area, half every distinct colour once: by area alone the palette would have no room for the colours of
    # thin whiskers, without it objects change hue.
    pixels = np.concatenate([frame.reshape(-1, 3) for frame in palette_from])
    distinct = np.unique(pixels, axis=0)
    sample = np.concatenate([distinct, pixels[:: max(1, len(pixels) // len(distinct))]])[None]
    palette = Image.fromarray(sample).quantize(_UNCHANGED, kmeans=1, dither=Image.Dither.NONE)
    # A GIF counts hundredths of a second, and viewers slow down anything shorter than two.
    duration = 10 * max(2, round(100 / style.frames_per_second))
    before = None
    with path.open("wb") as file:
        for frame in frames:
            image = Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
            now = np.asarray(image)
            if before is None:
                # Pillow's own writer keeps all frames in memory; its parts do not.
                file.writelines(GifImagePlugin.getheader(image, info={"optimize": False, "loop": 0})[0])
            else:
                image = Image.fromarray(np.where(now == before, np.uint8(_UNCHANGED), now))
            file.writelines(GifImagePlugin.getdata(image, duration=duration, transparency=_UNCHANGED, disposal=1))
            before = now
        file.write(b";")


def _write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], style: Style, palette_from: Sequence[Any]) -> None:
    import imageio_ffmpeg

    # H.264 stores colour for blocks of two by two pixels.
    width, height = (size - size % 2 for size in style.size)
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=style.frames_per_second,  # pyright: ignore[reportArgumentType]  # ffmpeg takes fractions too
        quality=8,
        macro_block_size=2,
        codec="libx264",
    )
    try:
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame[:height, :width]).tobytes())
    except OSError as error:
        raise DataError(f"The video encoder failed ({error}).") from error
    finally:
        writer.close()


_LOG = logging.getLogger(__name__)

FORMATS = (".png", ".gif", ".mp4")
FILM_SIZE = (800, 600)


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
        fidelity, backend, progress, cache: as for :func:`brainbench.stimuli.simulation.record`.
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
    latest, last = times.max(initial=0.0) * MILLI, float(scene.frames.times[-1]) * MILLI
    if latest > last + 1e-6:
        raise UsageError(
            f"The scene {scene.label!r} ends at {last:g} ms; received the instant {latest:g} ms: choose an earlier "
            "one, or give the scene more frames."
        )
    recording = record(scene, times, fidelity=fidelity, backend=backend, progress=progress, cache=cache)
    if recording.unstable:
        _LOG.warning("unstable whiskers are drawn black and unbent from then on: %s", listing(recording.unstable))
    annotation = Annotation(Picture(recording, camera, style))
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
    check_number("The number of frames of a film, which longer steps make fewer,", count, most=10_000)
    return [start + step * index for index in range(count)]


PLOT_FORMATS = (".png", ".svg", ".pdf")
QUANTITIES = {
    **{channel: (channel,) for channel in CHANNELS},
    "Fxyz": CHANNELS[:3],
    "Mxyz": CHANNELS[3:],
    "F": CHANNELS[:3],
    "M": CHANNELS[3:],
}
"""Quantities that can be plotted: one channel, the three components together, or (``F``, ``M``) their magnitude."""
LINE_COLORS = ("#d1495b", "#35b07f", "#1f3a93")
"""Colours of x, y and z, of different lightness too."""
CONTACT_COLOR = "#f3d9a4"
_UNITS = {"F": ("mN", 1e3), "M": ("µN·m", 1e6)}


def plot(
    dataset: xr.Dataset,
    out: str | os.PathLike[str],
    *,
    channel: str = "Fxyz",
    stimulus: str | None = None,
    window: tuple[float, float] | None = None,
    size: tuple[int, int] = (1600, 960),
) -> tuple[Path, ...]:
    """Draw the traces of every whisker and return the files written.

    All panels of all pictures share one scale, so that stimuli can be compared; where a whisker touches,
    the panel is shaded. Whiskers that became unstable say so.

    Args:
        dataset: a stimulus set with whiskers of one side.
        out: file to write (``.png``, ``.svg``, ``.pdf``). A set of several stimuli makes one file each,
            with the stimulus's label after a hyphen.
        channel: one of :data:`QUANTITIES`.
        stimulus: draw only this one.
        window, size: first and last time to show [s]; width and height in pixels.
    """
    check_stimulus_set(dataset)
    path = Path(out)
    check_format(path, PLOT_FORMATS)
    check_name("channel", channel, QUANTITIES)
    cells = list(zip(dataset["row"].values.tolist(), dataset["col"].values.tolist(), strict=True))
    if len(set(cells)) < len(cells):
        raise UsageError("The stimulus set has two whiskers in one cell; select one side (or one animal) first.")
    labels = [str(label) for label in dataset["stimulus"].values]
    chosen = labels if stimulus is None else [choose_name("stimulus", stimulus, labels)]
    dataset = _within(dataset, window)
    values = _values(dataset, channel)
    largest = float(np.nanmax(np.abs(values), initial=0.0)) or 1.0
    # Each side ends where its values end, but never so close to 0 that its number would overlap that of 0.
    low, high = (max(float(np.nanmax(side * values, initial=0.0)), 0.2 * largest) for side in (-1, 1))
    limits = (0.0 if channel in _UNITS else -round_up(low), round_up(high))
    several = len(chosen) > 1
    names = [re.sub(r"[^\w.+-]+", "_", label) for label in chosen]
    paths = [path.with_name(f"{path.stem}-{name}{path.suffix}") if several else path for name in names]
    for label, file in zip(chosen, paths, strict=True):
        save_figure(_figure(dataset.isel(stimulus=labels.index(label)), label, channel, limits, size), file)
    return tuple(paths)


def _within(dataset: xr.Dataset, window: tuple[float, float] | None) -> xr.Dataset:
    if window is None:
        return dataset
    times = dataset["time"].values
    inside = (times >= window[0]) & (times <= window[1])
    if inside.sum() < 2:
        raise UsageError(
            f"The window {window[0]:g}–{window[1]:g} s holds fewer than two frames; "
            f"the stimuli last from {times[0]:g} to {times[-1]:g} s."
        )
    return dataset.isel(time=np.flatnonzero(inside))


def _values(dataset: xr.Dataset, channel: str) -> NDArray[np.float64]:
    """Return what is drawn [..., whisker, line] in the unit of the scale."""
    picked = [CHANNELS.index(name) for name in QUANTITIES[channel]]
    values = dataset["wrench"].values[..., picked].astype(float) * _UNITS[channel[0]][1]
    return np.linalg.norm(values, axis=-1, keepdims=True) if channel in _UNITS else values


def _figure(
    stimulus: xr.Dataset, label: str, channel: str, limits: tuple[float, float], size: tuple[int, int]
) -> Figure:
    figure = new_figure(*size)
    cells = list(zip(stimulus["row"].values.tolist(), stimulus["col"].values.tolist(), strict=True))
    rows, cols = (range(min(side), max(side) + 1) for side in zip(*cells, strict=True))
    points = 0.72 * size[0] / 1600
    room = {"left": 0.055, "right": 0.99, "top": 0.885, "bottom": 0.075, "wspace": 0.08, "hspace": 0.16}
    panels: Any = figure.subplots(len(rows), len(cols), sharex=True, sharey=True, squeeze=False, gridspec_kw=room)
    values = _values(stimulus, channel)
    for (row, col), panel in zip(itertools.product(rows, cols), panels.flat, strict=True):
        if (row, col) not in cells:
            panel.axis("off")
            continue
        index = cells.index((row, col))
        _panel(panel, stimulus.isel(whisker=index), values[:, index], f"{ROWS[row]}{col}", points)
        # Only panels at an edge of the layout carry numbers.
        panel.tick_params(labelleft=(row, col - 1) not in cells, labelbottom=(row + 1, col) not in cells)
    times = stimulus["time"].values * 1e3
    lower, upper = limits
    margin = 0.04 * (upper - lower)
    panels[0, 0].set(xlim=(times[0], times[-1]), ylim=(lower - margin, upper + margin))
    panels[0, 0].set_yticks([lower, 0, upper] if lower else [0, upper / 2, upper])
    panels[0, 0].locator_params(axis="x", nbins=4)
    # The attribute begins with the axes, "world axes; …" or "follicle axes; …".
    axes = str(stimulus.attrs.get("frame", "world")).split()[0]
    _legend(figure, label, channel, axes, points)
    return figure


def _panel(panel: Axes, whisker: xr.Dataset, values: NDArray[np.float64], name: str, points: float) -> None:
    times = whisker["time"].values * 1e3
    if "contact" in whisker:
        touching = whisker["contact"].values
        panel.fill_between(
            times, 0, 1, where=touching, step="mid", transform=panel.get_xaxis_transform(), color=CONTACT_COLOR, lw=0
        )
    panel.axhline(0, color=PALE, linewidth=0.8 * points)
    corner: dict[str, Any] = {"transform": panel.transAxes, "va": "top", "ha": "right"}
    stable = "status" not in whisker or str(whisker["status"].values) == "ok"
    colors = LINE_COLORS if values.shape[1] > 1 else (INK,)
    for line, color in zip(values.T, colors, strict=True):
        panel.plot(times, line, color=color, linewidth=1.9 * points)
    panel.text(
        0.03, 0.95, name, transform=panel.transAxes, fontsize=17 * points, fontweight="bold", color=INK, va="top"
    )
    if not stable:
        panel.text(0.97, 0.95, "unstable", fontsize=14 * points, color="#b00020", **corner)
    elif "contact" in whisker and not whisker["contact"].values.any():
        panel.text(0.97, 0.95, "no contact", fontsize=13 * points, color=PALE, **corner)
    panel.tick_params(labelsize=13 * points, length=4 * points, colors=INK)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        panel.spines[side].set(color=PALE, linewidth=0.8 * points)


def _legend(figure: Figure, label: str, channel: str, axes: str, points: float) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    kind = "force" if channel[0] == "F" else "moment"
    unit = _UNITS[channel[0]][0]
    what = f"|{channel}|" if channel in _UNITS else ", ".join(QUANTITIES[channel])
    about = f"{kind} of the whisker on its base, {what} ({unit}), {axes} axes"
    font: dict[str, Any] = {"fontsize": 16 * points}
    figure.text(0.02, 0.965, label, fontsize=26 * points, fontweight="bold", color=INK, va="center")
    figure.text(0.02, 0.92, about, color=PALE, va="center", **font)
    figure.text(0.52, 0.018, "time (ms)", color=INK, ha="center", va="center", **font)
    figure.text(0.014, 0.48, f"{kind} ({unit})", color=INK, rotation=90, va="center", ha="center", **font)
    colors = LINE_COLORS if channel.endswith("xyz") else (INK,)
    names: Sequence[str] = QUANTITIES[channel] if channel.endswith("xyz") else (what,)
    handles: list[Any] = [
        Line2D([], [], color=color, linewidth=3 * points, label=name) for name, color in zip(names, colors, strict=True)
    ]
    handles.append(Patch(color=CONTACT_COLOR, label="contact"))
    figure.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(0.99, 0.99), ncols=4, fontsize=16 * points, frameon=False
    )
