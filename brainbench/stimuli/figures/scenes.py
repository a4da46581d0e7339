"""Pictures and films of scenes: whiskers as tapered tubes among shaded objects, without a display or OpenGL."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, listing
from brainbench.core.figures.style import check_format
from brainbench.core.progress import Progress, track
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.figures.annotation import Annotation
from brainbench.stimuli.figures.camera import Camera
from brainbench.stimuli.figures.canvas import Style
from brainbench.stimuli.figures.films import require_writer, write_film
from brainbench.stimuli.figures.picture import Picture
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.scenes.scene import Scene
from brainbench.stimuli.whisker_shapes import record

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
