from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import hash_arrays
from brainbench.core.runs.folder import begin_run
from brainbench.stimuli import Fidelity, simulate
from brainbench.stimuli.engines.error_estimates import RULE
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE
from brainbench.stimuli.engines.protocol import SweepBatch, join_batches
from brainbench.stimuli.explain import Explanation
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.generation import is_complete
from brainbench.stimuli.sweeps.plan import (
    ALIGNMENT,
    OK,
    SPLITS,
    UNSTABLE,
    UNUSABLE,
    GenerationPlan,
    GenerationSettings,
    make_shard,
    simulate_shard,
    simulate_sweeps,
    split_objects,
    split_sweeps,
    write_shard,
)
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes
from tests.factories.engines import FakeEngine
from tests.factories.sweep_batches import GRID, small_plan


def small_scenes(whiskers="C3", grid=GRID):
    solids = resolve_objects(("brick:2", "cone:2"), collision="hull")
    return SweepScenes(grid, {name: item.load for name, item in solids.items()}, whiskers=whiskers)


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


def test_a_data_set_goes_on_only_by_the_rule_of_errors_that_it_was_begun_with(tmp_path, monkeypatch):
    asked = small_plan().config
    assert asked["error_rule"] == RULE
    assert "error_rule" not in small_plan(errors=0.0).config
    begin_run(tmp_path, asked, "data set", results="*.h5")
    (tmp_path / "shard.h5").touch()
    begin_run(tmp_path, asked, "data set", results="*.h5")
    monkeypatch.setattr("brainbench.stimuli.sweeps.plan.RULE", RULE + 1)
    with pytest.raises(UsageError, match=rf"holds another data set: error_rule {RULE} \(now {RULE + 1}\)\."):
        begin_run(tmp_path, small_plan().config, "data set", results="*.h5")


def test_shards_are_small_where_sweeps_are_slow():
    sizes = [GenerationSettings(FAST, backend=backend, device=device).sweeps_per_shard for backend, device in
             (("bullet", "cpu"), ("mujoco", "cpu"), ("rod", "cpu"), ("rod", "cuda"))]  # fmt: skip
    assert sizes == sorted(sizes)
    assert len(set(sizes)) == 4
    assert GenerationSettings(FAST, shard_size=7).sweeps_per_shard == 7


def test_sweeps_are_limited_or_sampled():
    with pytest.raises(UsageError, match="not both"):
        GenerationSettings(FAST, sample=0.5, limit=2)


def test_a_batch_holds_what_simulating_its_scenes_gives():
    scenes = small_scenes(whiskers="C2,C3", grid=small_plan().grid)
    indices = [9, 2, 3]
    batch = simulate_sweeps(scenes, indices, fidelity=FAST, backend="mujoco")
    dataset = simulate([scenes[index] for index in indices], fidelity=FAST, backend="mujoco", cache=False)
    np.testing.assert_array_equal(batch.wrench, dataset["wrench"].values)
    np.testing.assert_array_equal(batch.contact, dataset["contact"].values.mean(axis=1).astype(np.float32))
    assert batch.contact.max() > 0
    assert not batch.unstable.any()
    assert batch.reasons == ("", "", "")
    assert batch.steps == batch.steps_in_full


def test_neither_batch_nor_order_nor_threads_change_a_number():
    scenes, indices = small_scenes(), [2, 3, 9]
    together = simulate_sweeps(scenes, indices, fidelity=FAST, workers=2)
    backwards = simulate_sweeps(scenes, indices[::-1], fidelity=FAST, workers=1)
    np.testing.assert_array_equal(together.wrench, backwards.wrench[::-1])
    alone = join_batches([simulate_sweeps(scenes, [index], fidelity=FAST) for index in indices])
    np.testing.assert_array_equal(together.wrench, alone.wrench)
    np.testing.assert_array_equal(together.contact, alone.contact)


@pytest.mark.parametrize("backend", ["rod", "mujoco"])
def test_whiskers_of_some_sweeps_get_the_error_that_their_scenes_have(backend):
    scenes, indices, estimated = small_scenes(whiskers="C2,C3"), [9, 2, 3], np.array([True, False, True])
    plain = simulate_sweeps(scenes, indices, fidelity=FAST, backend=backend)
    batch = simulate_sweeps(scenes, indices, fidelity=FAST, backend=backend, estimated=estimated)
    np.testing.assert_array_equal(batch.wrench, plain.wrench)
    np.testing.assert_array_equal(batch.contact, plain.contact)
    assert np.isnan(plain.error).all()
    assert np.isnan(batch.error[1]).all()
    shown = simulate([scenes[9], scenes[3]], fidelity=FAST, backend=backend, cache=False)["error"].values
    assert shown.max() > 0
    np.testing.assert_allclose(batch.error[estimated], shown, rtol=0.05)


