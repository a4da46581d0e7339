"""Read data sets of whisker sweeps for training: memory-mapped shards, shuffled batches, exact resume.

The files are those of ``brainbench stimuli sweep --out``, whose layout is described in ``docs/datasets.md``, or the
sweep folders of the published study, which an optional room opens. Letters: B batch, T time step,
S sub-step, C channel, W whisker, H×W whisker grid, N sweep.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import KW_ONLY, dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, SUB_STEP_SECONDS, SUB_STEPS, SWEEPS_FORMAT, SWEEPS_SCHEMA
from brainbench.core.errors import (
    DataError,
    DataFileNotFoundError,
    UsageError,
    brief,
    check_kind,
    check_name,
    check_number,
    listing,
)
from brainbench.core.files import cache_dir, content_hash, hash_arrays, read_json
from brainbench.core.lazy import lazy_module
from brainbench.core.limits import Count, Seed, limited
from brainbench.core.plugins import load_optional
from brainbench.core.progress import Progress, track
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import readable
from brainbench.core.reading.sealed import is_sealed, keep_entry, read_sealed, write_sealed

if TYPE_CHECKING:
    import torch
    from numpy.typing import NDArray
else:
    torch = lazy_module("torch")

FOLDERS = {"train": "train", "validate": "validation", "validation": "validation", "val": "validation", "test": "test"}
"""Folders of the published study's sweeps → split."""
_STATISTICS = 1  # raised whenever the same sweeps would get other statistics
_UNUSABLE = 2
_AGAIN = "Remove it and give the command that made the data set again."


@dataclass(frozen=True, eq=False)
class Shard:
    """One shard: the place of its forces, and what they belong to."""

    path: Path
    offset: int
    """Place in the file where the forces begin [bytes]."""
    sweeps: int
    shape: tuple[int, int, int]
    """(frames, whiskers, channels) of one sweep."""
    cells: NDArray[np.int64]
    """[whisker] flat index row·7 + col in the grid."""
    labels: NDArray[np.int32]
    objects: NDArray[np.str_]
    indices: NDArray[np.int64]
    broken: NDArray[np.bool_]
    """[sweep] true where any whisker is not ok."""
    empty: NDArray[np.bool_]
    """[sweep] true where there are no forces at all."""
    content_hash: str
    """As the manifest has it."""
    interval: float
    """Time between frames [s]."""
    axes: str
    """``world`` or ``follicle``."""

    def forces(self) -> NDArray[np.float32]:
        """Return the forces [sweep, frame, whisker, channel] (N, N·m), mapped into memory."""
        shape = (self.sweeps, *self.shape)
        return np.memmap(self.path, "<f4", "r", self.offset, shape).view(np.ndarray)

    def verify(self) -> None:
        """Compare what the shard holds with the hash in the manifest; a difference is a :class:`DataError`."""
        with open_hdf5(self.path, "shard", _AGAIN) as opened:
            file: Any = opened
            arrays = {name: file[name][()] for name in file if name != "wrench"}
            actual_hash = hash_arrays({**arrays, "wrench": self.forces()})
        if actual_hash != self.content_hash:
            raise DataError(f"{str(self.path)!r} does not match its hash: it was damaged or edited. {_AGAIN}")

    def verify_once(self) -> None:
        """Verify, unless the file was found whole before and did not change since; the cache remembers it."""
        state = self.path.stat()
        stamps = [state.st_size, state.st_mtime_ns, state.st_ctime_ns, state.st_ino]
        mark = cache_dir("verified") / content_hash([str(self.path.absolute()), stamps, self.content_hash], length=24)
        if not is_sealed(mark):
            self.verify()
            keep_entry(mark, "mark of a whole shard", Path.touch)


def is_sweep_tree(folder: Path) -> bool:
    """Return whether a folder has the published study's folders for splits and is no data set of ours."""
    ours = any((folder / name).is_file() for name in ("manifest.json", "config.json"))
    return not ours and any((folder / name).is_dir() for name in FOLDERS)


