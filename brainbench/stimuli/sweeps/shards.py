"""One shard: build its objects, simulate its sweeps, write its file. The layout is described in ``docs/datasets.md``.

The bytes of a shard depend on what was asked for alone: no time, no machine and no version of a library is in it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS, SWEEPS_FORMAT, SWEEPS_SCHEMA
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import atomic_path, content_hash, create_hdf5, hash_arrays, to_json
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.engines.protocol import SweepBatch, WhiskerEngine, describe_unstable, join_batches
from brainbench.stimuli.explain import Explanation
from brainbench.stimuli.objects.collections import NamedObject
from brainbench.stimuli.objects.solid import Solid
from brainbench.stimuli.simulation import simulate_uncached
from brainbench.stimuli.sweeps.plan import GenerationSettings, PlannedShard, ShardTask
from brainbench.stimuli.sweeps.sweep_scenes import Sweep, SweepGrid, SweepScenes
from brainbench.stimuli.whiskers.array import WhiskerArray

_TOGETHER = 16  # sweeps whose scenes exist at the same time: bounds the memory of a batch


def simulate_sweeps(
    scenes: SweepScenes,
    indices: Sequence[int],
    *,
    fidelity: Fidelity,
    backend: str = DEFAULT_ENGINE,
    device: str = "cpu",
    workers: int | None = None,
    retry: int = 1,
    packed: Mapping[str, Any] | None = None,
    estimated: NDArray[np.bool_] | None = None,
) -> SweepBatch:
    """Simulate the sweeps of some indices, many at once where the engine can (:attr:`WhiskerEngine.batches`).

    Ordered by object they are fastest. Options are those of :meth:`WhiskerEngine.run_sweeps` and
    :func:`brainbench.stimuli.engines.get_engine`.
    """
    engine = get_engine(backend, device=device, retry=retry)
    if takes_sweeps(engine, scenes.grid):
        return engine.run_sweeps(scenes, indices, fidelity, workers=workers, packed=packed, estimated=estimated)
    mask = np.zeros(len(indices), dtype=bool) if estimated is None else estimated
    order, batches = np.argsort(~mask, kind="stable"), []
    for errors in (True, False):
        engine = get_engine(backend, device=device, retry=retry, errors=errors)
        some = order[mask[order] == errors].tolist()
        for first in range(0, len(some), _TOGETHER):
            part = [indices[place] for place in some[first : first + _TOGETHER]]
            batches.append(_one_by_one(scenes, part, fidelity, engine, workers))
    return join_batches(batches).ordered(np.argsort(order))


def takes_sweeps(engine: WhiskerEngine, grid: SweepGrid) -> bool:
    """Return whether an engine simulates many sweeps of a grid at once."""
    return engine.batches and grid.mover == "object"


def _one_by_one(
    scenes: SweepScenes, indices: Sequence[int], fidelity: Fidelity, engine: WhiskerEngine, workers: int | None
) -> SweepBatch:
    """Simulate sweeps as any other scenes."""
    dataset = simulate_uncached([scenes[index] for index in indices], fidelity, engine, workers=workers)
    unstable = dataset["status"].values != "ok"
    explanation = Explanation.of(dataset)
    names = [str(name) for name in dataset["whisker"].values]
    return SweepBatch(
        wrench=dataset["wrench"].values,
        contact=dataset["contact"].values.mean(axis=1).astype(np.float32),
        unstable=unstable,
        reasons=describe_unstable(names, unstable, dataset["reason"].values),
        steps=explanation.steps,
        steps_in_full=explanation.steps_in_full,
        unsolved=explanation.unsolved,
        error=dataset["error"].values,
    )


OK, UNSTABLE, UNUSABLE = 0, 1, 2  # values of `status`: fine; the simulation failed; the object could not be built

ALIGNMENT = 4096  # the forces begin at a multiple of this, so that pages of memory and of the file coincide

COUNTS: tuple[str, ...] = ("steps", "steps_in_full", "retried", "unsolved")
"""Attributes that say how much was simulated, and in how many steps contact forces were not solved."""
_CONDITIONS = tuple(item.name for item in fields(Sweep))


@dataclass(frozen=True, eq=False)
class ShardContent:
    """Content of a shard's file."""

    task: PlannedShard
    arrays: Mapping[str, NDArray[Any]]
    """By name, in the order of the file; ``wrench`` is last."""
    attributes: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class BuiltObject:
    """An object of a shard; made by another process while the GPU works."""

    solid: Solid | None
    """None when it cannot be used."""
    reason: str = ""
    """Reason for which it cannot be used."""
    hash: str = ""
    packed: Any = None
    """Result of :meth:`WhiskerEngine.pack`; None when the engine takes no sweeps."""


def make_shard(task: ShardTask, folder: str, workers: int | None = None) -> int:
    """Build, simulate and write one shard with ``workers`` threads; return the number of its sweeps."""
    return write_shard(simulate_shard(task, workers=workers), folder)


