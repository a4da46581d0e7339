"""The files of a data set of sweeps, as ``docs/datasets.md`` describes them, and the memory that they are read into."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, SWEEPS_FORMAT, SWEEPS_SCHEMA
from brainbench.core.errors import DataError, DataFileNotFoundError, shown
from brainbench.core.files import cache_dir, content_hash, hash_arrays, read_json, write_text
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.ranges import check_number
from brainbench.core.reading.regular import readable

if TYPE_CHECKING:
    from numpy.typing import NDArray

FOLDERS = {"train": "train", "validate": "validation", "validation": "validation", "val": "validation", "test": "test"}
"""Folders of the published study's sweeps → split."""
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
            found = hash_arrays({**arrays, "wrench": self.forces()})
        if found != self.content_hash:
            raise DataError(f"{str(self.path)!r} does not match its hash: it was damaged or edited. {_AGAIN}")

    def verify_once(self) -> None:
        """Verify, unless the file was found whole before and did not change since; the cache remembers it."""
        state = self.path.stat()
        stamps = [state.st_size, state.st_mtime_ns, state.st_ctime_ns, state.st_ino]
        mark = cache_dir("verified") / content_hash([str(self.path.absolute()), stamps, self.content_hash], length=24)
        if not mark.exists():
            self.verify()
            write_text(mark, "")


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
    found = (manifest.get("format"), manifest.get("schema")) if isinstance(manifest, dict) else (None, None)
    if found != (SWEEPS_FORMAT, SWEEPS_SCHEMA):
        raise DataError(
            f"{str(path)!r} has format {found[0]!r} version {found[1]!r}; this brainbench reads {SWEEPS_FORMAT!r} "
            f"version {SWEEPS_SCHEMA}: generate the data again or use the version that wrote it."
        )
    with readable(path, "manifest of a data set", _AGAIN):
        for name, kind in (("classes", list), ("splits", dict), ("shards", list), ("config_hash", str)):
            if not isinstance(manifest[name], kind):
                raise DataError(f"{name!r} in {str(path)!r} is no {kind.__name__}; received {shown(manifest[name])}.")
        for entry in (*manifest["splits"].values(), *manifest["shards"]):
            check_number(f"'sweeps' in {str(path)!r}", entry["sweeps"], least=0, whole=True)
        for entry in manifest["shards"]:
            # A name with a folder in it could lead out of the data set.
            plain = Path(entry["name"]).name == entry["name"] and isinstance(entry["content_hash"], str)
            if not plain or entry["split"] not in manifest["splits"]:
                raise DataError(f"{str(path)!r} has a shard without a plain name, a split and a hash: {shown(entry)}.")
    return manifest


def open_shard(path: Path, entry: Mapping[str, Any], manifest: Mapping[str, Any]) -> Shard:
    """Read what stands beside the forces of a shard that the manifest names."""
    if not path.is_file():
        raise DataFileNotFoundError(f"The shard {str(path)!r} of the manifest is missing. {_AGAIN}")
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
            made = np.empty(shape, np.float32)
            self._held = [*self._held[1 - self._most :], made]
            return made

    def _references(self, index: int) -> int:
        return sys.getrefcount(self._held[index])


def most_open() -> int:
    """Return how many shards may be mapped at a time: each takes one of the files that a process may open."""
    try:
        import resource
    except ImportError:
        return 512
    return max(16, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
