from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.stimuli.sweeps.split import SPLITS, split_objects, split_sweeps


def _labels(**counts):
    return {f"{label}-{i}": label for label, count in counts.items() for i in range(count)}


def _counts(labels, splits):
    return Counter((label, SPLITS[split]) for label, split in zip(labels, splits, strict=True))


def test_every_class_is_divided_80_10_10():
    labels = _labels(mug=40, vase=100, star=10)
    found = _counts(labels.values(), split_objects(labels, seed=0))
    assert [found["mug", split] for split in SPLITS] == [32, 4, 4]
    assert [found["vase", split] for split in SPLITS] == [80, 10, 10]
    assert [found["star", split] for split in SPLITS] == [8, 1, 1]


@pytest.mark.parametrize(("count", "expected"), [(1, [1, 0, 0]), (2, [1, 0, 1]), (3, [1, 1, 1]), (9, [7, 1, 1])])
def test_small_classes_have_something_to_learn_and_something_to_test(count, expected):
    labels = _labels(mug=count)
    found = _counts(labels.values(), split_objects(labels, seed=5))
    assert [found["mug", split] for split in SPLITS] == expected


@given(st.integers(0, 1000), st.permutations([f"{label}-{i}" for label in "abc" for i in range(12)]))
def test_the_split_of_an_object_depends_on_seed_and_class_members_alone(seed, names):
    labels = {name: name[0] for name in names}
    ordered = {name: labels[name] for name in sorted(names)}
    found = dict(zip(labels, split_objects(labels, seed=seed).tolist(), strict=True))
    assert found == dict(zip(ordered, split_objects(ordered, seed=seed).tolist(), strict=True))
    without = {name: label for name, label in labels.items() if label != "c"}
    alone = dict(zip(without, split_objects(without, seed=seed).tolist(), strict=True))
    assert alone == {name: found[name] for name in without}


def test_another_seed_splits_otherwise():
    labels = _labels(mug=50)
    assert not np.array_equal(split_objects(labels, seed=0), split_objects(labels, seed=1))


def test_sweeps_of_one_object_fall_into_all_splits_when_the_split_is_by_sweep():
    labels = ["mug"] * 5 + ["vase"] * 5
    found = split_sweeps(labels, 40, seed=0)
    assert found.shape == (10, 40)
    for rows in (found[:5], found[5:]):
        assert Counter(rows.ravel().tolist()) == {0: 160, 1: 20, 2: 20}
    assert len(set(found[0].tolist())) > 1
