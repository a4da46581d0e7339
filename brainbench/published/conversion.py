"""Published sweeps, and stimulus sets and data sets of forces that were simulated elsewhere, with their statuses.

The published study keeps one ``.npz`` per sweep, as its ``process_raw_dataset.py`` writes them.
``data`` [110, 35, 6] in mN and mN·mm = µN·m, Fx … Mz, in world axes: the action of the whisker on its base, as ours.
The 35 cells are the flat 5 × 7 grid, of which 5, 6, 12, 13 and 34 have no whisker; without ``--process_values`` there
are the 30 whiskers alone. ``shape`` is "category/object", ``label`` the number of the class. Sweeps at 1000 Hz hold
``h``, ``d``, ``t`` as texts (mm, mm, degrees), those at 110 Hz ``h``, ``to``, ``t``, ``v``, ``s`` (mm, degrees,
degrees, mm/s, mm).
"""

from __future__ import annotations

import functools
import logging
import math
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, SWEEPS_FORMAT, SWEEPS_SCHEMA, check_stimulus_set
from brainbench.core.devices import usable_processors
from brainbench.core.errors import DataError, listing, repeats
from brainbench.core.files import cache_dir, content_hash, file_hash, read_json, to_json
from brainbench.core.progress import Progress
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.core.reading.tensors import read_npz
from brainbench.core.reading.texts import check_values
from brainbench.core.version import __version__
from brainbench.datasets.whisking.dataset import FOLDERS, Shard
from brainbench.stimuli.objects.collections import NamedObject
from brainbench.stimuli.objects.solid import Solid
from brainbench.stimuli.scenes.scene import Frames
from brainbench.stimuli.stimulus_set import hash_stimulus_set, new_stimulus_set
from brainbench.stimuli.sweeps.generation import write_data_set
from brainbench.stimuli.sweeps.plan import (
    COUNTS,
    OK,
    SPLITS,
    UNSTABLE,
    USUAL_SHARD,
    PlannedShard,
    ShardContent,
    encode_texts,
    shard_attributes,
    shard_tables,
    write_shard,
)
from brainbench.stimuli.whiskers.array import ROWS, WhiskerArray

if TYPE_CHECKING:
    import xarray as xr

FRAME_STATUSES = ("ok", "missing", "too large", "unwritten", "repeated")
"""Texts of ``frame_status``, 0 to 4. ``unwritten``: row 0 of a simulator that stores a row before it computes it, even
where the numbers look right. ``repeated``: equal to the frame before, as a published cleaning fills gaps."""
_DOUBTFUL = ("missing", "too large")  # statuses of frames that make the whole whisker `unstable`
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


FRAMES = 110
EMPTY_CELLS = (5, 6, 12, 13, 34)
CELLS = np.setdiff1d(np.arange(GRID_SHAPE[0] * GRID_SHAPE[1]), EMPTY_CELLS)
"""[30] flat cell of each whisker: A0–A4, B0–B4, C0–C6, D0–D6, E0–E5."""
LARGEST = 1000.0  # magnitude [mN, µN·m] above which the published cleaning trusts no value
SCALE = np.repeat([1e-3, 1e-6], 3)  # N and N·m per mN and µN·m, by channel
RATES: Mapping[int, tuple[str, ...]] = {1000: ("h", "d", "t"), 110: ("h", "to", "t", "v", "s")}
"""Fields with the conditions, by simulated rate [Hz]."""
FRAME_TIMES = {1000: (0.001, 0.009), 110: (0.0, 1 / 110)}
"""Time of the first frame and interval [s]: of 1000 rows 1, 10, … 982 are kept, of 110 all."""
CONDITIONS = ("speed", "height", "rotation", "distance", "size")
"""Conditions of a sweep, in m/s, m, rad, m and m; what a file does not say is that of table 3.1 of the thesis."""
FAULTS = {
    "repeated": "equal those of the frame before in a channel that moves, as the published cleaning fills gaps",
    "too large": "are beyond 1000 mN or µN·m",
    "missing": "are missing",
    "unwritten": "of row 0 at 110 Hz come from memory that nothing has written",
}
"""Known faults of values → what they are."""
DOUBTFUL = ("too large", "missing")  # faults of values that are not used


