from __future__ import annotations

import dataclasses
import io
import json

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import hash_arrays
from brainbench.stimuli import Fidelity, simulate
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE
from brainbench.stimuli.engines.protocol import SweepBatch, join_batches
from brainbench.stimuli.explain import Explanation
from brainbench.stimuli.sweeps.generation import is_complete
from brainbench.stimuli.sweeps.shards import (
    ALIGNMENT,
    OK,
    UNSTABLE,
    UNUSABLE,
    _write_all,
    make_shard,
    simulate_shard,
    simulate_sweeps,
    write_shard,
)
from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes
from tests.factories.engines import FakeEngine
from tests.factories.sweep_batches import GRID, small_plan, small_scenes

FAST = Fidelity.preset("fast")


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
    monkeypatch.setattr("brainbench.stimuli.sweeps.shards.get_engine", lambda name, **options: engine)
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


def test_a_write_that_the_system_cuts_short_goes_on():
    class Short(io.BytesIO):
        def write(self, data):
            return super().write(data[:7])

    stream, array = Short(), np.arange(100, dtype=np.float32).reshape(5, 20)
    _write_all(stream, array)
    assert stream.getvalue() == array.tobytes()
