"""Stimulus sets of forces that were simulated elsewhere, with a status for every frame of every whisker."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import DataError, listing, repeats
from brainbench.core.files import to_json
from brainbench.stimuli.scenes.frames import Frames
from brainbench.stimuli.stimulus_set import hash_stimulus_set, new_stimulus_set
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
    wrench: NDArray[np.floating],
    names: Sequence[str],
    frames: Frames,
    sources: Sequence[Mapping[str, Any]],
    faults: Mapping[str, NDArray[np.bool_]],
    *,
    frame_status: NDArray[np.uint8] | None = None,
    contact: NDArray[np.bool_] | None = None,
    **about: str,
) -> xr.Dataset:
    """Make a stimulus set.

    ``frame_status`` [stimulus, time, whisker] is an index into :data:`FRAME_STATUSES`, ``status`` [stimulus, whisker]
    is ``unstable`` where a value is missing or too large, ``reason`` counts frames, and the attribute ``faults`` (JSON)
    values.

    Args:
        wrench: [stimulus, time, whisker, channel] in N and N·m, world axes, action of the whisker on its base.
        names: whiskers with their side, such as ``RC2``.
        frames: times of the frames.
        sources: what is known of each stimulus: its ``label``, different from all others, and more.
        faults: status → where [stimulus, time, whisker, channel] a value has this fault; a later one wins.
        frame_status: statuses that hold where there is no fault.
        contact: [stimulus, time, whisker] whether a whisker touches, where that is known.
        about: further attributes.
    """
    labels = [source["label"] for source in sources]
    if twice := repeats(labels):
        raise DataError(f"Several stimuli are called {listing(twice)}; each needs a name of its own.")
    text = functools.partial(to_json, indent=None)
    grid, over_time = ("stimulus", "whisker"), ("stimulus", "time", "whisker")
    marked = np.zeros(wrench.shape[:3], dtype=np.uint8) if frame_status is None else frame_status.copy()
    for name, where in faults.items():
        marked[where.any(axis=-1)] = FRAME_STATUSES.index(name)
    counts = {name: (marked == code).sum(axis=1) for code, name in enumerate(FRAME_STATUSES) if code}
    unstable = np.any([counts[name] > 0 for name in _DOUBTFUL], axis=0)
    reasons = np.empty((len(labels), len(names)), dtype=object)
    for place in np.ndindex(*reasons.shape):
        reasons[place] = ", ".join(f"frames {name}: {n}" for name, count in counts.items() if (n := count[place]))
    sides, short = [_SIDES[name[0]] for name in names], [name[1:] for name in names]
    shown = short if len(set(short)) == len(short) else list(names)
    values = {name: where.sum(axis=(1, 2, 3)).tolist() for name, where in faults.items()}
    told = {label: {name: n for name, found in values.items() if (n := found[i])} for i, label in enumerate(labels)}
    dataset = new_stimulus_set(
        labels,
        [(one, ROWS.index(name[1]), int(name[2:]), _SIDES[name[0]]) for one, name in zip(shown, names, strict=True)],
        frames,
        {
            "wrench": ((*over_time, "channel"), wrench.astype(np.float32), {"units": "N (F), N m (M)"}),
            "frame_status": (over_time, marked, {"meaning": ", ".join(FRAME_STATUSES)}),
            "status": (grid, np.where(unstable, "unstable", "ok").astype(object)),
            "reason": (grid, reasons),
        },
        {
            "array": text({"species": "not stated", "side": " and ".join(dict.fromkeys(sides)), "whiskers": shown}),
            "scene": text([{"label": source["label"], "frames": frames.config(), **source} for source in sources]),
            "fidelity": text({}),
            "backend": "whiskit",
            "faults": text({label: found for label, found in told.items() if found}),
            **about,
        },
    )
    if contact is not None:
        dataset["contact"] = (over_time, contact)
    dataset.attrs["content_hash"] = dataset.attrs["config_hash"] = hash_stimulus_set(dataset)
    return check_stimulus_set(dataset)
