import itertools
import json
import math
import os
import shutil

import h5py
import numpy as np
import pytest
import torch

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets.whisking.dataset import WhiskingDataset
from brainbench.stimuli import Fidelity, SweepGrid, simulate, to_grid
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.scenes.scene import Frames
from brainbench.stimuli.sweeps.generation import generate
from brainbench.stimuli.sweeps.plan import GenerationPlan, GenerationSettings
from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes
from tests.factories.sweep_batches import GRID, forty_sweeps, small_plan, small_set


@pytest.fixture(scope="module")
def plan():
    return forty_sweeps()


@pytest.fixture(scope="module")
def folder():
    return small_set()


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "set")


def test_a_batch_is_the_grid_of_the_simulated_sweeps(plan, folder):
    data = WhiskingDataset(folder, split="test", batch_size=5)
    scenes = SweepScenes(plan.grid, {name: item.load for name, item in plan.objects.items()}, whiskers=plan.whiskers)
    order = data.order(0)
    x, y = next(iter(data))
    expected = simulate(
        [scenes[int(data.indices[i])] for i in order[:5]], fidelity="fast", backend="mujoco", cache=False
    )
    np.testing.assert_array_equal(x.numpy(), to_grid(expected))
    assert x.shape == (5, 2, 30, 5, 7)
    assert np.abs(x.numpy()).max() > 0
    assert [data.classes[label] for label in y.tolist()] == [data.objects[i].split("-")[0] for i in order[:5]]


def test_unusual_time_steps_and_axes_are_told(folder, copy):
    assert WhiskingDataset(folder).summary["time_step"] == pytest.approx(0.05)
    for path in copy.glob("*.h5"):
        with h5py.File(path, "r+") as file:
            file.attrs["axes"] = "follicle"
    assert WhiskingDataset(copy).summary["axes"] == "follicle"


def test_test_sweeps_of_objects_that_are_trained_on_are_counted_whatever_their_names(folder, copy):
    whole = WhiskingDataset(folder, split="all")
    assert "test_of_trained_objects" not in whole.summary
    trained, tested = (WhiskingDataset(folder, split=split).objects for split in ("train", "test"))
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["objects"][tested[0]]["hash"] = manifest["objects"][trained[0]]["hash"]
    (copy / "manifest.json").write_text(json.dumps(manifest))
    count = int((tested == tested[0]).sum())
    assert WhiskingDataset(copy, split="all").summary == {**whole.summary, "test_of_trained_objects": count}
    manifest["objects"][tested[0]] = None
    (copy / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(DataError, match="manifest of a data set"):
        WhiskingDataset(copy)


def test_raw_batches_hold_the_forces_as_stored(plan, folder):
    data = WhiskingDataset(folder, split="test", batch_size=3, view="raw", shuffle=False)
    x, _ = next(iter(data))
    with h5py.File(folder / "test-00000.h5") as file:
        np.testing.assert_array_equal(x.numpy(), file["wrench"][:3])
    assert x.shape == (3, 10, 3, 6)


def test_an_epoch_has_every_sweep_once_in_an_order_of_its_own(folder):
    data = WhiskingDataset(folder, split="train", batch_size=5)
    first, second = data.order(0), data.order(1)
    assert sorted(first) == sorted(second) == list(range(24)) == list(range(data.sweeps))
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, WhiskingDataset(folder, split="train", batch_size=9).order(0))
    assert not np.array_equal(first, WhiskingDataset(folder, split="train", seed=1).order(0))
    assert [len(y) for _, y in data] == [5, 5, 5, 5, 4]
    assert len(data) == 5
    assert data.epoch == 1
    assert len(WhiskingDataset(folder, split="train", batch_size=5, drop_last=True)) == 4


def test_all_splits_together_are_the_whole_data_set_and_share_no_object(folder):
    parts = [WhiskingDataset(folder, split=split) for split in ("train", "validation", "test")]
    indices = np.concatenate([part.indices for part in parts])
    assert sorted(indices) == list(range(40))
    for one, other in itertools.combinations(parts, 2):
        assert not set(one.objects) & set(other.objects)
    assert WhiskingDataset(folder, split="all").sweeps == 40


