"""Stimulus sets of forces that were simulated elsewhere, with a status for every frame of every whisker."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import SWEEPS_FORMAT, SWEEPS_SCHEMA, check_stimulus_set
from brainbench.core.errors import DataError, listing, repeats
from brainbench.core.files import content_hash, to_json
from brainbench.core.progress import Progress
from brainbench.core.version import __version__
from brainbench.stimuli.objects.collections import NamedObject
from brainbench.stimuli.objects.solid import Solid
from brainbench.stimuli.scenes.frames import Frames
from brainbench.stimuli.stimulus_set import hash_stimulus_set, new_stimulus_set
from brainbench.stimuli.sweeps.generation import write_data_set
from brainbench.stimuli.sweeps.plan import SPLITS, USUAL_SHARD, PlannedShard
from brainbench.stimuli.sweeps.shards import (
    COUNTS,
    OK,
    UNSTABLE,
    ShardContent,
    encode_texts,
    shard_attributes,
    shard_tables,
    write_shard,
)
from brainbench.stimuli.whiskers.array import WhiskerArray
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
    short_names = short if len(set(short)) == len(short) else list(names)
    values = {name: where.sum(axis=(1, 2, 3)).tolist() for name, where in faults.items()}
    counted = [{name: n for name, sums in values.items() if (n := sums[i])} for i in range(len(labels))]
    dataset = new_stimulus_set(
        labels,
        [
            (short, ROWS.index(name[1]), int(name[2:]), _SIDES[name[0]])
            for short, name in zip(short_names, names, strict=True)
        ],
        frames,
        {
            "wrench": ((*over_time, "channel"), wrench.astype(np.float32), {"units": "N (F), N m (M)"}),
            "frame_status": (over_time, marked, {"meaning": ", ".join(FRAME_STATUSES)}),
            "status": (grid, np.where(unstable, "unstable", "ok").astype(object)),
            "reason": (grid, reasons),
        },
        {
            "array": text(
                {"species": "not stated", "side": " and ".join(dict.fromkeys(sides)), "whiskers": short_names}
            ),
            "scene": text([{"label": source["label"], "frames": frames.config(), **source} for source in sources]),
            "fidelity": text({}),
            "backend": "whiskit",
            "faults": text({label: counts for label, counts in zip(labels, counted, strict=True) if counts}),
            **about,
        },
    )
    if contact is not None:
        dataset["contact"] = (over_time, contact)
    dataset.attrs["content_hash"] = dataset.attrs["config_hash"] = hash_stimulus_set(dataset)
    return check_stimulus_set(dataset)


@dataclass(frozen=True, eq=False)
class SweepTable:
    """Facts about the sweeps of a data set; arrays have one entry per sweep."""

    label: NDArray[np.integer]
    """Index into ``classes``."""
    object: NDArray[np.str_]
    """Name of the object."""
    split: NDArray[np.str_]
    """One of :data:`~brainbench.stimuli.sweeps.plan.SPLITS`."""
    conditions: Mapping[str, NDArray[np.float64]]
    """Speed, height, rotation, distance and size, as in :class:`~brainbench.stimuli.sweeps.grid.Sweep`."""
    classes: tuple[str, ...]
    times: NDArray[np.float64]
    """Times of the frames [s]."""
    source: str
    """Description of where the sweeps come from."""
    source_hash: str
    """Hash of everything that their files say."""
    read: Callable[[NDArray[np.int64]], NDArray[np.float32]]
    """Function from numbers of sweeps to their forces [sweep, frame, whisker, 6] (N, N·m; NaN where they cannot be
    trusted) of the 30 whiskers of the mouse's right side, in the order of that array."""
    notes: Mapping[str, Any]
    """Further entries of the manifest, such as counts of faults."""
    shard_size: int = USUAL_SHARD

    def __post_init__(self) -> None:
        names, owner = np.unique(self.object, return_inverse=True)
        pairs = np.unique(np.stack([owner, self.label], axis=1), axis=0)
        if len(pairs) > len(names):
            twice = np.flatnonzero(np.bincount(pairs[:, 0]) > 1)[0]
            labels = pairs[pairs[:, 0] == twice, 1].tolist()
            raise DataError(f"The object {str(names[twice])!r} has the labels {labels}; an object has one label.")

    @property
    def sweeps(self) -> int:
        """Number of sweeps."""
        return len(self.label)

    @cached_property
    def array(self) -> WhiskerArray:
        """The whiskers."""
        return WhiskerArray.mouse()

    @cached_property
    def config(self) -> dict[str, Any]:
        """Plain values that determine every byte of the data set."""
        return {
            "format": SWEEPS_FORMAT, "schema": SWEEPS_SCHEMA, "version": __version__, "recipe": self.source,
            "source": self.source_hash, "whiskers": {"names": list(self.array.names)},
            "classes": list(self.classes), "shard_size": self.shard_size,
        }  # fmt: skip

    @cached_property
    def config_hash(self) -> str:
        """Hash of :attr:`config`."""
        return content_hash(self.config)

    @property
    def objects(self) -> dict[str, NamedObject]:
        """The objects by name; only their names are known."""
        names, first = np.unique(self.object, return_index=True)
        labels = [self.classes[label] for label in self.label[first].tolist()]
        pairs = zip(names.tolist(), labels, strict=True)
        return {name: NamedObject(name, label, self.source, partial(_no_solid, name)) for name, label in pairs}

    @cached_property
    def shards(self) -> tuple[PlannedShard, ...]:
        """The shards, those of training first, in the order of the table."""
        objects_by_name, shards = self.objects, []
        for split in SPLITS:
            mine = np.flatnonzero(self.split == split)
            for place, first in enumerate(range(0, len(mine), self.shard_size)):
                index = mine[first : first + self.shard_size]
                objects = tuple(objects_by_name[name] for name in np.unique(self.object[index]).tolist())
                shard = PlannedShard(
                    split=split, place=place, objects=objects, index=index, frames=len(self.times), config=self.config,
                    config_hash=self.config_hash,
                )  # fmt: skip
                shards.append(shard)
        return tuple(shards)

    def content(self, shard: PlannedShard) -> ShardContent:
        """Read the sweeps of a shard; a whisker with missing values is marked as unstable."""
        index = shard.index
        wrench = np.ascontiguousarray(self.read(index), dtype="<f4")
        bad = ~np.isfinite(wrench)
        status = np.where(bad.any(axis=(1, 3)), UNSTABLE, OK).astype(np.uint8)
        names = [item.name for item in shard.objects]
        arrays = {
            **shard_tables(shard, self.array, self.times, [""] * len(names)),
            "sweep": index.astype(np.int64),
            "label": self.label[index].astype(np.int32),
            "owner": np.searchsorted(names, self.object[index]).astype(np.int32),
            **{name: np.asarray(values[index], dtype=np.float64) for name, values in self.conditions.items()},
            "draw": np.zeros(len(index), dtype=np.int32),
            # Which whiskers touch is in no file of theirs.
            "contact": np.full(status.shape, np.nan, dtype=np.float32),
            "status": status,
            "reason": encode_texts(f"{n} values cannot be trusted" if n else "" for n in bad.sum(axis=(1, 2, 3))),
            "wrench": wrench,
        }
        return ShardContent(shard, arrays, shard_attributes(shard, "world", status, dict.fromkeys(COUNTS, 0)))


def convert_sweeps(
    table: SweepTable, out: str | os.PathLike[str], *, progress: Progress | None = None
) -> dict[str, Any]:
    """Write a data set of sweeps, one shard in memory at a time, and return its manifest.

    A run that was killed goes on when it is started again, and ends with the same bytes.
    """

    def run(missing: Sequence[PlannedShard], folder: Path, done: Callable[[int], None]) -> None:
        for shard in missing:
            done(write_shard(table.content(shard), folder))

    return write_data_set(table, out, run, what="converting sweeps", progress=progress)


def _no_solid(name: str) -> Solid:
    raise DataError(f"Of the object {name!r} no more is known than its name.")