def read_manifest(folder: Path) -> Mapping[str, Any]:
    """Read the manifest of a finished data set."""
    path = folder / "manifest.json"
    if not path.is_file():
        if (folder / "config.json").is_file():
            raise DataError(f"The data set in {str(folder)!r} is not finished: give its command again; it goes on.")
        raise DataFileNotFoundError(
            f"There is no data set of sweeps in {str(folder)!r} (no manifest.json, and no folders train, validate and "
            "test with published sweeps); make one with: brainbench stimuli sweep thesis-low --objects "
            "procedural-24:10 --out FOLDER."
        )
    manifest = read_json(path)
    version = (manifest.get("format"), manifest.get("schema")) if isinstance(manifest, dict) else (None, None)
    if version != (SWEEPS_FORMAT, SWEEPS_SCHEMA):
        raise DataError(
            f"{str(path)!r} has format {version[0]!r} version {version[1]!r}; this brainbench reads {SWEEPS_FORMAT!r} "
            f"version {SWEEPS_SCHEMA}: generate the data again or use the version that wrote it."
        )
    with readable(path, "manifest of a data set", _AGAIN):
        for name, kind in (("classes", list), ("splits", dict), ("shards", list), ("config_hash", str)):
            if not isinstance(manifest[name], kind):
                raise DataError(f"{name!r} in {str(path)!r} is no {kind.__name__}; received {brief(manifest[name])}.")
        for entry in (*manifest["splits"].values(), *manifest["shards"]):
            check_number(f"'sweeps' in {str(path)!r}", entry["sweeps"], least=0, whole=True)
        for name, entry in manifest.get("objects", {}).items():
            check_kind(f"hash of the object {brief(name)}", entry["hash"], str, "a text")
        for entry in manifest["shards"]:
            # A name with a folder in it could lead out of the data set.
            plain = Path(entry["name"]).name == entry["name"] and isinstance(entry["content_hash"], str)
            if not plain or entry["split"] not in manifest["splits"]:
                raise DataError(f"{str(path)!r} has a shard without a plain name, a split and a hash: {brief(entry)}.")
    return manifest


def open_shard(path: Path, entry: Mapping[str, Any], manifest: Mapping[str, Any]) -> Shard:
    """Read what stands beside the forces of a shard that the manifest names."""
    with open_hdf5(path, "shard", _AGAIN) as opened:
        file: Any = opened
        wrench = file["wrench"]
        sweeps, *rest = wrench.shape
        offset = wrench.id.get_offset()
        end = offset + wrench.size * 4
        channels = tuple(file["channel"].asstr()[:])
        names = file["object"].asstr()[:].astype(str)
        status = file["status"][:]
        shard = Shard(
            path=path,
            offset=offset,
            sweeps=sweeps,
            shape=(rest[0], rest[1], rest[2]),
            cells=file["row"][:].astype(np.int64) * GRID_SHAPE[1] + file["col"][:],
            labels=file["label"][:],
            objects=names[file["owner"][:]],
            indices=file["sweep"][:],
            broken=(status != 0).any(axis=1),
            empty=(status == _UNUSABLE).all(axis=1),
            content_hash=str(entry["content_hash"]),
            interval=float(np.diff(file["time"][:2]).sum()),
            axes=str(file.attrs.get("axes", "world")),
        )
        config = str(file.attrs["config_hash"])
    if path.stat().st_size < end:
        raise DataError(f"The shard {str(path)!r} is damaged: it ends before its last force. {_AGAIN}")
    if config != manifest["config_hash"] or sweeps != entry["sweeps"] or channels != CHANNELS:
        raise DataError(f"The shard {str(path)!r} does not belong to the manifest beside it. {_AGAIN}")
    return shard