@pytest.mark.parametrize("stop", [0, 1, 3, 5, 6])
def test_a_resumed_iteration_gives_the_batches_of_an_unbroken_one(folder, stop):
    def batches(data):
        while True:
            yield from data

    unbroken = WhiskingDataset(folder, split="train", batch_size=5)
    expected = list(itertools.islice(batches(unbroken), 12))
    first = WhiskingDataset(folder, split="train", batch_size=5)
    list(itertools.islice(batches(first), stop))
    state = json.loads(json.dumps(first.state_dict()))
    again = WhiskingDataset(folder, split="train", batch_size=5)
    again.load_state_dict(state)
    for (x, y), (x0, y0) in zip(itertools.islice(batches(again), 12 - stop), expected[stop:], strict=True):
        assert torch.equal(x, x0)
        assert torch.equal(y, y0)


def test_a_state_of_other_batches_is_refused(folder):
    state = WhiskingDataset(folder, batch_size=5).state_dict()
    with pytest.raises(UsageError, match=r"seed 0 \(here 1\), batch"):
        WhiskingDataset(folder, batch_size=6, seed=1).load_state_dict(state)


def test_batches_that_are_kept_are_never_written_over(folder):
    data = WhiskingDataset(folder, split="train", batch_size=2)
    kept, views, copies = [], [], []
    for epoch in range(3):
        for index, (x, _) in enumerate(data):
            if index % 2 == epoch % 2:
                kept.append(x)
                views.append(x[1:, 0])
                copies.append(x.clone())
        # Only views are left of the first epoch's batches.
        if epoch == 0:
            kept.clear()
    assert all(torch.equal(view, copy[1:, 0]) for view, copy in zip(views, copies, strict=True))
    assert all(torch.equal(x, copy) for x, copy in zip(kept, copies[-len(kept) :], strict=True))


def test_memory_is_used_again_once_nobody_holds_it(folder):
    data = WhiskingDataset(folder, split="train", batch_size=2)
    addresses = {x.data_ptr() for _ in range(3) for x, _ in data}
    assert len(addresses) <= 8
    assert len(data._buffers) <= 8


