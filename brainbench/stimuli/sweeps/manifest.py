"""The manifest of a data set: what was asked for, every shard with its hash, every object, and what went wrong."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.core.contracts import SWEEPS_FORMAT, SWEEPS_SCHEMA
from brainbench.core.errors import DataError
from brainbench.core.files import content_hash, provenance
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import readable
from brainbench.stimuli.sweeps.plan import Plan, PlannedShard
from brainbench.stimuli.sweeps.shards import COUNTS, OK, UNUSABLE
from brainbench.stimuli.sweeps.split import SPLITS

_LOG = logging.getLogger(__name__)
MANIFEST = "manifest.json"

_COUNTS = (*COUNTS, "unstable", "unusable")


def is_complete(path: Path, task: PlannedShard) -> bool:
    """Return whether the file of a shard is there and complete; a shard of another data set is a :class:`DataError`."""
    import h5py

    if not path.is_file():
        return False
    try:
        with readable(path, "shard"), h5py.File(path, "r") as file:
            owner = str(file.attrs["config_hash"])
            wrench: Any = file["wrench"]
            end = wrench.id.get_offset() + wrench.size * wrench.dtype.itemsize
            whole = wrench.shape[0] == len(task) and path.stat().st_size >= end
    except DataError:
        return False
    if owner != task.config_hash:
        raise DataError(f"{str(path)!r} belongs to another data set; choose an empty folder, or remove what is there.")
    return whole


def make_manifest(plan: Plan, folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Put together the manifest of a finished data set from what its shards say.

    Equal data sets have equal manifests on one machine: there is no time in it.
    """
    objects: dict[str, dict[str, Any]] = {
        name: {"label": item.label, "source": item.source, "hash": None, "sweeps": {}, "untouched": True}
        for name, item in plan.objects.items()
    }
    shards = [_read(Path(folder) / task.name, task, objects) for task in plan.shards]
    for name, entry in objects.items():
        if not entry["untouched"]:
            del entry["untouched"]
            continue
        _LOG.warning(
            "%s: no whisker touches this object in any of its %d sweeps; heights of sweeps are those of its origin, so "
            "move the mesh until its origin is in its middle.", name, sum(entry["sweeps"].values()),
        )  # fmt: skip
    totals = {name: sum(shard[name] for shard in shards) for name in _COUNTS}
    about = provenance()
    del about["time"]
    return {
        "format": SWEEPS_FORMAT, "schema": SWEEPS_SCHEMA,
        "content_hash": content_hash([[shard["name"], shard["content_hash"]] for shard in shards]),
        "config_hash": plan.config_hash, "config": plan.config, "provenance": about, "classes": list(plan.classes),
        "sweeps": plan.sweeps, **totals, **plan.notes,
        "splits": {split: _summary(item for item in shards if item["split"] == split) for split in SPLITS},
        "shards": shards, "objects": objects,
    }  # fmt: skip


def _read(path: Path, task: PlannedShard, objects: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return what the manifest says of a shard, and add what the shard says to its ``objects``."""
    with open_hdf5(path, "shard", "Run the same command again.") as opened:
        file: Any = opened
        # Shards of data sets that were begun before steps were counted as unsolved do not tell.
        counts = {name: int(file.attrs.get(name, 0) if name == "unsolved" else file.attrs[name]) for name in _COUNTS}
        digest = str(file.attrs["content_hash"])
        hashes = [value.decode() for value in file["object_hash"][:]]
        owner, status, reasons = file["owner"][:], file["status"][:], file["reason"][:]
        # Sweeps that failed, and converted ones whose contacts are NaN, are not known to be untouched.
        touched = ((file["contact"][:] != 0) | (status != OK)).any(axis=1)
    for index, body in enumerate(task.objects):
        mine, entry = np.flatnonzero(owner == index), objects[body.name]
        if entry["hash"] not in (None, hashes[index]):
            raise DataError(
                f"The object {body.name!r} was not built alike in all shards (hashes {entry['hash']} and "
                f"{hashes[index]}): its file changed meanwhile, or machines differ; generate the data set again in an "
                "empty folder."
            )
        entry["hash"] = hashes[index]
        entry["sweeps"][task.split] = entry["sweeps"].get(task.split, 0) + len(mine)
        entry["untouched"] &= not touched[mine].any()
        broken = mine[(status[mine] == UNUSABLE).any(axis=1)]
        if len(broken) and (reason := reasons[broken[0]].decode()):
            entry["unusable"] = reason
    about = {"name": task.name, "split": task.split, "sweeps": len(task), "bytes": path.stat().st_size}
    return {**about, "content_hash": digest, **counts}


def _summary(shards: Iterable[dict[str, Any]]) -> dict[str, int]:
    chosen = list(shards)
    counted = {name: sum(shard[name] for shard in chosen) for name in ("sweeps", "bytes", "unstable", "unusable")}
    return {"shards": len(chosen), **counted}
