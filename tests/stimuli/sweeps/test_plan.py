from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.stimuli import Fidelity
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.plan import SPLITS, GenerationPlan, GenerationSettings, split_objects, split_sweeps
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS
from tests.factories.sweep_batches import small_plan


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


FAST = Fidelity.preset("fast")


def _all(plan, name):
    return np.concatenate([getattr(task, name) for task in plan.shards])


def test_every_sweep_is_in_exactly_one_shard():
    plan = small_plan(("brick:7", "cone:12"), shard_size=10)
    assert sorted(_all(plan, "index").tolist()) == list(range(19 * 4))
    assert all(len(task) <= 10 for task in plan.shards)
    assert plan.sweeps == 76


def test_no_object_is_in_two_splits():
    plan = small_plan(("brick:20", "cone:20"), shard_size=7)
    where = {}
    for task in plan.shards:
        for item in task.objects:
            where.setdefault(item.name, set()).add(task.split)
    assert len(where) == 40
    assert all(len(splits) == 1 for splits in where.values())
    by_sweep = small_plan(("brick:20", "cone:20"), shard_size=7, split="sweep")
    objects = [{item.name for task in by_sweep.shards if task.split == name for item in task.objects} for name in
               ("train", "test")]  # fmt: skip
    assert objects[0] & objects[1]


def test_a_shard_knows_which_object_and_sweep_each_of_its_numbers_is():
    plan = small_plan(("brick:4", "cone:4"), shard_size=6)
    names = list(plan.objects)
    for task in plan.shards:
        assert (np.diff(task.owner) >= 0).all()
        for owner, within, index in zip(task.owner, task.within, task.index, strict=True):
            assert names[index // 4] == task.objects[owner].name
            assert index % 4 == within


def test_classes_mix_within_the_shards():
    plan = small_plan(("brick:30", "cone:30"), shard_size=40)
    first = plan.shards[0]
    assert {item.label for item in first.objects} == {"brick", "cone"}


def test_a_sample_is_a_random_fraction_and_a_limit_the_first_sweeps():
    sampled = small_plan(("brick:50",), sample=0.1)
    assert sampled.sweeps == 20
    assert len(np.unique(_all(sampled, "index") // 4)) > 10
    limited = small_plan(("brick:50",), limit=2)
    assert set(_all(limited, "within").tolist()) == {0, 1}
    # The split does not depend on what is left out.
    full = small_plan(("brick:50",))
    np.testing.assert_array_equal(full.splits, sampled.splits)


@pytest.mark.parametrize(
    ("backend", "errors", "share"),
    [("rod", 0.6, 0.6), ("rod", 1.0, 1.0), ("rod", 0.0, 0), ("mujoco", 0.1, 1), ("mujoco", 0.0, 0)],
)
def test_errors_are_estimated_of_a_sample_and_of_other_engines_whiskers_all(backend, errors, share):
    plan = small_plan(("brick:100",), backend=backend, errors=errors)
    assert plan.estimated.mean() == pytest.approx(share, abs=0.06)
    assert plan.estimated.any(axis=1).all() == (errors > 0)


def test_the_published_grids_are_planned_quickly_and_small():
    objects = resolve_objects(["procedural-24:40"])
    plan = GenerationPlan(
        "thesis-high", GRIDS["thesis-high"], objects, GenerationSettings(FAST, backend="mujoco", shard_size=2048)
    )
    assert plan.sweeps == 960 * 208
    assert sum(map(len, plan.shards)) == plan.sweeps
    assert len(plan.shards) == sum(math.ceil(split * 208 * 24 / 2048) for split in (32, 4, 4))
    low = GenerationPlan("thesis-low", GRIDS["thesis-low"], objects, GenerationSettings(FAST))
    assert sum(task.bytes for task in low.shards) == pytest.approx(960 * 16 * 110 * 30 * 24, rel=0.05)


def test_what_determines_the_bytes_is_in_the_hash():
    plans = [
        small_plan(),
        small_plan(seed=1),
        small_plan(split="sweep"),
        small_plan(shard_size=5),
        small_plan(limit=1),
        small_plan(whiskers="C2"),
        small_plan(fidelity=Fidelity.preset("balanced")),
        small_plan(("brick:2", "cone:3")),
    ]
    assert len({plan.config_hash for plan in plans}) == len(plans)
    assert small_plan().config_hash == plans[0].config_hash


def test_shards_are_small_where_sweeps_are_slow():
    sizes = [GenerationSettings(FAST, backend=backend, device=device).sweeps_per_shard for backend, device in
             (("bullet", "cpu"), ("mujoco", "cpu"), ("rod", "cpu"), ("rod", "cuda"))]  # fmt: skip
    assert sizes == sorted(sizes)
    assert len(set(sizes)) == 4
    assert GenerationSettings(FAST, shard_size=7).sweeps_per_shard == 7


def test_sweeps_are_limited_or_sampled():
    with pytest.raises(UsageError, match="not both"):
        GenerationSettings(FAST, sample=0.5, limit=2)
