from __future__ import annotations

import dataclasses
import json
import logging
import os
import shutil
from collections import namedtuple
from concurrent.futures import Future

import h5py
import numpy as np
import pytest
import trimesh

from brainbench.core.devices import warp
from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.engines.fidelity import Fidelity, list_presets
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps import generation
from brainbench.stimuli.sweeps.generation import generate
from brainbench.stimuli.sweeps.plan import BuiltObject, GenerationPlan, GenerationSettings
from brainbench.stimuli.sweeps.sweep_scenes import SweepGrid
from tests.factories.sweep_batches import GRID, files_of, small_plan


@pytest.fixture(scope="module")
def plan():
    return small_plan(("brick:4", "cone:4"), shard_size=4)


@pytest.fixture(scope="module")
def unbroken(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    generate(plan, folder, workers=1)
    return folder


def test_the_pipeline_behind_a_gpu_writes_the_same_bytes(plan, unbroken, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "worker_pool", _threads)
    shutil.copy(unbroken / "config.json", tmp_path)
    done = []
    generation.run_pipelined(plan.shards, tmp_path, 2, done.append)
    assert sum(done) == 32
    expected = {name: data for name, data in files_of(unbroken).items() if name != "manifest.json"}
    assert files_of(tmp_path) == expected


@pytest.mark.parametrize(("processes", "ahead"), [(1, 5), (4, 8), (40, 8)])
def test_objects_are_built_one_by_one_and_as_many_ahead_as_keep_processes_busy(processes, ahead, monkeypatch):
    plan = small_plan(("brick:8",), shard_size=4)
    asked = []

    class Pool:
        def submit(self, build, item):
            asked.append(item.name)
            done = Future()
            done.set_result(build(item))
            return done

    monkeypatch.setattr(
        generation, "build_object", lambda item, *, settings, grid: BuiltObject(None, f"no {item.name}")
    )
    for count, (task, objects) in enumerate(generation._built_ahead(plan.shards, Pool(), processes)):
        assert len(asked) == min(8, ahead + count)
        assert [one.reason for one in objects] == [f"no {item.name}" for item in task.objects]
    assert asked == [item.name for task in plan.shards for item in task.objects]


@pytest.mark.gpu
def test_shards_at_once_on_a_gpu_are_those_one_after_the_other(tmp_path, monkeypatch):
    plan = small_plan(("brick:4", "cone:4"), backend="rod", device="cuda", shard_size=4, whiskers="C1,C2,C3")
    generate(plan, tmp_path / "together", workers=2)
    monkeypatch.setattr(generation, "SIDE_BY_SIDE", 1)
    generate(plan, tmp_path / "alone", workers=2)
    assert files_of(tmp_path / "together") == files_of(tmp_path / "alone")


@pytest.mark.slow
def test_several_gpus_share_the_shards_and_write_the_same_bytes(plan, unbroken, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "gpus", lambda: ["0", "1"])
    done = []
    generation.run_on_gpus(plan.shards, tmp_path, 2, done.append)
    assert done == [len(task) for task in plan.shards]
    expected = {name: data for name, data in files_of(unbroken).items() if name.startswith(("train", "val", "test"))}
    assert files_of(tmp_path) == expected


@pytest.mark.slow
def test_what_went_wrong_on_one_of_several_gpus_is_told(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "gpus", lambda: ["0", "1"])
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        generation.run_on_gpus(plan.shards, tmp_path / "file", 2, print)


def test_a_process_of_a_gpu_that_dies_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "gpus", lambda: ["0", "1"])
    monkeypatch.setattr(generation, "_run_share", os._exit)
    # Two shards that no process comes to.
    with pytest.raises(DataError, match="ended unexpectedly"):
        generation.run_on_gpus([None, None], tmp_path, 2, print)


def test_a_shard_that_fails_ends_the_others_and_is_told(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "worker_pool", _threads)
    monkeypatch.setattr(generation, "write_shard", _refuse)
    told = []
    monkeypatch.setattr(generation, "stop_pool", lambda pool: told.append(generation.STOPPING.is_set()))
    with pytest.raises(DataError, match="disk"):
        generation.run_pipelined(plan.shards, tmp_path, 2, print)
    assert told == [True]
    assert not generation.STOPPING.is_set()


def _refuse(content, folder):
    raise DataError("the disk is full")