def test_sweeps_that_move_the_head_go_through_the_default_engine_scene_by_scene():
    scenes = small_scenes(grid=dataclasses.replace(GRID, mover="head"))
    batch = simulate_sweeps(scenes, [1, 2], fidelity=FAST)
    dataset = simulate([scenes[index] for index in (1, 2)], fidelity=FAST, cache=False)
    assert dataset.attrs["backend"] == DEFAULT_ENGINE
    np.testing.assert_array_equal(batch.wrench, dataset["wrench"].values)


@pytest.mark.slow
def test_steps_whose_contact_forces_are_not_solved_are_counted_as_in_scenes():
    scenes, indices = small_scenes(whiskers="C*"), range(16)
    batch = simulate_sweeps(scenes, indices, fidelity=FAST)
    parts = [simulate_sweeps(scenes, [index], fidelity=FAST).unsolved for index in indices]
    assert 0 < batch.unsolved == sum(parts) < batch.steps
    shown = simulate([scenes[index] for index in indices], fidelity=FAST, cache=False)
    assert batch.unsolved == pytest.approx(Explanation.of(shown).unsolved, rel=0.2)


def test_an_unstable_whisker_is_marked_with_its_reason(monkeypatch):
    engine = FakeEngine(unstable={1: "joint 3 bent too far"})
    monkeypatch.setattr("brainbench.stimuli.sweeps.plan.get_engine", lambda name, **options: engine)
    batch = simulate_sweeps(small_scenes(whiskers="C2,C3"), [0, 1], fidelity=FAST, backend="fake")
    assert batch.unstable.tolist() == [[False, True], [False, False]]
    assert "C3: joint 3 bent too far" in batch.reasons[0].replace("RC3", "C3")
    assert batch.reasons[1] == ""
    assert np.isnan(batch.wrench[0, -1, 1]).all()
    assert np.isfinite(batch.wrench[1]).all()


def test_a_device_that_the_engine_does_not_have_is_refused():
    with pytest.raises(UsageError, match=r"'mujoco' .*'cuda'; .*'cpu'"):
        simulate_sweeps(small_scenes(), [0], fidelity=FAST, backend="mujoco", device="cuda")


def test_a_batch_that_hides_instability_cannot_be_made():
    wrench, contact = np.zeros((2, 5, 3, 6), np.float32), np.zeros((2, 3), np.float32)
    unstable = np.zeros((2, 3), bool)
    unstable[1, 2] = True
    with pytest.raises(UsageError, match="reason"):
        SweepBatch(wrench, contact, unstable, ("", ""), 1, 1)
    with pytest.raises(UsageError, match=r"received \(2, 5, 3, 6\), \(1, 3\)"):
        SweepBatch(wrench, contact[:1], unstable, ("", "bent"), 1, 1)


def test_a_shard_holds_the_simulated_forces_and_what_they_belong_to(tmp_path):
    plan = small_plan(("brick:2", "cone"), whiskers="C2,C3", shard_size=100)
    task = plan.shards[0]
    assert make_shard(task, str(tmp_path)) == len(task)
    scenes = SweepScenes(plan.grid, {name: item.load for name, item in plan.objects.items()}, whiskers="C2,C3")
    with h5py.File(tmp_path / task.name) as file:
        for row, index in enumerate(file["sweep"][:].tolist()):
            dataset = simulate(scenes[index], fidelity="fast", backend="mujoco", cache=False)
            np.testing.assert_array_equal(file["wrench"][row], dataset["wrench"].values[0])
            name = file["object"].asstr()[file["owner"][row]]
            assert file["class"].asstr()[file["label"][row]] == name.split("-")[0]
            label = f"{name}/n{file['draw'][row]}_h{file['height'][row] * 1e3 + 0:g}_d{file['distance'][row] * 1e3:g}"
            assert str(dataset["stimulus"].values[0]).startswith(label)
        assert file["wrench"].shape == (len(task), 10, 2, 6)
        assert file["status"][:].max() == OK
        assert file["contact"][:].max() > 0
        assert (file["time"][:] == GRID.frames.times).all()
        assert file["row"][:].tolist() == [2, 2]
        assert file["col"][:].tolist() == [2, 3]


def test_the_forces_can_be_mapped_into_memory(tmp_path):
    task = small_plan(("brick:5",), whiskers="C2,C3").shards[0]
    make_shard(task, str(tmp_path))
    path = tmp_path / task.name
    with h5py.File(path) as file:
        wrench, offset = file["wrench"][:], file["wrench"].id.get_offset()
        assert file["wrench"].chunks is None
        assert file["wrench"].compression is None
    assert offset % ALIGNMENT == 0
    np.testing.assert_array_equal(np.memmap(path, "<f4", "r", offset, wrench.shape), wrench)


