import os
import shutil
from concurrent.futures import Future

import pytest

from brainbench.core.errors import DataError
from brainbench.stimuli.sweeps import running
from brainbench.stimuli.sweeps.generation import generate
from brainbench.stimuli.sweeps.shards import BuiltObject
from tests.factories.sweep_batches import files_of, small_plan


@pytest.fixture(scope="module")
def plan():
    return small_plan(("brick:4", "cone:4"), shard_size=4)


@pytest.fixture(scope="module")
def unbroken(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    generate(plan, folder, workers=1)
    return folder


def test_the_pipeline_behind_a_gpu_writes_the_same_bytes(plan, unbroken, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "worker_pool", _threads)
    shutil.copy(unbroken / "config.json", tmp_path)
    done = []
    running.run_pipelined(plan.shards, tmp_path, 2, done.append)
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

    monkeypatch.setattr(running, "build_object", lambda item, *, settings, grid: BuiltObject(None, f"no {item.name}"))
    for count, (task, objects) in enumerate(running._built_ahead(plan.shards, Pool(), processes)):
        assert len(asked) == min(8, ahead + count)
        assert [one.reason for one in objects] == [f"no {item.name}" for item in task.objects]
    assert asked == [item.name for task in plan.shards for item in task.objects]


@pytest.mark.gpu
def test_shards_at_once_on_a_gpu_are_those_one_after_the_other(tmp_path, monkeypatch):
    plan = small_plan(("brick:4", "cone:4"), backend="rod", device="cuda", shard_size=4, whiskers="C1,C2,C3")
    generate(plan, tmp_path / "together", workers=2)
    monkeypatch.setattr(running, "SIDE_BY_SIDE", 1)
    generate(plan, tmp_path / "alone", workers=2)
    assert files_of(tmp_path / "together") == files_of(tmp_path / "alone")


@pytest.mark.slow
def test_several_gpus_share_the_shards_and_write_the_same_bytes(plan, unbroken, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "gpus", lambda: ["0", "1"])
    done = []
    running.run_on_gpus(plan.shards, tmp_path, 2, done.append)
    assert done == [len(task) for task in plan.shards]
    expected = {name: data for name, data in files_of(unbroken).items() if name.startswith(("train", "val", "test"))}
    assert files_of(tmp_path) == expected


@pytest.mark.slow
def test_what_went_wrong_on_one_of_several_gpus_is_told(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "gpus", lambda: ["0", "1"])
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        running.run_on_gpus(plan.shards, tmp_path / "file", 2, print)


def test_a_process_of_a_gpu_that_dies_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "gpus", lambda: ["0", "1"])
    monkeypatch.setattr(running, "_run_share", os._exit)
    # Two shards that no process comes to.
    with pytest.raises(DataError, match="ended unexpectedly"):
        running.run_on_gpus([None, None], tmp_path, 2, print)


def test_a_shard_that_fails_ends_the_others_and_is_told(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "worker_pool", _threads)
    monkeypatch.setattr(running, "write_shard", _refuse)
    told = []
    monkeypatch.setattr(running, "stop_pool", lambda pool: told.append(running.STOPPING.is_set()))
    with pytest.raises(DataError, match="disk"):
        running.run_pipelined(plan.shards, tmp_path, 2, print)
    assert told == [True]
    assert not running.STOPPING.is_set()


def _refuse(content, folder):
    raise DataError("the disk is full")


def _threads(processes):
    """A pool of threads in place of one of processes: quick to start."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(processes)