def build_object(source: NamedObject, settings: GenerationSettings, grid: SweepGrid) -> BuiltObject:
    """Build one object of a data set, as its engine takes it."""
    try:
        solid = source.load()
    except (DataError, UsageError) as error:
        return BuiltObject(None, str(error) or type(error).__name__)
    engine = get_engine(settings.backend, device=settings.device)
    packed = engine.pack(solid) if takes_sweeps(engine, grid) else None
    return BuiltObject(solid, "", _hash_solid(solid), packed)


def warm_up(task: ShardTask) -> None:
    """Do what the first shard would wait for beside its objects, such as loading kernels."""
    settings, objects = task.settings, {item.name: item.load for item in task.objects}
    engine = get_engine(settings.backend, device=settings.device)
    if takes_sweeps(engine, task.grid):
        engine.prepare_sweeps(SweepScenes(task.grid, objects, whiskers=task.whiskers), settings.fidelity)


def simulate_shard(task: ShardTask, objects: Sequence[BuiltObject] = (), workers: int | None = None) -> ShardContent:
    """Simulate the sweeps of a shard past its objects, which are built unless they are given."""
    built = objects or [build_object(item, task.settings, task.grid) for item in task.objects]
    count, frames = task.grid.count, task.grid.frames
    array = WhiskerArray.of(task.grid.species).select(task.whiskers)
    whiskers = len(array)
    usable = {owner: one for owner, one in enumerate(built) if one.solid is not None}
    place = {owner: rank for rank, owner in enumerate(usable)}
    chosen = np.flatnonzero(np.isin(task.owner, list(place)))
    shape = (len(task), frames.count, whiskers, 6)
    contact = np.zeros((len(task), whiskers), dtype=np.float32)
    status = np.full((len(task), whiskers), UNUSABLE, dtype=np.uint8)
    error = np.full(contact.shape, np.nan, dtype=np.float32)
    reasons = [built[owner].reason for owner in task.owner.tolist()]
    counts: dict[str, int] = dict.fromkeys(COUNTS, 0)
    wrench = np.empty((0, *shape[1:]), dtype=np.float32)
    if len(chosen):
        solids = {task.objects[owner].name: one.solid for owner, one in usable.items() if one.solid is not None}
        settings = {name: getattr(task.settings, name) for name in ("fidelity", "backend", "device", "retry")}
        indices = [place[int(task.owner[i])] * count + int(task.within[i]) for i in chosen.tolist()]
        scenes = SweepScenes(task.grid, solids, whiskers=task.whiskers)
        packed = {task.objects[owner].name: one.packed for owner, one in usable.items() if one.packed is not None}
        batch = simulate_sweeps(
            scenes, indices, workers=workers, packed=packed, estimated=task.estimated[chosen], **settings
        )
        if batch.wrench.shape != (len(chosen), *shape[1:]):
            raise UsageError(f"The engine gave wrenches {batch.wrench.shape}; expected {(len(chosen), *shape[1:])}.")
        error[chosen] = batch.error
        contact[chosen], status[chosen] = batch.contact, np.where(batch.unstable, UNSTABLE, OK)
        for index, reason in zip(chosen.tolist(), batch.reasons, strict=True):
            reasons[index] = reason
        counts = {name: getattr(batch, name) for name in counts}
        wrench = batch.wrench
    if len(chosen) < len(task):
        simulated, wrench = wrench, np.full(shape, np.nan, dtype=np.float32)
        wrench[chosen] = simulated
    arrays = {
        **shard_tables(task, array, frames.times, [one.hash for one in built]),
        **_conditions(task),
        "contact": contact,
        "status": status,
        **({"error": error} if task.settings.errors else {}),
        "reason": encode_texts(reasons),
        "wrench": np.ascontiguousarray(wrench, dtype="<f4"),
    }
    return ShardContent(task, arrays, shard_attributes(task, frames.axes, status, counts))


def shard_attributes(
    task: PlannedShard, axes: str, status: NDArray[np.uint8], counts: Mapping[str, int]
) -> dict[str, Any]:
    """Return the attributes of a shard: what it belongs to, its axes, and counts of steps and failures."""
    return {
        "format": SWEEPS_FORMAT,
        "schema": SWEEPS_SCHEMA,
        "split": task.split,
        "axes": axes,
        # An attribute has room for 64 kB; thousands of classes stand in the table of that name.
        "config": to_json({key: item for key, item in task.config.items() if key != "classes"}, indent=None),
        "config_hash": task.config_hash,
        **counts,
        "unstable": int((status == UNSTABLE).any(axis=1).sum()),
        "unusable": int((status == UNUSABLE).any(axis=1).sum()),
    }