@dataclass(frozen=True, eq=False)
class SweepFile:
    """One sweep as its file holds it."""

    data: NDArray[np.float64]
    """[110, 30, 6] forces and moments of the 30 whiskers (mN, µN·m)."""
    label: int | None
    """Number of the class; None where the file has none, or "?"."""
    shape: str
    """"category/object"."""
    rate: int
    """Simulated frames per second, 1000 or 110."""
    conditions: tuple[float, ...]
    """Values of :data:`CONDITIONS`."""

    def wrench(self) -> NDArray[np.float32]:
        """Return the forces [110, 30, 6] in N and N·m; NaN where a value is missing or beyond :data:`LARGEST`."""
        trusted = np.abs(self.data) <= LARGEST
        return np.where(trusted, self.data * SCALE, math.nan).astype(np.float32)

    def faulty(self) -> dict[str, NDArray[np.bool_]]:
        """Return where [110, 30, 6] a value has each of :data:`FAULTS`."""
        before = np.pad(self.data, ((1, 0), (0, 0), (0, 0)))[:-1]
        repeated = (self.data == before) & (self.data != 0)
        # A whisker may rest on the object: an equal value is a filled gap where most frames differ.
        moving = 2 * repeated.sum(axis=0) < (self.data != 0).sum(axis=0)
        unwritten = np.zeros(self.data.shape, dtype=bool)
        unwritten[0] = (self.data[0] != 0) & (self.rate == 110)
        masks = (repeated & moving, np.abs(self.data) > LARGEST, np.isnan(self.data), unwritten)
        return dict(zip(FAULTS, masks, strict=True))


def read_sweep(path: str | os.PathLike[str]) -> SweepFile:
    """Read a sweep file; no pickle is loaded."""
    name, held = os.fspath(path), read_npz(path, "published sweep (.npz)")
    rate = next((rate for rate, needed in RATES.items() if {"data", "shape", *needed} <= held.keys()), None)
    if rate is None:
        raise DataError(
            f"{name!r} is no sweep of the published study: it holds {', '.join(held) or 'nothing'}; needed are data, "
            "shape, label and h, d, t (1000 Hz) or h, to, t, v, s (110 Hz)."
        )
    try:
        fields = {key: float(str(held[key])) for key in RATES[rate]}
    except ValueError as error:
        raise DataError(f"{name!r} has a condition that is no number ({error}).") from error
    check_values(fields, name)
    label = _label(str(held.get("label", "")))
    return SweepFile(_whiskers(held["data"], name), label, str(held["shape"]), rate, _conditions(fields))


def _whiskers(data: NDArray[Any], name: str) -> NDArray[np.float64]:
    """Return the 30 whiskers of an array of 35 cells, or of the whiskers alone."""
    grid, alone = [FRAMES, GRID_SHAPE[0] * GRID_SHAPE[1], len(CHANNELS)], [FRAMES, len(CELLS), len(CHANNELS)]
    if data.dtype.kind not in "fiu" or [*data.shape] not in (grid, alone):
        raise DataError(
            f"'data' in {name!r} is {[*data.shape]} of {data.dtype}; a published sweep has numbers {grid} "
            f"(frame, cell, channel), or {alone} for the whiskers alone."
        )
    if [*data.shape] == grid:
        if np.any(data[:, EMPTY_CELLS]):
            raise DataError(f"'data' in {name!r} has forces in the cells {EMPTY_CELLS}, which have no whisker.")
        data = data[:, CELLS]
    return np.asarray(data, dtype=np.float64)


def _label(text: str) -> int | None:
    """Return a class number; None for anything that is not one."""
    try:
        number = float(text)
    except ValueError:
        return None
    return int(number) if 0 <= number < 2**31 and number.is_integer() else None


def _conditions(fields: Mapping[str, float]) -> tuple[float, ...]:
    """Return :data:`CONDITIONS` of the fields of a file; rotation is the turn and its offset ``to`` together."""
    speed, distance, size = fields.get("v", 30.0), fields.get("d", 5.0), fields.get("s", 40.0)
    rotation = math.radians(fields["t"] + fields.get("to", 0.0))
    return speed / 1e3, fields["h"] / 1e3, rotation, distance / 1e3, size / 1e3


_LOG = logging.getLogger(__name__)

MOST_CLASSES = 10_000
_VERSION = 1
_TOGETHER = 2048  # files listed between two entries in the cache: what a killed run loses


