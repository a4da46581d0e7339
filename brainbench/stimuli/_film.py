"""Films: frames go to the file one by one, so that memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.errors import DataError, missing_dependency
from brainbench.files import atomic_path

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.stimuli.render import Style
    from brainbench.stimuli.simulation import Progress


def write_film(
    path: Path,
    frames: Iterable[NDArray[np.uint8]],
    count: int,
    style: Style,
    *,
    palette_from: Sequence[NDArray[np.uint8]] = (),
    progress: Progress | None = None,
) -> Path:
    """Write frames [H, W, 3] to a ``.gif`` that repeats for ever, or to an ``.mp4`` (H.264).

    Args:
        path: file to write; the suffix, one of the two, chooses the format.
        frames: pictures of one size.
        count: number of frames, for ``progress``.
        style: size and frames per second.
        palette_from: frames whose colours the 256 colours of a GIF are chosen from.
        progress: called as ``progress(done, total, what)`` after each frame.

    Raises:
        MissingDependencyError: a package of the extra ``report`` is missing.
        DataError: the encoder failed.
    """
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with atomic_path(path) as temporary:
        write(temporary, _counted(frames, count, progress), style, palette_from)
    return path


def _counted(frames: Iterable[Any], count: int, progress: Progress | None) -> Iterator[Any]:
    for done, frame in enumerate(frames, start=1):
        yield frame
        if progress is not None:
            progress(done, count, "drawing frames")


def _write_gif(path: Path, frames: Iterable[NDArray[np.uint8]], style: Style, palette_from: Sequence[Any]) -> None:
    try:
        from PIL import GifImagePlugin, Image
    except ImportError as error:
        raise missing_dependency("pillow", extra="report", purpose="Writing a GIF") from error
    palette = Image.fromarray(np.concatenate(palette_from)).quantize(256, kmeans=1, dither=Image.Dither.NONE)
    # A GIF counts hundredths of a second, and viewers slow down anything shorter than two.
    duration = 10 * max(2, round(100 / style.frames_per_second))
    with path.open("wb") as file:
        for index, frame in enumerate(frames):
            image = Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
            if index == 0:
                # Pillow's own writer keeps all frames in memory; its parts do not.
                file.writelines(GifImagePlugin.getheader(image, info={"optimize": False, "loop": 0})[0])
            file.writelines(GifImagePlugin.getdata(image, duration=duration))
        file.write(b";")


def _write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], style: Style, palette_from: Sequence[Any]) -> None:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise missing_dependency("imageio-ffmpeg", extra="report", purpose="Writing an MP4") from error
    # H.264 stores colour for blocks of two by two pixels.
    width, height = (size - size % 2 for size in style.size)
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=style.frames_per_second, quality=8, macro_block_size=2, codec="libx264"
    )
    try:
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame[:height, :width]).tobytes())
    except OSError as error:
        raise DataError(f"The video encoder failed ({error}).") from error
    finally:
        writer.close()
