"""Plan of a data set: its sweeps, their splits (80, 10 and 10 % of each class) and their shards.

Nothing is built or simulated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from importlib import metadata
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import SWEEPS_FORMAT, SWEEPS_SCHEMA
from brainbench.core.errors import UsageError
from brainbench.core.files import content_hash, portable, to_plain
from brainbench.core.limits import Count, Limit, Seed, limited
from brainbench.core.version import __version__
from brainbench.stimuli.engines import PHYSICS_VERSION, get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.objects.collections import NamedObject
from brainbench.stimuli.sweeps.sweep_scenes import SweepGrid
from brainbench.stimuli.whiskers.array import WhiskerArray

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


@dataclass(frozen=True)
@limited
class GenerationSettings:
    """Options of a data set of sweeps; a value outside its range is a :class:`UsageError`."""

    fidelity: Fidelity
    backend: str = DEFAULT_ENGINE
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


class Plan(Protocol):
    """Data set before its shards are made, simulated (:class:`GenerationPlan`) or converted."""

    @property
    def objects(self) -> Mapping[str, NamedObject]:
        """Objects by name."""
        ...

    @property
    def classes(self) -> Sequence[str]:
        """Class labels; a label's place is its number in the shards."""
        ...

    @property
    def sweeps(self) -> int:
        """Number of sweeps."""
        ...

    @property
    def notes(self) -> Mapping[str, Any]:
        """Further entries of the manifest."""
        ...

    @cached_property
    def config(self) -> dict[str, Any]:
        """Plain values that determine every byte of the data set."""
        ...

    @cached_property
    def config_hash(self) -> str:
        """Hash of :attr:`config`."""
        ...

    @cached_property
    def shards(self) -> tuple[PlannedShard, ...]:
        """Shards, those of training first."""
        ...


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

    @property
    def notes(self) -> Mapping[str, Any]:
        """Further entries of the manifest: none."""
        return {}

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