class Buffers:
    """Memory for batches, used again once nobody holds it: fresh memory is slower than copying into it."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._held: list[NDArray[np.float32]] = [np.empty(0, np.float32)]
        self._lock = threading.Lock()
        # Every tensor or view on an array holds a reference more than this.
        self._free = self._references(0)

    def __len__(self) -> int:
        return len(self._held)

    def take(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return an array of ``shape`` with any content that no tensor or view refers to."""
        with self._lock:
            for index in range(len(self._held)):
                if self._held[index].shape == shape and self._references(index) == self._free:
                    return self._held[index]
            buffer = np.empty(shape, np.float32)
            self._held = [*self._held[1 - self._most :], buffer]
            return buffer

    def _references(self, index: int) -> int:
        return sys.getrefcount(self._held[index])


def most_open() -> int:
    """Return how many shards may be mapped at a time: each takes one of the files that a process may open."""
    try:
        import resource
    except ImportError:
        return 512
    return max(16, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)


SPLITS = ("train", "validation", "test", "all")  # values of `split`; `all` is the three together
SWEEP_READERS = "brainbench.sweeps"  # entry points that open sweeps of others; the published study's are `published`

_AHEAD = 2
_BLOCK = 64


class Batch(NamedTuple):
    """Some sweeps, on the device."""

    input: torch.Tensor
    """[B, T, S·C, H, W], or [B, frame, W, C] as stored; float32, N and N·m."""
    label: torch.Tensor
    """[B] int64 index into the classes."""


@dataclass(frozen=True)
class ChannelStatistics:
    """Statistics of the six channels for a normaliser (Fx … Mz; N and N·m), over all whiskers and frames."""

    mean: tuple[float, ...]
    std: tuple[float, ...]
    """Standard deviation; whiskers that touch nothing count as zeros."""
    largest: tuple[float, ...]
    """Largest magnitude."""
    values: int
    """Numbers per channel that were read."""