def _threads(processes):
    """A pool of threads in place of one of processes: quick to start."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(processes)


def test_the_manifest_tells_of_every_shard_object_and_split(plan, unbroken):
    manifest = json.loads((unbroken / "manifest.json").read_text())
    assert manifest["config_hash"] == plan.config_hash
    assert manifest["sweeps"] == 32
    assert {split: item["sweeps"] for split, item in manifest["splits"].items()} == {
        "train": 16, "validation": 8, "test": 8,
    }  # fmt: skip
    assert [item["name"] for item in manifest["shards"]] == sorted(
        (path.name for path in unbroken.glob("*.h5")), key=[task.name for task in plan.shards].index
    )
    assert sum(item["sweeps"] for item in manifest["shards"]) == 32
    assert all(item["bytes"] == (unbroken / item["name"]).stat().st_size for item in manifest["shards"])
    brick = manifest["objects"]["brick-0"]
    assert brick["label"] == "brick"
    assert len(brick["hash"]) == 16
    assert sum(brick["sweeps"].values()) == 4
    assert manifest["unstable"] == manifest["unusable"] == 0
    assert 0 < manifest["steps"] < 3 * manifest["steps_in_full"]
    assert manifest["unsolved"] == 0
    assert "time" not in manifest["provenance"]


def test_an_object_that_every_sweep_misses_is_named(tmp_path, caplog):
    # The origin of a part of a larger drawing may lie far away from it.
    part = trimesh.creation.box((24, 24, 24))
    part.export(tmp_path / "near.stl")
    part.apply_translation((0, 0, 200))
    part.export(tmp_path / "far.stl")
    objects = resolve_objects([str(tmp_path / "*.stl")], unit="mm")
    settings = GenerationSettings(Fidelity.preset("fast"))
    plan = GenerationPlan("mine", SweepGrid(speed=(0.06,), start=0.016), objects, settings, whiskers="C2")
    manifest = generate(plan, tmp_path / "out", workers=1)
    assert {name: item.get("untouched", False) for name, item in manifest["objects"].items()} == {
        "far": True, "near": False,
    }  # fmt: skip
    assert [record.args[0] for record in caplog.records if "no whisker touches" in record.msg] == ["far"]


def test_shards_that_are_there_are_left_alone_and_missing_ones_are_made_again(plan, unbroken, tmp_path):
    folder = tmp_path / "set"
    shutil.copytree(unbroken, folder)
    (folder / "manifest.json").unlink()
    (folder / plan.shards[1].name).unlink()
    # A kill leaves this.
    (folder / ".train-00001-0123456789abcdef.h5").write_bytes(b"half a shard")
    kept = folder / plan.shards[0].name
    before = kept.stat().st_mtime_ns
    seen = []
    generate(plan, folder, workers=1, progress=lambda *told: seen.append(told))
    assert seen == [(4, 4, "simulating sweeps")]
    assert kept.stat().st_mtime_ns == before
    assert files_of(folder) == files_of(unbroken)


def test_a_shard_cut_off_by_a_power_cut_is_made_again(plan, unbroken, tmp_path):
    folder = tmp_path / "set"
    shutil.copytree(unbroken, folder)
    os.truncate(folder / plan.shards[2].name, 300)
    generate(plan, folder, workers=1)
    assert files_of(folder) == files_of(unbroken)


def test_a_set_of_sweeps_has_the_hash_that_it_always_had(tmp_path, monkeypatch):
    # Too far away to be felt: what whiskers feel has last digits that differ between processors.
    far = dataclasses.replace(GRID, distance=(0.05,), height=(-0.002, 0.0, 0.002))
    plan = small_plan(("brick:2", "cone:1"), grid=far, backend="rod", shard_size=5, whiskers="C1,C2,C3", errors=0)
    manifest = generate(plan, tmp_path / "set", workers=1)
    assert (manifest["sweeps"], manifest["steps"], manifest["unstable"]) == (18, 0, 0)
    # Of commit a79787b0, with the table ``straight`` since version 12 of the physics.
    assert manifest["content_hash"] == "47c0513dabfe1ce0"
    monkeypatch.setattr(generation, "worker_pool", _threads)
    generation.run_pipelined(plan.shards, tmp_path, 1, print)
    assert all(
        (tmp_path / "set" / task.name).read_bytes() == (tmp_path / task.name).read_bytes() for task in plan.shards
    )


@pytest.mark.parametrize(("share", "sweeps"), [(0.05, 4), (1, 16)])
def test_a_data_set_states_the_errors_of_whiskers_in_sweeps_of_every_object(tmp_path, share, sweeps):
    plan = small_plan(("brick:2", "cone:2"), backend="rod", errors=share, fidelity=Fidelity.parse("fast,twist=false"))
    manifest = generate(plan, tmp_path, workers=1)
    count, values = 0, []
    for task in plan.shards:
        with h5py.File(tmp_path / task.name) as file:
            error, touched = file["error"][:], file["contact"][:] > 0
            estimated = np.isfinite(error).any(axis=1)
            assert set(file["owner"][:][estimated]) == set(range(len(task.objects)))
            assert (error[estimated] >= 0).all()
            count += int(estimated.sum())
            values += error[touched & np.isfinite(error)].tolist()
    assert count == sweeps
    errors = manifest["errors"]
    assert errors["whiskers"] == len(values) > 0
    assert (errors["worst"], errors["beyond"]) == (pytest.approx(max(values)), sum(value > 0.1 for value in values))
    assert 0 < errors["median"] <= errors["q90"] <= errors["worst"]


def test_a_setting_means_the_same_on_a_gpu_as_on_a_processor():
    for name in list_presets():
        on_both = [GenerationSettings(Fidelity.preset(name), device=device).fidelity for device in ("cpu", "cuda")]
        assert on_both[0] == on_both[1] == Fidelity.preset(name).resolved(twist=True)


@pytest.mark.skipif(warp().is_cuda_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_told(tmp_path):
    plan = small_plan(("brick:1",), backend="rod", device="cuda")
    with pytest.raises(UsageError, match="0 CUDA devices"):
        generate(plan, tmp_path, workers=1)


@pytest.mark.slow
def test_several_processes_write_the_same_bytes(plan, unbroken, tmp_path):
    generate(plan, tmp_path / "set", workers=2)
    assert files_of(tmp_path / "set") == files_of(unbroken)


def test_another_data_set_in_the_folder_is_refused_and_named(unbroken, tmp_path):
    with pytest.raises(UsageError, match=r"another data set: whiskers\.names .*, seed 0 \(now 3\)"):
        generate(small_plan(("brick:4", "cone:4"), shard_size=4, seed=3, whiskers="C2"), unbroken)
    (tmp_path / "thesis.docx").write_text("")
    with pytest.raises(UsageError, match=r"'thesis\.docx'"):
        generate(small_plan(), tmp_path)


def test_a_first_try_that_made_nothing_does_not_stand_in_the_way(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"seed": 7}))
    plan = small_plan(("brick:1",), limit=1)
    generate(plan, tmp_path, workers=1)
    assert json.loads((tmp_path / "config.json").read_text()) == json.loads(json.dumps(plan.config))


def test_a_disk_that_is_too_small_is_said_before_anything_is_simulated(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(1e9, 1e9 - 60e6, 60e6))
    with pytest.raises(DataError, match=r"16 sweeps .*60 MB .*--limit"):
        generate(small_plan(), tmp_path / "set")
    assert not list((tmp_path / "set").glob("*.h5"))


def test_two_runs_do_not_write_one_folder_at_a_time(plan, unbroken):
    import fcntl

    handle = os.open(unbroken, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match=f"process .*{unbroken.name}'"):
            generate(plan, unbroken)
    finally:
        os.close(handle)
    assert generate(plan, unbroken)["sweeps"] == 32


def test_an_object_that_changed_between_shards_is_found(tmp_path):
    plan = small_plan(("brick:1",), split="sweep", shard_size=2)
    folder = tmp_path / "set"
    generate(plan, folder, workers=1)
    import h5py

    with h5py.File(folder / plan.shards[0].name, "r+") as file:
        file["object_hash"][0] = b"0" * 16
    with pytest.raises(DataError, match=r"'brick-0' .*0000000000000000"):
        generate(plan, folder, workers=1)


def test_the_remaining_time_is_logged(tmp_path, caplog):
    with caplog.at_level(logging.INFO, logger="brainbench.stimuli.sweeps.generation"):
        generate(small_plan(("brick:1",), limit=1), tmp_path / "set")
    assert "1 of 1 sweeps" in caplog.text
    assert "sweeps/s, about 0:00:00 left" in caplog.text


def test_no_workers_are_refused(tmp_path):
    with pytest.raises(UsageError, match=r"workers .*received 0"):
        generate(small_plan(), tmp_path, workers=0)