def write_shard(content: ShardContent, folder: str | os.PathLike[str]) -> int:
    """Write the file of a shard so that it is there as a whole or not at all; return the number of its sweeps."""
    arrays, wrench = content.arrays, content.arrays["wrench"]
    digest = hash_arrays(arrays)
    with atomic_path(Path(folder) / content.task.name) as temporary:
        with create_hdf5(temporary, alignment_threshold=ALIGNMENT, alignment_interval=ALIGNMENT) as file:
            file.attrs.update({**content.attributes, "content_hash": digest})
            for name, array in arrays.items():
                if name != "wrench":
                    file.create_dataset(name, data=array.astype(_stored(array)), track_times=False)
            offset = _allocate(file, wrench.shape)
            _name_axes(file)
        # Past the library, which copies and lets no other thread write meanwhile.
        with temporary.open("r+b", buffering=0) as stream:
            stream.seek(offset)
            _write_all(stream, wrench)
    return len(content.task)


def shard_tables(
    task: PlannedShard, array: WhiskerArray, times: NDArray[np.float64], hashes: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Return the names behind the numbers: times, whiskers, channels, classes and objects."""
    return {
        "time": times,
        "whisker": encode_texts(mount.name for mount in array),
        "row": np.array([mount.row for mount in array], dtype=np.int16),
        "col": np.array([mount.col for mount in array], dtype=np.int16),
        "channel": encode_texts(CHANNELS),
        "class": encode_texts(task.classes),
        "object": encode_texts(item.name for item in task.objects),
        "object_class": np.array([task.classes.index(item.label) for item in task.objects], dtype=np.int32),
        "object_hash": encode_texts(hashes),
    }


def _hash_solid(solid: Solid) -> str:
    """Hash what whiskers touch of a solid; what a decomposition was made from stands for it on every machine."""
    if solid.origin is not None:
        return content_hash(solid.origin, round(solid.diagonal, 12))
    if solid.surface is not None:
        return content_hash(solid.surface.vertices, solid.surface.faces.astype(np.int32))
    return str(solid.config()["hash"])


def _conditions(task: ShardTask) -> dict[str, NDArray[Any]]:
    """Return, for each sweep, its number, class, object and conditions."""
    sweeps: list[Sweep] = []
    for owner, body in enumerate(task.objects):
        every = task.grid.sweeps(body.name)
        sweeps += [every[within] for within in task.within[task.owner == owner].tolist()]
    labels = np.array([task.classes.index(item.label) for item in task.objects], dtype=np.int32)
    kinds = {name: np.int32 if name == "draw" else np.float64 for name in _CONDITIONS}
    return {
        "sweep": task.index.astype(np.int64),
        "label": labels[task.owner],
        "owner": task.owner.astype(np.int32),
        **{name: np.array([getattr(sweep, name) for sweep in sweeps], dtype=kinds[name]) for name in _CONDITIONS},
    }


def encode_texts(values: Iterable[Any]) -> NDArray[np.bytes_]:
    """Return texts as UTF-8 of a fixed length, which has the same bytes in every file."""
    encoded = [str(value).encode() for value in values]
    return np.array(encoded, dtype=f"S{max(1, *map(len, encoded))}")


def _stored(array: NDArray[Any]) -> Any:
    import h5py

    if array.dtype.kind == "S":
        return h5py.string_dtype("utf-8", array.dtype.itemsize)
    return array.dtype.newbyteorder("<")


def _allocate(file: Any, shape: tuple[int, ...]) -> int:
    """Make room for the forces, contiguous and not yet written; return where in the file it is."""
    import h5py

    create = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    create.set_layout(h5py.h5d.CONTIGUOUS)
    create.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    create.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    create.set_obj_track_times(False)
    kind = h5py.h5t.py_create(np.dtype("<f4"))
    dataset = h5py.h5d.create(file.id, b"wrench", kind, h5py.h5s.create_simple(shape), create)
    h5py.Dataset(dataset).attrs["units"] = "N (F), N m (M)"
    return int(dataset.get_offset())


def _name_axes(file: Any) -> None:
    """Attach the tables as dimension scales, so that xarray opens the file with named axes."""
    axes = {
        "wrench": ("sweep", "time", "whisker", "channel"),
        **dict.fromkeys(("contact", "status", "error"), ("sweep", "whisker")),
        **dict.fromkeys(("label", "owner", "reason", *_CONDITIONS), ("sweep",)),
        **dict.fromkeys(("row", "col"), ("whisker",)),
        **dict.fromkeys(("object_class", "object_hash"), ("object",)),
    }
    for scale in ("sweep", "time", "whisker", "channel", "class", "object"):
        file[scale].make_scale(scale)
    for name, scales in axes.items():
        if name not in file:  # data sets may have no errors
            continue
        for axis, scale in enumerate(scales):
            file[name].dims[axis].attach_scale(file[scale])


def _write_all(stream: Any, array: NDArray[np.float32]) -> None:
    """Write all bytes of an array; one call of the system writes at most 2 GiB."""
    rest = memoryview(array.view(np.uint8).reshape(-1).data)
    while rest:
        rest = rest[stream.write(rest) :]
