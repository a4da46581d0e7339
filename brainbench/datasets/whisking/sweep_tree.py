"""Folders of the published study's sweeps, ``train/ validate/ test/`` with a file per sweep, read as a data set.

Every file is read once to list it, which finds what is damaged before any work and counts the known faults; the list
is kept in the cache. After that the forces are read from the files when a batch asks for them.
"""

from __future__ import annotations

import functools
import logging
import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from brainbench.core.contracts import CHANNELS
from brainbench.core.devices import usable_processors
from brainbench.core.errors import DataError
from brainbench.core.files import cache_dir, content_hash, file_hash, read_json
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.datasets.whisking.files import Shard
from brainbench.datasets.whisking.sweep_files import (
    CELLS,
    CONDITIONS,
    DOUBTFUL,
    FAULTS,
    FRAME_TIMES,
    FRAMES,
    read_sweep,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LOG = logging.getLogger(__name__)

FOLDERS = {"train": "train", "validate": "validation", "validation": "validation", "val": "validation", "test": "test"}
"""Split of each folder's sweeps."""
MOST_CLASSES = 10_000
_VERSION = 1
_TOGETHER = 2048
"""Files listed between two entries in the cache: what a killed run loses."""


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
    """The labelled sweeps of a folder, those of training first, in the order of their names."""

    folder: Path
    listed: Listed
    """Without the sweeps that have no label."""
    split: NDArray[np.str_]
    classes: tuple[str, ...]
    """Names by the number in the files."""
    left_out: int
    """Sweeps without a label."""

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

    @functools.cached_property
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
            "sweeps": len(self.split),
            "left_out": self.left_out,
            "faults": self.faults,
            "splits": {name: {"sweeps": sizes[name]} for name in dict.fromkeys(FOLDERS.values())},
            "shards": [{"name": name, "split": name, "sweeps": size} for name, size in sizes.items()],
        }

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


def is_sweep_tree(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder has folders for splits and is no data set of ours."""
    root = Path(folder)
    made = (root / "manifest.json").is_file() or (root / "config.json").is_file()
    return not made and any((root / name).is_dir() for name in FOLDERS)


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
    kept = np.flatnonzero(every.label >= 0)
    if not len(kept):
        raise DataError(f"None of the {len(every.path)} sweeps of {str(root)!r} has a label; training needs classes.")
    listed = Listed._make(column[kept] for column in every)
    split = np.array([FOLDERS[path.partition("/")[0]] for path in listed.path.tolist()])
    tree = SweepTree(root, listed, split, _classes(root, listed), len(every.path) - len(kept))
    told = [f"{count} values {FAULTS[name]}" for name, count in tree.faults.items() if count]
    told += [f"{tree.left_out} sweeps have no label and are left out"] * (tree.left_out > 0)
    if told:
        _LOG.warning("%s, %d sweeps: %s", root, len(split), "; ".join(told))
    return tree


def _list(root: Path, stamps: Sequence[tuple[str, int, int]]) -> Listed:
    """List all files, part after part; a part that was listed before comes from the cache."""
    parts: list[Listed] = []
    with ThreadPoolExecutor(usable_processors()) as pool:
        for first in range(0, len(stamps), _TOGETHER):
            part = stamps[first : first + _TOGETHER]
            kept = cache_dir("sweep-files") / f"{content_hash(str(root), part, _VERSION, length=24)}.npz"
            known = read_sealed(kept, "list of sweep files")
            if known is not None:
                parts.append(Listed(**known))
                continue
            rows = list(pool.map(functools.partial(_row, root), [path for path, _, _ in part]))
            parts.append(Listed._make(map(np.array, zip(*rows, strict=True))))
            write_sealed(kept, "list of sweep files", parts[-1]._asdict())
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
    known: dict[str, int] = read_json(path) if path.is_file() else {}
    if not isinstance(known, dict) or not all(isinstance(number, int) and number >= 0 for number in known.values()):
        raise DataError(f"{str(path)!r} must map 'category/object' to the number of the class.")
    shapes: defaultdict[int, set[str]] = defaultdict(set)
    for shape, number in [*known.items(), *zip(listed.shape.tolist(), listed.label.tolist(), strict=True)]:
        if known.get(shape, number) != number:
            raise DataError(f"{shape!r} has the label {number} in a sweep and {known[shape]} in {str(path)!r}.")
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
