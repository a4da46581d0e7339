"""Stimulus sets of forces that were simulated elsewhere, with a status for every frame of every whisker."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench import __version__
from brainbench.core.contracts import CHANNELS, check_stimulus_set
from brainbench.core.errors import DataError, listing
from brainbench.core.files import to_json
from brainbench.stimuli.scenes.frames import Frames
from brainbench.stimuli.stimulus_set import hash_stimulus_set
from brainbench.stimuli.whiskers.selection import ROWS

if TYPE_CHECKING:
    import xarray as xr

FRAME_STATUSES = ("ok", "missing", "too large", "unwritten", "repeated")
"""Texts of ``frame_status``, 0 to 4. ``unwritten``: row 0 of a simulator that stores a row before it computes it, even
where the numbers look right. ``repeated``: equal to the frame before, as a published cleaning fills gaps."""
_DOUBTFUL = ("missing", "too large")
"""Statuses of frames that make the whole whisker ``unstable``."""
_SIDES = {"R": "right", "L": "left"}


def assemble_stimulus_set(
    labels: Sequence[str],
    wrench: NDArray[np.floating],
    names: Sequence[str],
    frames: Frames,
    *,
    backend: str,
    frame_status: NDArray[np.uint8],
    contact: NDArray[np.bool_] | None = None,
    sources: Sequence[Mapping[str, Any]] | None = None,
    about: Mapping[str, Any],
) -> xr.Dataset:
    """Make a stimulus set.

    ``status`` [stimulus, whisker] is ``unstable`` where a value is missing or too large, and ``reason`` counts frames.

    Args:
        labels: of the stimuli, all different.
        wrench: [stimulus, time, whisker, channel] in N and N·m, world axes, action of the whisker on its base.
        names: whiskers with their side, such as ``RC2``.
        frames: times of the frames.
        backend: what simulated them.
        frame_status: [stimulus, time, whisker] index into :data:`FRAME_STATUSES`.
        contact: [stimulus, time, whisker] whether a whisker touches, where that is known.
        sources: what else is known of each stimulus.
        about: further attributes; mappings become JSON.

    Raises:
        DataError: two stimuli have the same label.
    """
    import xarray as xr

    if twice := [label for label, count in Counter(labels).items() if count > 1]:
        raise DataError(f"Several stimuli are called {listing(twice)}; each needs a name of its own.")
    text = functools.partial(to_json, indent=None)
    grid, over_time = ("stimulus", "whisker"), ("stimulus", "time", "whisker")
    counts = {name: (frame_status == code).sum(axis=1) for code, name in enumerate(FRAME_STATUSES) if code}
    unstable = np.any([counts[name] > 0 for name in _DOUBTFUL], axis=0)
    reasons = np.empty((len(labels), len(names)), dtype=object)
    for place in np.ndindex(*reasons.shape):
        reasons[place] = ", ".join(f"frames {name}: {n}" for name, count in counts.items() if (n := count[place]))
    sides = [_SIDES[name[0]] for name in names]
    short = [name[1:] for name in names]
    shown = short if len(set(short)) == len(short) else list(names)
    known = sources or [{}] * len(labels)
    scenes = [
        {"label": label, "frames": frames.config(), **source} for label, source in zip(labels, known, strict=True)
    ]
    dataset = xr.Dataset(
        {
            "wrench": ((*over_time, "channel"), wrench.astype(np.float32), {"units": "N (F), N m (M)"}),
            "frame_status": (over_time, frame_status, {"meaning": ", ".join(FRAME_STATUSES)}),
            "status": (grid, np.where(unstable, "unstable", "ok").astype(object)),
            "reason": (grid, reasons),
        },
        coords={
            "stimulus": np.array(labels, dtype=object),
            "time": ("time", frames.times, {"units": "s"}),
            "whisker": np.array(shown, dtype=object),
            "row": ("whisker", [ROWS.index(name[1]) for name in names]),
            "col": ("whisker", [int(name[2:]) for name in names]),
            "side": ("whisker", np.array(sides, dtype=object)),
            "channel": np.array(CHANNELS, dtype=object),
        },
        attrs={
            "array": text({"species": "not stated", "side": " and ".join(dict.fromkeys(sides)), "whiskers": shown}),
            "scene": text(scenes),
            "fidelity": text({}),
            # Contracts ask for the field; what was drawn elsewhere is not known.
            "seed": 0,
            "backend": backend,
            "version": __version__,
            "frame": "world axes; action of the whisker on its base, about the base point",
            "axes": "world",
            "readout": frames.describe(),
            **{key: value if isinstance(value, str) else text(value) for key, value in about.items()},
        },
    )
    if contact is not None:
        dataset["contact"] = (over_time, contact)
    dataset.attrs["content_hash"] = dataset.attrs["config_hash"] = hash_stimulus_set(dataset)
    return check_stimulus_set(dataset)