class Listed(NamedTuple):
    """Columns of the list of sweep files, one entry per file."""

    path: NDArray[np.str_]
    """Path in the folder: ``train/00000000.npz``."""
    shape: NDArray[np.str_]
    label: NDArray[np.int64]
    """Number of the class; −1 without."""
    rate: NDArray[np.int64]
    conditions: NDArray[np.float64]
    """[file, condition] in the order of :data:`CONDITIONS`."""
    faults: NDArray[np.int64]
    """[file, fault] in the order of :data:`FAULTS`."""
    digest: NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class SweepTree:
    """The labelled sweeps of a folder, those of training first, in the order of their names.

    They are read where they are (:meth:`open_shard`), or planned as the shards of a data set of ours.
    """

    folder: Path
    listed: Listed
    """Without the sweeps that have no label."""
    split: NDArray[np.str_]
    classes: tuple[str, ...]
    """Names by the number in the files."""
    left_out: int
    """Sweeps without a label."""
    shard_size: int = USUAL_SHARD

    @property
    def rate(self) -> int:
        """Simulated frames per second, 1000 or 110."""
        return int(self.listed.rate[0])

    @property
    def times(self) -> NDArray[np.float64]:
        """Times of the frames [s]."""
        first, interval = FRAME_TIMES[self.rate]
        return np.asarray(first + interval * np.arange(FRAMES), dtype=np.float64)

    @property
    def faults(self) -> dict[str, int]:
        """Values with each known fault, in all sweeps."""
        return dict(zip(FAULTS, self.listed.faults.sum(axis=0).tolist(), strict=True))

    @cached_property
    def content_hash(self) -> str:
        """Hash of the content of all files, their labels and splits."""
        return content_hash(self.listed.path.tolist(), self.listed.digest.tolist(), self.classes, _VERSION)

    def wrenches(self, sweeps: Sequence[int] | NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the forces [sweep, frame, whisker, channel] of some sweeps (N, N·m)."""
        return np.stack([read_sweep(self.folder / path).wrench() for path in self.listed.path[sweeps]])

    def conditions(self) -> dict[str, NDArray[np.float64]]:
        """Return the conditions [sweep] by name, in SI units."""
        return dict(zip(CONDITIONS, self.listed.conditions.T, strict=True))

    def manifest(self) -> dict[str, Any]:
        """Return what the manifest of a data set of ours says, for sweeps that stay where they are."""
        sizes = Counter(self.split.tolist())
        return {
            "content_hash": self.content_hash,
            "classes": list(self.classes),
            "sweeps": self.sweeps,
            **self.notes,
            "splits": {name: {"sweeps": sizes[name]} for name in dict.fromkeys(FOLDERS.values())},
            "shards": [{"name": name, "split": name, "sweeps": size} for name, size in sizes.items()],
        }

    @property
    def sweeps(self) -> int:
        """Number of sweeps."""
        return len(self.split)

    @property
    def notes(self) -> dict[str, Any]:
        """What a manifest says of sweeps that are left out and of known faults."""
        return {"left_out": self.left_out, "faults": self.faults}

    @cached_property
    def array(self) -> WhiskerArray:
        """The whiskers."""
        return WhiskerArray.mouse()

    @cached_property
    def config(self) -> dict[str, Any]:
        """Plain values that determine every byte of the data set."""
        return {
            "format": SWEEPS_FORMAT, "schema": SWEEPS_SCHEMA, "version": __version__,
            "recipe": f"published sweeps, {self.rate} Hz", "source": self.content_hash,
            "whiskers": {"names": list(self.array.names)}, "classes": list(self.classes),
            "shard_size": self.shard_size,
        }  # fmt: skip

    @cached_property
    def config_hash(self) -> str:
        """Hash of :attr:`config`."""
        return content_hash(self.config)

    @property
    def objects(self) -> dict[str, NamedObject]:
        """The objects by name; only their names are known."""
        labels = dict(zip(self.listed.shape.tolist(), self.listed.label.tolist(), strict=True))
        source = self.config["recipe"]
        return {
            name: NamedObject(name, self.classes[label], source, partial(_no_solid, name))
            for name, label in sorted(labels.items())
        }

    @cached_property
    def shards(self) -> tuple[PlannedShard, ...]:
        """The shards, those of training first, in the order of the table."""
        objects_by_name, shards = self.objects, []
        for split in SPLITS:
            mine = np.flatnonzero(self.split == split)
            for place, first in enumerate(range(0, len(mine), self.shard_size)):
                index = mine[first : first + self.shard_size]
                objects = tuple(objects_by_name[name] for name in np.unique(self.listed.shape[index]).tolist())
                shard = PlannedShard(
                    split=split, place=place, objects=objects, index=index, frames=len(self.times), config=self.config,
                    config_hash=self.config_hash,
                )  # fmt: skip
                shards.append(shard)
        return tuple(shards)

    def content(self, shard: PlannedShard) -> ShardContent:
        """Read the sweeps of a shard; a whisker with missing values is marked as unstable."""
        index = shard.index
        wrench = np.ascontiguousarray(self.wrenches(index), dtype="<f4")
        bad = ~np.isfinite(wrench)
        status = np.where(bad.any(axis=(1, 3)), UNSTABLE, OK).astype(np.uint8)
        names = [item.name for item in shard.objects]
        arrays = {
            **shard_tables(shard, self.array, self.times, [""] * len(names)),
            "sweep": index.astype(np.int64),
            "label": self.listed.label[index].astype(np.int32),
            "owner": np.searchsorted(names, self.listed.shape[index]).astype(np.int32),
            **{name: np.asarray(values[index], dtype=np.float64) for name, values in self.conditions().items()},
            "draw": np.zeros(len(index), dtype=np.int32),
            # Which whiskers touch is in no file of theirs.
            "contact": np.full(status.shape, np.nan, dtype=np.float32),
            "status": status,
            "reason": encode_texts(f"{n} values cannot be trusted" if n else "" for n in bad.sum(axis=(1, 2, 3))),
            "wrench": wrench,
        }
        return ShardContent(shard, arrays, shard_attributes(shard, "world", status, dict.fromkeys(COUNTS, 0)))

    def open_shard(self, split: str) -> FileShard:
        """Return the sweeps of one split as a shard."""
        mine = np.flatnonzero(self.split == split)
        doubtful = self.listed.faults[mine][:, [[*FAULTS].index(name) for name in DOUBTFUL]]
        return FileShard(
            path=self.folder / split,
            offset=0,
            sweeps=len(mine),
            shape=(FRAMES, len(CELLS), len(CHANNELS)),
            cells=CELLS,
            labels=self.listed.label[mine].astype(np.int32),
            objects=self.listed.shape[mine],
            indices=mine,
            broken=doubtful.sum(axis=1) > 0,
            empty=np.zeros(len(mine), dtype=bool),
            content_hash=self.content_hash,
            interval=FRAME_TIMES[self.rate][1],
            axes="world",
            tree=self,
        )


@dataclass(frozen=True, eq=False)
class FileShard(Shard):
    """The sweeps of one split, each in its own file."""

    tree: SweepTree

    def forces(self) -> Any:
        """Return what gives the forces [frame, whisker, channel] (N, N·m) of one sweep by its number: the shard."""
        return self

    def __getitem__(self, row: int) -> NDArray[np.float32]:
        return self.tree.wrenches([self.indices[row]])[0]

    def verify(self) -> None:
        """Compare every file with what it was when it was listed; a difference is a :class:`DataError`."""
        listed = self.tree.listed
        for name, digest in zip(listed.path[self.indices].tolist(), listed.digest[self.indices], strict=True):
            path = self.tree.folder / name
            if file_hash(path) != digest:
                raise DataError(f"{str(path)!r} changed since it was listed; start again.")

    def verify_once(self) -> None:
        """Do nothing: the list of files was made, and their hashes with it, for the files as they are now."""


def open_sweep_tree(folder: str | os.PathLike[str]) -> SweepTree:
    """List the sweeps of a folder and say once, in the log, what is wrong with them.

    Class names are those of ``categories.json`` ("category/object" → number) in the folder, or of the sweeps' shapes; a
    number without a name is ``class-N``.
    """
    root = Path(folder).absolute()
    paths = [path for name in FOLDERS for path in sorted((root / name).glob("*.npz"))]
    if not paths:
        present = [name for name in FOLDERS if (root / name).is_dir()]
        raise DataError(f"The folders {', '.join(present)} of {str(folder)!r} hold no sweeps (*.npz).")
    states = [(path.relative_to(root).as_posix(), path.stat()) for path in paths]
    return _open(root, tuple((name, state.st_size, state.st_mtime_ns) for name, state in states))


@functools.lru_cache(maxsize=2)
def _open(root: Path, stamps: tuple[tuple[str, int, int], ...]) -> SweepTree:
    every = _list(root, stamps)
    rates, first = np.unique(every.rate, return_index=True)
    if len(rates) > 1:
        mixed = " and ".join(f"{rate} Hz ({every.path[place]!s})" for rate, place in zip(rates, first, strict=True))
        raise DataError(f"{str(root)!r} mixes sweeps of {mixed}; put each set into a folder of its own.")
    labelled = np.flatnonzero(every.label >= 0)
    if not len(labelled):
        raise DataError(f"None of the {len(every.path)} sweeps of {str(root)!r} has a label; training needs classes.")
    listed = Listed._make(column[labelled] for column in every)
    split = np.array([FOLDERS[path.partition("/")[0]] for path in listed.path.tolist()])
    tree = SweepTree(root, listed, split, _classes(root, listed), len(every.path) - len(labelled))
    messages = [f"{count} values {FAULTS[name]}" for name, count in tree.faults.items() if count]
    messages += [f"{tree.left_out} sweeps have no label and are left out"] * (tree.left_out > 0)
    if messages:
        _LOG.warning("%s, %d sweeps: %s", root, len(split), "; ".join(messages))
    return tree


def _list(root: Path, stamps: Sequence[tuple[str, int, int]]) -> Listed:
    """List all files, part after part; a part that was listed before comes from the cache."""
    parts: list[Listed] = []
    with ThreadPoolExecutor(usable_processors()) as pool:
        for first in range(0, len(stamps), _TOGETHER):
            part = stamps[first : first + _TOGETHER]
            entry = cache_dir("sweep-files") / f"{content_hash(str(root), part, _VERSION, length=24)}.npz"
            stored = read_sealed(entry, "list of sweep files")
            if stored is not None:
                parts.append(Listed(**stored))
                continue
            rows = list(pool.map(functools.partial(_row, root), [path for path, _, _ in part]))
            parts.append(Listed._make(map(np.array, zip(*rows, strict=True))))
            write_sealed(entry, "list of sweep files", parts[-1]._asdict())
            _LOG.info("%d of %d sweep files are listed", first + len(part), len(stamps))
    return Listed._make(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _row(root: Path, path: str) -> tuple[Any, ...]:
    sweep = read_sweep(root / path)
    label = -1 if sweep.label is None else sweep.label
    faults = [int(where.sum()) for where in sweep.faulty().values()]
    return path, sweep.shape, label, sweep.rate, sweep.conditions, faults, file_hash(root / path)


def _classes(root: Path, listed: Listed) -> tuple[str, ...]:
    """Return the name of every number from 0 to the largest: its category, or its shape where that tells more."""
    path = root / "categories.json"
    numbers: dict[str, int] = read_json(path) if path.is_file() else {}
    if not isinstance(numbers, dict) or not all(isinstance(number, int) and number >= 0 for number in numbers.values()):
        raise DataError(f"{str(path)!r} must map 'category/object' to the number of the class.")
    shapes: defaultdict[int, set[str]] = defaultdict(set)
    for shape, number in [*numbers.items(), *zip(listed.shape.tolist(), listed.label.tolist(), strict=True)]:
        if numbers.get(shape, number) != number:
            raise DataError(f"{shape!r} has the label {number} in a sweep and {numbers[shape]} in {str(path)!r}.")
        shapes[number].add(shape)
    if max(shapes) >= MOST_CLASSES:
        raise DataError(f"A sweep of {str(root)!r} has the label {max(shapes)}; labels are 0 to {MOST_CLASSES - 1}.")
    owners = Counter(name for found in shapes.values() for name in {shape.partition("/")[0] for shape in found})
    names = []
    for number in range(max(shapes) + 1):
        categories = {shape.partition("/")[0] for shape in shapes[number]}
        choices = [*categories] if len(categories) == 1 else []
        choices = [name for name in choices if owners[name] == 1] + [*shapes[number]] * (len(shapes[number]) == 1)
        names.append(choices[0] if choices else f"class-{number}")
    return tuple(names)


def convert_sweeps(tree: SweepTree, out: str | os.PathLike[str], *, progress: Progress | None = None) -> dict[str, Any]:
    """Write a data set of sweeps, one shard in memory at a time, and return its manifest.

    A run that was killed goes on when it is started again, and ends with the same bytes.
    """
    labels: defaultdict[str, set[int]] = defaultdict(set)
    for name, label in zip(tree.listed.shape.tolist(), tree.listed.label.tolist(), strict=True):
        labels[name].add(label)
    for name, several in sorted(labels.items()):
        if len(several) > 1:
            raise DataError(f"The object {name!r} has the labels {sorted(several)}; an object has one label.")

    def run(missing: Sequence[PlannedShard], folder: Path, done: Callable[[int], None]) -> None:
        """Write the shards that are missing, one in memory at a time."""
        for shard in missing:
            done(write_shard(tree.content(shard), folder))

    objects, notes = tree.objects, tree.notes
    return write_data_set(tree.shards, objects, out, run, what="converting sweeps", notes=notes, progress=progress)


def _no_solid(name: str) -> Solid:
    raise DataError(f"Of the object {name!r} no more is known than its name.")
