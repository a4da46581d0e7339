"""Pictures and films of scenes: whiskers as tapered tubes among shaded objects, without a display or OpenGL."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, UsageError, listing, needing
from brainbench.core.figures import check_format
from brainbench.core.files import atomic_path
from brainbench.core.progress import Progress, track
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.figures.pictures import Annotation, Picture, Style
from brainbench.stimuli.figures.surfaces import Camera
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.scenes.scene import Scene
from brainbench.stimuli.whisker_shapes import record

_UNCHANGED = 255
"""Index of a GIF's palette that means "as in the frame before"; the colours are those below it."""


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
    latest, last = times.max(initial=0.0) * MILLI, float(scene.frames.times[-1]) * MILLI
    if latest > last + 1e-6:
        raise UsageError(
            f"The scene {scene.label!r} ends at {last:g} ms; received the instant {latest:g} ms: choose an earlier "
            "one, or give the scene more frames."
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
