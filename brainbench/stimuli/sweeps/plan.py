"""Plan of a data set: its sweeps, their splits (80, 10 and 10 % of each class) and their shards.

A plan builds and simulates nothing. A shard builds its objects, simulates its sweeps and writes its file, whose layout
is described in ``docs/datasets.md``. Its bytes depend on what was asked for alone: no time, no machine and no
version of a library is in it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS, SWEEPS_FORMAT, SWEEPS_SCHEMA
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import atomic_path, content_hash, create_hdf5, hash_arrays, portable, to_json, to_plain
from brainbench.core.limits import Count, Limit, Seed, limited
from brainbench.core.version import __version__
from brainbench.stimuli.engines import PHYSICS_VERSION, get_engine
from brainbench.stimuli.engines.error_estimates import RULE
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.engines.protocol import SweepBatch, WhiskerEngine, describe_unstable, join_batches
from brainbench.stimuli.explain import Explanation
from brainbench.stimuli.objects.collections import NamedObject
from brainbench.stimuli.objects.solid import Solid
from brainbench.stimuli.simulation import simulate_uncached
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
    straight = np.zeros(contact.shape, dtype=np.uint8)
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
        error[chosen], straight[chosen] = batch.error, batch.straight
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
        "straight": straight,
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
        with temporary.open("r+b") as stream:
            stream.seek(offset)
            stream.write(wrench.data)
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
        **dict.fromkeys(("contact", "status", "straight", "error"), ("sweep", "whisker")),
        **dict.fromkeys(("label", "owner", "reason", *_CONDITIONS), ("sweep",)),
        **dict.fromkeys(("row", "col"), ("whisker",)),
        **dict.fromkeys(("object_class", "object_hash"), ("object",)),
    }
    for scale in ("sweep", "time", "whisker", "channel", "class", "object"):
        file[scale].make_scale(scale)
    for name, scales in axes.items():
        if name not in file:  # data sets may have no errors, and converted ones no straight links
            continue
        for axis, scale in enumerate(scales):
            file[name].dims[axis].attach_scale(file[scale])


SPLITS = ("train", "validation", "test")  # names of the splits, in the order of the numbers that stand for them

SplitBy = Literal["object", "sweep"]
"""``object``: all sweeps of an object are in one split, so that a network meets new objects in the test.
``sweep``: sweeps of the same object are in several, as in published practice; accuracy then counts memory too."""


def split_objects(labels: Mapping[str, str], *, seed: int) -> NDArray[np.int8]:
    """Return the split [object] of each object, whose class labels are ``labels`` by name.

    Within each class objects are ordered by a hash of ``seed`` and their name: neither their order nor the objects
    of other classes matter. Of n objects a class gives n/10 to validation and as many to test, at least one each
    where n ≥ 3; of two objects one is for training and one for the test.
    """
    names = list(labels)
    members: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        members.setdefault(labels[name], []).append(index)
    splits = np.zeros(len(names), dtype=np.int8)
    for indices in members.values():
        ordered = sorted(indices, key=lambda index: content_hash(["split", seed, names[index]]))
        splits[ordered] = _in_order(len(ordered))
    return splits


def split_sweeps(labels: Sequence[str], count: int, *, seed: int) -> NDArray[np.int8]:
    """Return the split [object, sweep] of ``count`` sweeps of each object; ``labels`` are the objects' classes.

    Within each class all sweeps of all objects are shuffled.
    """
    splits = np.zeros((len(labels), count), dtype=np.int8)
    given = np.array(labels, dtype=object)
    for label in dict.fromkeys(labels):
        indices = np.flatnonzero(given == label)
        generator = np.random.default_rng(int(content_hash(["split sweeps", seed, label]), 16))
        shuffled = generator.permutation(_in_order(len(indices) * count))
        splits[indices] = shuffled.reshape(len(indices), count)
    return splits


def _in_order(count: int) -> NDArray[np.int8]:
    """Return the splits of ``count`` things in order: training first."""
    tenth = max(1, round(count / 10)) if count >= 3 else 0
    test = tenth if count >= 3 else count - 1
    return np.repeat(np.arange(3, dtype=np.int8), [count - tenth - test, tenth, test])


SHARD_SIZES = {"mujoco": 32, "bullet": 8}  # sweeps per shard of slow backends, so that a kill costs minutes at most
USUAL_SHARD = 512
GPU_SHARD = 2048  # sweeps per shard on a GPU, which takes thousands at a time


@limited
class GenerationSettings:
    """Options of a data set of sweeps; a value outside its range is a :class:`UsageError`."""

    fidelity: Fidelity
    backend: str = DEFAULT_ENGINE
    """Physics engine: ``rod`` (our own), ``mujoco``, or ``bullet``."""
    device: str = "cpu"
    """``cpu``, or ``cuda`` with a backend that runs there."""
    split: SplitBy = "object"
    """Train, validation and test (80/10/10) by ``object`` or by ``sweep``."""
    seed: Seed = 0
    """Seed of the split, of the order of the objects and of the sample; the grid has a seed of its own."""
    limit: Count | None = None
    """Only the first sweeps of each object; all when None."""
    sample: Annotated[float, Limit(above=0, most=1)] | None = None
    """Only this fraction of all sweeps, drawn at random; all when None."""
    shard_size: Count | None = None
    """Sweeps per shard; by backend and device when None."""
    errors: Annotated[float, Limit(least=0, most=1)] = 0.05
    """Share of the sweeps whose whiskers get an estimated error, drawn at random, one of each object at least; 0 for
    none, 1 for all (of other engines than ``rod`` always all). Each such whisker in contact is simulated twice more,
    with 2 and 1.5 times the work."""
    retry: Count = 5
    """Whiskers that cannot be trusted are simulated again with steps divided by this, and those left by twice this
    (backend ``rod``); 1 leaves them as they are."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "fidelity", self.fidelity.resolved(get_engine(self.backend).twists))
        if self.limit is not None and self.sample is not None:
            raise UsageError("Give limit (the first sweeps of each object) or sample (a random fraction), not both.")

    @property
    def sweeps_per_shard(self) -> int:
        """Sweeps of every shard but the last of each split."""
        default = USUAL_SHARD if self.device == "cpu" else GPU_SHARD
        return self.shard_size or SHARD_SIZES.get(self.backend, default)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlannedShard:
    """The sweeps of one shard of a data set."""

    split: str
    place: int
    """Number among the shards of its split."""
    objects: tuple[NamedObject, ...]
    """The objects of this shard, in the order of their sweeps."""
    index: NDArray[np.int64]
    """[sweep] number among all sweeps of the data set's source."""
    frames: int
    config: Mapping[str, Any]
    """Plain values that determine every byte of the data set, with its classes and its whiskers."""
    config_hash: str

    def __len__(self) -> int:
        return len(self.index)

    @property
    def name(self) -> str:
        """File name."""
        return f"{self.split}-{self.place:05d}.h5"

    @property
    def classes(self) -> Sequence[str]:
        """Class labels of the whole data set."""
        return self.config["classes"]

    @property
    def bytes(self) -> int:
        """About how large the file becomes."""
        return len(self) * (len(self.config["whiskers"]["names"]) * (24 * self.frames + 9) + 200) + 40_000