def test_processes_read_different_sweeps_and_equally_many(folder):
    parts = [WhiskingDataset(folder, split="train", batch_size=4, part=(rank, 5)) for rank in range(5)]
    orders = [part.order(3) for part in parts]
    assert {len(order) for order in orders} == {24 // 5}
    assert len(set(np.concatenate(orders).tolist())) == 20
    assert {len(part) for part in parts} == {1}


def test_statistics_are_those_of_all_numbers(folder):
    data = WhiskingDataset(folder, split="train")
    values = data.read(np.arange(data.sweeps)).reshape(-1, 6).astype(float)
    for found in (data.statistics(), WhiskingDataset(folder, split="train").statistics()):
        np.testing.assert_allclose(found.mean, values.mean(axis=0), rtol=1e-6, atol=1e-15)
        np.testing.assert_allclose(found.std, values.std(axis=0), rtol=1e-6)
        np.testing.assert_allclose(found.largest, np.abs(values).max(axis=0))
        assert found.values == len(values)


@pytest.fixture(scope="module")
def unstable(tmp_path_factory):
    import dataclasses

    path = tmp_path_factory.mktemp("unstable")
    generate(small_plan(("brick:3",), grid=dataclasses.replace(GRID, start=-0.006), whiskers="C2,C3"), path, workers=1)
    return path


def test_unstable_sweeps_are_left_out_unless_asked_for(unstable):
    data = WhiskingDataset(unstable, split="all", batch_size=100)
    assert data.skipped > 0
    assert data.skipped + data.sweeps == 12
    assert f"{data.skipped} unstable sweeps left out" in repr(data)
    (x, _), *_ = data
    assert torch.isfinite(x).all()
    every = WhiskingDataset(unstable, split="all", batch_size=100, unstable="zero")
    (x, _), *_ = every
    assert x.shape[0] == 12
    assert torch.isfinite(x).all()
    with pytest.raises(DataError, match=f"{data.skipped} sweeps.*unstable"):
        WhiskingDataset(unstable, split="all", unstable="error")


def test_verification_finds_one_changed_byte(copy):
    data = WhiskingDataset(copy, split="all")
    data.verify()
    path = copy / "train-00001.h5"
    with h5py.File(path) as file:
        offset = file["wrench"].id.get_offset()
    with path.open("r+b") as stream:
        stream.seek(offset + 1000)
        stream.write(b"\x01")
    with pytest.raises(DataError, match=r"train-00001.h5' .*hash"):
        WhiskingDataset(copy, split="all").verify()


def test_missing_and_damaged_shards_are_named(copy):
    path = copy / "train-00001.h5"
    os.truncate(path, path.stat().st_size - 2000)
    with pytest.raises(DataError, match=r"train-00001.h5' is truncated"):
        WhiskingDataset(copy)
    WhiskingDataset(copy, split="test")
    path.unlink()
    with pytest.raises(DataError, match=r"train-00001.h5'.*missing"):
        WhiskingDataset(copy)
    shutil.copy(copy / "test-00000.h5", path)
    with pytest.raises(DataError, match=r"train-00001.h5' .*manifest beside"):
        WhiskingDataset(copy)


def test_folders_without_a_finished_data_set_say_what_to_do(copy, tmp_path):
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps({**manifest, "schema": 99}))
    with pytest.raises(DataError, match=r"version 99; .*version 1"):
        WhiskingDataset(copy)
    (copy / "manifest.json").unlink()
    with pytest.raises(DataError, match=r"/set' .*finished"):
        WhiskingDataset(copy)
    with pytest.raises(DataError, match=r"/nowhere' .*brainbench stimuli sweep"):
        WhiskingDataset(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"split": "validate"}, "Unknown split 'validate'; did you mean 'validation'"),
        ({"view": "grids"}, "did you mean 'grid'"),
        ({"substeps": 3}, "10 frames do not divide into time steps of 3"),
        ({"batch_size": 0}, "batch_size .*0"),
        ({"batch_size": 2.5}, r"batch_size .*2\.5"),
        ({"batch_size": math.nan}, "batch_size .*nan"),
        ({"substeps": 0}, "substeps .*0"),
        ({"seed": math.nan, "shuffle": False}, "seed .*nan"),
        ({"part": (2, 2)}, "0 ≤ rank < number"),
        ({"batch_size": 50, "drop_last": True}, "make no batch of 50"),
    ],
)
def test_arguments_out_of_range_are_named(folder, options, message):
    with pytest.raises(UsageError, match=message):
        WhiskingDataset(folder, **options)


def test_a_class_without_test_objects_leaves_an_empty_split_in_words(tmp_path):
    generate(small_plan(("brick:2",)), tmp_path, workers=1)
    with pytest.raises(DataError, match=r"'validation'.*'test', 'train'"):
        WhiskingDataset(tmp_path, split="validation")


@pytest.mark.slow
def test_many_shards_are_read_with_few_open_files(tmp_path, monkeypatch):
    grid = SweepGrid(frames=Frames(count=10))
    plan = GenerationPlan("still", grid, resolve_objects(["brick:40"], collision="hull"),
                          GenerationSettings(Fidelity.preset("fast"), shard_size=1), "C3")  # fmt: skip
    generate(plan, tmp_path, workers=1)
    monkeypatch.setattr("brainbench.datasets.whisking.dataset.most_open", lambda: 5)
    data = WhiskingDataset(tmp_path, split="all", batch_size=7)
    assert sum(len(y) for _, y in data) == 40
    assert data._forces.cache_info().currsize == 5
