import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from brainbench.core.errors import DataError, MissingDependencyError, UsageError
from brainbench.core.runs import jobs
from brainbench.stimuli.sweeps import generation
from brainbench.stimuli.sweeps.generation import generate
from tests.factories.sweep_batches import files_of, killed_plan, small_plan

distributed = pytest.importorskip("distributed")


@pytest.fixture
def threads():
    """A cluster of two threads in this process: quick to start."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, protocol="tcp", host="127.0.0.1"
    ) as running:
        yield running


def test_a_cluster_writes_the_bytes_of_a_local_run(threads, tmp_path):
    plan = small_plan(shard_size=4, limit=2)
    seen = []
    generate(plan, tmp_path / "a", scheduler=threads.scheduler_address, progress=lambda *told: seen.append(told))
    assert seen[-1][:2] == (8, 8)
    generate(plan, tmp_path / "b", workers=1)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


def test_a_cluster_only_makes_what_is_missing(threads, tmp_path):
    plan = small_plan(shard_size=4, limit=2)
    generate(plan, tmp_path, workers=1)
    (tmp_path / plan.shards[0].name).unlink()
    seen = []
    generate(plan, tmp_path, scheduler=threads.scheduler_address, progress=lambda *told: seen.append(told))
    assert [told[1:] for told in seen] == [(seen[-1][0], "simulating sweeps")]
    assert 0 < seen[-1][0] < plan.sweeps


def test_workers_that_write_to_a_disk_of_their_own_are_noticed(threads, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "make_shard", _write_elsewhere)
    with pytest.raises(DataError, match=r"\w+-00000\.h5, .*all workers"):
        generate(small_plan(("brick:2",), split="object", limit=1), tmp_path, scheduler=threads.scheduler_address)


def _write_elsewhere(task, folder, workers):
    """Do as a worker does whose folder of this name is another one."""
    return len(task)


@pytest.mark.slow
def test_a_worker_killed_during_the_run_costs_nothing(tmp_path):
    plan = killed_plan()
    with distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as running:
        killed = []

        def kill() -> None:
            while not list(tmp_path.glob("a/train-*.h5")):
                time.sleep(0.01)
            with distributed.Client(running, set_as_default=False) as client:
                pids = client.run(os.getpid)
            os.kill(next(iter(pids.values())), signal.SIGKILL)
            killed.append(len(list(tmp_path.glob("a/*.h5"))))

        killer = threading.Thread(target=kill)
        killer.start()
        generate(plan, tmp_path / "a", scheduler=running.scheduler_address)
        killer.join()
    assert killed[0] < len(plan.shards)
    generate(plan, tmp_path / "b", workers=1)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


def test_no_scheduler_at_the_address_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "TIMEOUT", 0.5)
    with pytest.raises(UsageError, match=r"'tcp://.*dask scheduler"):
        generate(small_plan(), tmp_path, scheduler="tcp://127.0.0.1:9")


def test_without_dask_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"\[cluster\]"):
        generate(small_plan(), tmp_path, scheduler="tcp://127.0.0.1:9")


def test_a_local_run_loads_no_dask():
    code = "import sys, brainbench.stimuli.sweeps.generation\n"
    code += "assert not {'dask', 'distributed', 'h5py'} & set(sys.modules), sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)
