"""Splits of sweeps into training, validation and testing: 80, 10 and 10 % of each class, by object or by sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.files import content_hash

SPLITS = ("train", "validation", "test")
"""Names of the splits, in the order of the numbers that stand for them."""

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