def test_xarray_opens_a_shard_with_named_axes(tmp_path):
    import xarray as xr

    task = small_plan().shards[0]
    make_shard(task, str(tmp_path))
    with xr.open_dataset(tmp_path / task.name, engine="h5netcdf") as dataset:
        assert dataset["wrench"].dims == ("sweep", "time", "whisker", "channel")
        assert dataset["speed"].dims == ("sweep",)
        assert dataset["object_class"].dims == ("object",)


def test_the_same_shard_has_the_same_bytes_and_its_hash_tells_of_its_content(tmp_path):
    task = small_plan().shards[0]
    for folder in ("a", "b"):
        make_shard(task, str(tmp_path / folder), workers=1 + (folder == "b"))
    assert (tmp_path / "a" / task.name).read_bytes() == (tmp_path / "b" / task.name).read_bytes()
    content = simulate_shard(task)
    with h5py.File(tmp_path / "a" / task.name) as file:
        stored = {name: file[name][:] for name in content.arrays}
        assert hash_arrays(stored) == hash_arrays(content.arrays) == file.attrs["content_hash"]
    stored["wrench"][0, 0, 0, 0] += 1
    assert hash_arrays(stored) != hash_arrays(content.arrays)


def test_unstable_sweeps_are_marked_and_counted(tmp_path):
    grid = dataclasses.replace(GRID, start=-0.006)
    task = small_plan(("brick:2",), grid=grid, whiskers="C2,C3").shards[0]
    make_shard(task, str(tmp_path))
    with h5py.File(tmp_path / task.name) as file:
        status, wrench, reasons = file["status"][:], file["wrench"][:], file["reason"].asstr()[:]
        bad = (status == UNSTABLE).any(axis=1)
        assert 0 < file.attrs["unstable"] == bad.sum() < len(bad)
    wrench = np.moveaxis(wrench, 1, 2)
    assert np.isnan(wrench[status == UNSTABLE][:, -1]).all()
    assert np.isfinite(wrench[status == OK]).all()
    assert all(bool(reason) == is_bad for reason, is_bad in zip(reasons, bad, strict=True))


def _broken():
    raise DataError("it has no volume")


def test_sweeps_of_an_object_that_cannot_be_built_are_marked_and_the_others_are_there(tmp_path):
    task = small_plan(("brick:2",), shard_size=100, split="sweep").shards[0]
    broken = dataclasses.replace(task.objects[1], load=_broken)
    task = dataclasses.replace(task, objects=(task.objects[0], broken))
    make_shard(task, str(tmp_path))
    with h5py.File(tmp_path / task.name) as file:
        mine = file["owner"][:] == 1
        assert (file["status"][:][mine] == UNUSABLE).all()
        assert (file["status"][:][~mine] == OK).all()
        assert np.isnan(file["wrench"][:][mine]).all()
        assert np.isfinite(file["wrench"][:][~mine]).all()
        assert set(file["reason"].asstr()[:][mine]) == {"it has no volume"}
        assert file.attrs["unusable"] == mine.sum()


def test_thousands_of_classes_fit_into_a_shard(tmp_path):
    task = small_plan(("brick:1",), limit=1).shards[0]
    classes = ("brick", *(f"a class of its own, number {number}" for number in range(5000)))
    task = dataclasses.replace(task, config={**task.config, "classes": list(classes)})
    make_shard(task, str(tmp_path))
    with h5py.File(tmp_path / task.name) as file:
        assert tuple(file["class"].asstr()[:]) == classes
        assert json.loads(file.attrs["config"])["seed"] == 0


@pytest.mark.parametrize("kept", [0, 100, 5000])
def test_a_shard_that_was_cut_off_is_not_whole(tmp_path, kept):
    task = small_plan().shards[0]
    write_shard(simulate_shard(task), tmp_path)
    path = tmp_path / task.name
    assert is_complete(path, task)
    with h5py.File(path, "r+") as file:
        del file["wrench"]
        file.create_group("wrench")
    assert not is_complete(path, task)
    path.write_bytes(path.read_bytes()[:kept])
    assert not is_complete(path, task)


def test_a_shard_of_another_data_set_is_not_taken_for_ones_own(tmp_path):
    task = small_plan().shards[0]
    make_shard(task, str(tmp_path))
    other = small_plan(seed=1).shards[0]
    with pytest.raises(DataError, match=r"/train-00000\.h5' .*another"):
        is_complete(tmp_path / task.name, other)