@limited(names={"unstable": "treatment of unstable sweeps"}, unresolved=("device",), frozen=False, eq=False, repr=False)
class WhiskingDataset:
    """Batches of sweeps of one split, in an order drawn anew in every epoch.

    Iterating runs through one epoch from where the last iteration stopped; the state can be saved between any two
    batches and loaded again: then the same batches follow.

    >>> data = WhiskingDataset("sweeps", split="train", batch_size=256, device="cuda")  # doctest: +SKIP
    >>> for x, y in data: ...  # doctest: +SKIP
    """

    folder: str | os.PathLike[str]
    """Where ``brainbench stimuli sweep`` wrote, or a folder of published sweeps."""
    _: KW_ONLY
    split: str = "train"
    """One of :data:`SPLITS`."""
    batch_size: Count = 256
    """B."""
    view: Literal["grid", "raw"] = "grid"
    """``grid`` gives [B, T, S·C, H, W] as ``to_grid`` of a stimulus set does; ``raw`` [B, frame, W, C]."""
    substeps: Count = 5
    """Frames S that make one time step of the grid."""
    shuffle: bool = True
    """Draw the order from seed and epoch; in the order of the files when False."""
    seed: Seed = 0
    """Of the order."""
    device: str | torch.device = "cpu"
    """Where batches go, in the words of torch."""
    unstable: Literal["skip", "zero", "error"] = "skip"
    """Sweeps with a whisker whose simulation failed are left out (``skip``), their missing numbers read as zero
    (``zero``), or refused (``error``). Sweeps without any forces are always left out."""
    drop_last: bool = False
    """Leave out the last batch of an epoch when it is smaller."""
    part: tuple[int, int] = (0, 1)
    """(rank, number of processes): each process reads another part of every epoch, all equally many batches."""

    def __post_init__(self) -> None:
        """Open the shards of the split."""
        split, view, substeps, part = self.split, self.view, self.substeps, self.part
        check_name("split", split, SPLITS)
        if not 0 <= part[0] < part[1]:
            raise UsageError(f"A part is (rank, number) with 0 ≤ rank < number; received {part!r}.")
        self.folder = folder = Path(self.folder)
        read = load_optional(SWEEP_READERS, "published", "reader of sweeps") if is_sweep_tree(folder) else None
        tree = None if read is None else read(folder)
        self.manifest: Mapping[str, Any] = read_manifest(folder) if tree is None else tree.manifest()
        self.classes = tuple(str(name) for name in self.manifest["classes"])
        entries = [item for item in self.manifest["shards"] if split in ("all", item["split"])]
        self._splits = np.array([item["split"] for item in entries])
        if tree is None:
            self._shards = [open_shard(folder / item["name"], item, self.manifest) for item in entries]
        else:
            self._shards = [tree.open_shard(item["split"]) for item in entries]
        self._choose()
        self._buffers = Buffers(2 * (_AHEAD + 2))
        self._forces = lru_cache(most_open())(lambda index: self._shards[index].forces())
        self.epoch = 0
        """Number of the epoch that the next batch belongs to, from 0."""
        self._batch = 0
        frames, cells = self._shards[0].shape[0], self._shards[0].cells
        if view == "grid" and frames % substeps:
            raise UsageError(f"{frames} frames do not divide into time steps of {substeps} sub-steps.")
        if view == "grid" and len(np.unique(cells)) < len(cells):
            raise UsageError("The data set has two whiskers in one cell of the grid; read it with view='raw'.")
        if not len(self):
            raise UsageError(
                f"The {self.sweeps} sweeps of the split {split!r} make no batch of {self.batch_size} for each of "
                f"{part[1]} processes; choose a smaller batch, or keep the last one."
            )

    def _choose(self) -> None:
        """List the sweeps that can be used."""
        if not self._shards:
            have = listing(name for name, item in self.manifest["splits"].items() if item["sweeps"])
            raise DataError(f"The split {self.split!r} of {str(self.folder)!r} has no sweeps; it has {have}.")
        bad = [shard.broken for shard in self._shards]
        if self.unstable == "error" and any(broken.any() for broken in bad):
            count = sum(int(broken.sum()) for broken in bad)
            raise DataError(
                f"{count} sweeps of {str(self.folder)!r} have unstable whiskers (status in the shards says which): "
                "leave them out with unstable='skip', or simulate with a finer fidelity."
            )
        left_out = [shard.empty | shard.broken if self.unstable == "skip" else shard.empty for shard in self._shards]
        usable = [np.flatnonzero(~rows) for rows in left_out]
        self._where = np.concatenate([np.full(len(rows), i) for i, rows in enumerate(usable)])
        self._row = np.concatenate(usable)
        self.skipped = sum(shard.sweeps for shard in self._shards) - len(self._row)
        """Sweeps of the split that are left out because they are unstable."""
        if not len(self._row):
            raise DataError(f"All sweeps of the split {self.split!r} of {str(self.folder)!r} are unstable.")

    @property
    def sweeps(self) -> int:
        """Number N of sweeps that can be used."""
        return len(self._row)

    @cached_property
    def labels(self) -> NDArray[np.int64]:
        """[N] class of each sweep, an index into :attr:`classes`."""
        return self._gathered([shard.labels for shard in self._shards]).astype(np.int64)

    @cached_property
    def objects(self) -> NDArray[np.str_]:
        """[N] name of the object of each sweep."""
        return self._gathered([shard.objects for shard in self._shards])

    @cached_property
    def indices(self) -> NDArray[np.int64]:
        """[N] number of each sweep in the whole grid of sweeps and objects."""
        return self._gathered([shard.indices for shard in self._shards])

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells of the grid, row · 7 + column, that hold a whisker, ascending."""
        return tuple(np.unique(self._shards[0].cells).tolist())

    @property
    def axes(self) -> str:
        """Axes of forces and moments, ``world`` or ``follicle``."""
        return self._shards[0].axes

    @property
    def summary(self) -> dict[str, Any]:
        """Hash, number of classes, and the sweeps of each split that are used and in all left out: for a card.

        Time steps [s] and axes are told where they are unusual, and how many test sweeps are of objects trained on.
        """
        step, default_step = self.substeps * self._shards[0].interval, SUB_STEPS * SUB_STEP_SECONDS
        unusual: dict[str, Any] = {} if np.isclose(step, default_step, rtol=1e-6) else {"time_step": step}
        if self.axes != "world":
            unusual["axes"] = self.axes
        used = self._splits[self._where]
        sizes = {name: int((used == name).sum()) for name in SPLITS[:3]}
        hashes = {name: entry["hash"] for name, entry in self.manifest.get("objects", {}).items()}
        shapes = np.array([hashes.get(name, name) for name in self.objects.tolist()])
        if repeated := int(np.isin(shapes[used == "test"], shapes[used == "train"]).sum()):
            unusual["test_of_trained_objects"] = repeated
        about = {"hash": self.manifest["content_hash"], "classes": len(self.classes), "left_out": self.skipped}
        return {**about, **sizes, **unusual}

    def __len__(self) -> int:
        """Count the batches of an epoch."""
        each = self.sweeps // self.part[1]
        return each // self.batch_size if self.drop_last else -(-each // self.batch_size)

    def __repr__(self) -> str:
        return (
            f"WhiskingDataset({str(self.folder)!r}, {self.split}: {self.sweeps} sweeps of {len(self.classes)} classes, "
            f"{len(self)} batches of {self.batch_size}; {self.skipped} unstable sweeps left out)"
        )

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches of the epoch that are still to come."""
        if self._batch >= len(self):  # a state saved after the last batch of an epoch
            self.epoch, self._batch = self.epoch + 1, 0
        order, first = self.order(self.epoch), self._batch
        parts = [order[i * self.batch_size : (i + 1) * self.batch_size] for i in range(first, len(self))]
        coming: deque[Any] = deque()
        # One thread makes batches while the caller computes; copies release the interpreter.
        with ThreadPoolExecutor(1) as pool:
            try:
                for part in (*parts, *[None] * _AHEAD):
                    if part is not None:
                        coming.append(pool.submit(self.batch, part))
                    if len(coming) > (_AHEAD if part is not None else 0):
                        ready = coming.popleft().result()
                        self._batch += 1
                        yield ready
            finally:
                for future in coming:
                    future.cancel()
        self.epoch, self._batch = self.epoch + 1, 0

    def order(self, epoch: int) -> NDArray[np.int64]:
        """Return the sweeps [n] of this part of an epoch, numbers from 0 to N − 1, in their order."""
        count = self.sweeps
        every = np.random.default_rng([self.seed, epoch]).permutation(count) if self.shuffle else np.arange(count)
        rank, parts = self.part
        return every[: count // parts * parts][rank::parts]

    def batch(self, sweeps: Sequence[int] | NDArray[np.integer]) -> Batch:
        """Return chosen sweeps, numbers from 0 to N − 1, as a batch on the device."""
        sweeps = np.asarray(sweeps)
        device = torch.device(self.device)
        shape = (len(sweeps), *self._shards[0].shape)
        if device.type == "cuda":
            raw = torch.empty(shape, dtype=torch.float32, pin_memory=True)
        else:
            raw = torch.from_numpy(self._buffers.take(shape))
        self.read(sweeps, out=raw.numpy())
        label = torch.from_numpy(self.labels[sweeps]).to(device)
        moved = raw.to(device, non_blocking=True)
        return Batch(self._to_grid(moved) if self.view == "grid" else moved, label)

    def read(
        self, sweeps: Sequence[int] | NDArray[np.integer], *, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Return the forces of sweeps, numbers from 0 to N − 1, in ``out`` if given: [n, frame, W, C] (N, N·m)."""
        sweeps = np.asarray(sweeps)
        result = np.empty((len(sweeps), *self._shards[0].shape), np.float32) if out is None else out
        places = zip(self._where[sweeps].tolist(), self._row[sweeps].tolist(), strict=True)
        for place, (shard, row) in enumerate(places):
            np.copyto(result[place], self._forces(shard)[row])
        if self.unstable == "zero":
            np.nan_to_num(result, copy=False, nan=0.0)
        return result

    def state_dict(self) -> dict[str, Any]:
        """Return where the iteration stands, for :meth:`load_state_dict`; plain values."""
        return {**self._identity(), "epoch": self.epoch, "batch": self._batch}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where another data set of the same files and options stood."""
        mine = self._identity()
        different = [key for key, value in mine.items() if state.get(key) != value]
        if different:
            differences = ", ".join(f"{key} {state.get(key)!r} (here {mine[key]!r})" for key in different)
            raise UsageError(f"The saved state belongs to other batches: {differences}.")
        self.epoch, self._batch = int(state["epoch"]), int(state["batch"])

    def verify(self, *, again: bool = True, progress: Progress | None = None) -> None:
        """Read every byte of the split and compare hashes.

        Shards that were found whole before and did not change since are read only ``again``.
        """
        for shard in track(self._shards, "shards verified", progress):
            (shard.verify if again else shard.verify_once)()

    def statistics(self) -> ChannelStatistics:
        """Return mean, spread and largest value of each channel over the sweeps of the split.

        All of them are read once; the result is kept in the cache.
        """
        key = content_hash([_STATISTICS, self.manifest["content_hash"], self.split, self.unstable], length=24)
        path = cache_dir("whisking") / f"{key}.npz"
        if (cached := read_sealed(path, "statistics of channels")) is not None:
            mean, std, largest = (tuple(cached[name].tolist()) for name in ("mean", "std", "largest"))
            return ChannelStatistics(mean, std, largest, int(cached["values"]))
        channels = len(CHANNELS)
        total, squares, largest, values = np.zeros(channels), np.zeros(channels), np.zeros(channels), 0
        for first in range(0, self.sweeps, _BLOCK):
            block = self.read(np.arange(first, min(first + _BLOCK, self.sweeps))).reshape(-1, channels).astype(float)
            total += block.sum(axis=0)
            squares += np.einsum("ij,ij->j", block, block)
            largest = np.maximum(largest, np.abs(block).max(axis=0))
            values += len(block)
        mean = total / values
        std = np.sqrt(np.maximum(squares / values - mean**2, 0.0))
        statistics = ChannelStatistics(tuple(mean.tolist()), tuple(std.tolist()), tuple(largest.tolist()), values)
        write_sealed(path, "statistics of channels", vars(statistics))
        return statistics

    def _identity(self) -> dict[str, Any]:
        options = ("split", "unstable", "seed", "shuffle", "batch_size", "drop_last")
        choices = {name: getattr(self, name) for name in options}
        return {"content_hash": self.manifest["content_hash"], **choices, "part": list(self.part)}

    def _gathered(self, columns: list[NDArray[Any]]) -> NDArray[Any]:
        """Put per-shard columns together for the sweeps that can be used."""
        starts = np.cumsum([0, *(len(column) for column in columns)])
        return np.concatenate(columns)[starts[self._where] + self._row]

    @cached_property
    def _columns(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Places of the numbers of a frame's grid [C·H·W] in the frame [W·C], and the cells without a whisker."""
        cells, size = self._shards[0].cells, GRID_SHAPE[0] * GRID_SHAPE[1]
        source = np.zeros((len(CHANNELS), size), dtype=np.int64)
        source[:, cells] = np.arange(len(cells)) * len(CHANNELS) + np.arange(len(CHANNELS))[:, None]
        empty = np.setdiff1d(np.arange(size), cells)
        return torch.from_numpy(source.reshape(-1)).to(self.device), torch.from_numpy(empty).to(self.device)

    def _to_grid(self, raw: torch.Tensor) -> torch.Tensor:
        """Return [B, T, S·C, H, W] of [B, frame, W, C]: sub-step major, cells without a whisker zero."""
        source, empty = self._columns
        count, frames = raw.shape[:2]
        rows = raw.view(count * frames, -1)
        if raw.device.type == "cpu":
            grid = torch.from_numpy(self._buffers.take((len(rows), len(source))))
            torch.index_select(rows, 1, source, out=grid)
        else:
            grid = rows.index_select(1, source)
        grid.view(-1, GRID_SHAPE[0] * GRID_SHAPE[1]).index_fill_(1, empty, 0.0)
        return grid.view(count, frames // self.substeps, self.substeps * len(CHANNELS), *GRID_SHAPE)
