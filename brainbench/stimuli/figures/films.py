"""Films: frames go to the file one by one, so that memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, needing
from brainbench.core.files import atomic_path
from brainbench.stimuli.figures.canvas import Style

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