@dataclass(frozen=True, eq=False, kw_only=True)
class ShardTask(PlannedShard):
    """Everything that makes one shard, small enough to be sent to another process or machine."""

    grid: SweepGrid
    whiskers: str
    owner: NDArray[np.int64]
    """[sweep] index into ``objects``, ascending."""
    within: NDArray[np.int64]
    """[sweep] which sweep of its object."""
    estimated: NDArray[np.bool_]
    """[sweep] whether its whiskers get an estimated error."""
    settings: GenerationSettings


@dataclass(frozen=True, eq=False)
class GenerationPlan:
    """The shards of a data set, which needs an object."""

    recipe: str
    """Name of the grid, for people."""
    grid: SweepGrid
    objects: Mapping[str, NamedObject]
    settings: GenerationSettings
    whiskers: str = "all"
    """A selection; see :meth:`WhiskerArray.select`."""

    def __post_init__(self) -> None:
        if not self.objects:
            raise UsageError("A data set of sweeps needs at least one object.")

    @cached_property
    def array(self) -> WhiskerArray:
        """The whiskers."""
        return WhiskerArray.of(self.grid.species).select(self.whiskers)

    @property
    def classes(self) -> tuple[str, ...]:
        """Class labels, sorted; a label's place is its number in the shards."""
        return tuple(sorted({item.label for item in self.objects.values()}))

    @cached_property
    def config(self) -> dict[str, Any]:
        """Plain values that determine every byte of the data set."""
        grid = {item.name: getattr(self.grid, item.name) for item in fields(self.grid) if item.name != "published"}
        engine = get_engine(self.settings.backend)
        return {
            "format": SWEEPS_FORMAT,
            "schema": SWEEPS_SCHEMA,
            "recipe": self.recipe,
            "grid": to_plain({**grid, "head": self.grid.head.config(), "frames": self.grid.frames.config()}),
            "whiskers": {"names": list(self.array.names), "hash": content_hash(list(self.array))},
            "objects": {
                "count": len(self.objects),
                "hash": content_hash([[item.name, item.label, item.source] for item in self.objects.values()]),
            },
            "classes": list(self.classes),
            **to_plain(self.settings),
            "shard_size": self.settings.sweeps_per_shard,
            "version": __version__,
            "physics": PHYSICS_VERSION,
            **({"error_rule": RULE} if self.settings.errors else {}),
            "engine": f"{engine.package} {metadata.version(engine.package)}{engine.revision}",
        }

    @cached_property
    def config_hash(self) -> str:
        """Hash of :attr:`config`."""
        return content_hash(portable(self.config))

    @cached_property
    def chosen(self) -> NDArray[np.bool_]:
        """[object, sweep] whether a sweep belongs to the data set."""
        settings, count = self.settings, self.grid.count
        total = len(self.objects) * count
        if settings.sample is None:
            return np.broadcast_to(np.arange(count) < (settings.limit or count), (len(self.objects), count))
        generator = np.random.default_rng(int(content_hash(["sample", settings.seed]), 16))
        mask = np.zeros(total, dtype=bool)
        mask[generator.choice(total, max(1, round(settings.sample * total)), replace=False)] = True
        return mask.reshape(len(self.objects), count)

    @cached_property
    def estimated(self) -> NDArray[np.bool_]:
        """[object, sweep] whether the whiskers of a sweep get an estimated error."""
        settings = self.settings
        generator = np.random.default_rng(int(content_hash(["errors", settings.seed]), 16))
        draws = np.where(self.chosen, generator.random(self.chosen.shape), 2.0)
        # Whiskers of other engines are judged by their errors alone, so that all sweeps need them.
        share = settings.errors if settings.backend == DEFAULT_ENGINE else math.ceil(settings.errors)
        drawn = (draws < share) | (draws == draws.min(axis=1, keepdims=True))
        return self.chosen & drawn & (settings.errors > 0)

    @cached_property
    def splits(self) -> NDArray[np.int8]:
        """[object, sweep] number of each sweep's split in :data:`SPLITS`."""
        labels = {name: item.label for name, item in self.objects.items()}
        if self.settings.split == "sweep":
            return split_sweeps(list(labels.values()), self.grid.count, seed=self.settings.seed)
        split = split_objects(labels, seed=self.settings.seed)
        return np.broadcast_to(split[:, None], (len(self.objects), self.grid.count))

    @property
    def sweeps(self) -> int:
        """Number of sweeps of the data set."""
        return int(self.chosen.sum())

    @cached_property
    def shards(self) -> tuple[ShardTask, ...]:
        """The shards: those of training first, objects in an order drawn by the seed, so that classes mix."""
        names = list(self.objects)
        items = list(self.objects.values())
        order = np.array(sorted(range(len(names)), key=lambda i: content_hash(["order", self.settings.seed, names[i]])))
        count, size = self.grid.count, self.settings.sweeps_per_shard
        shards = []
        for number, split in enumerate(SPLITS):
            rank, within = np.nonzero((self.chosen & (self.splits == number))[order])
            owners = order[rank]
            for place, first in enumerate(range(0, len(owners), size)):
                part = slice(first, first + size)
                used = list(dict.fromkeys(owners[part].tolist()))
                local = {owner: index for index, owner in enumerate(used)}
                task = ShardTask(
                    split=split, place=place, objects=tuple(items[owner] for owner in used),
                    index=owners[part] * count + within[part], frames=self.grid.frames.count, config=self.config,
                    config_hash=self.config_hash, grid=self.grid, whiskers=self.whiskers,
                    owner=np.array([local[owner] for owner in owners[part].tolist()]), within=within[part],
                    estimated=self.estimated[owners[part], within[part]], settings=self.settings,
                )  # fmt: skip
                shards.append(task)
        return tuple(shards)
