"""A run that is killed at any instant and started again leaves the bytes of a run that was not."""

import dataclasses
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from brainbench.core.errors import DataError
from brainbench.stimuli.sweeps.generation import generate
from tests.factories.sweep_batches import files_of, killed_plan, small_plan

ROOT = Path(__file__).parents[3]
CODE = """
import sys
from brainbench.stimuli.sweeps.generation import generate
from tests.factories.sweep_batches import killed_plan

if __name__ == "__main__":
    print("ready", flush=True)
    generate(killed_plan(), sys.argv[1], workers=int(sys.argv[2]))
"""


def _start(folder: Path, workers: int) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", CODE, str(folder), str(workers)], cwd=ROOT, env=environment, stdout=subprocess.PIPE
    )


def _kill_after(process: subprocess.Popen, seconds: float, shard_in: Path | None = None) -> bool:
    """Kill a process so long after it is ready, or after its next shard; return whether it still ran."""
    with process:
        assert process.stdout is not None
        before = len(list(shard_in.glob("*.h5"))) if shard_in else 0
        process.stdout.readline()
        while shard_in and process.poll() is None and len(list(shard_in.glob("*.h5"))) == before:
            time.sleep(0.005)
        time.sleep(seconds)
        running = process.poll() is None
        process.send_signal(signal.SIGKILL)
    return running


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    generate(killed_plan(), folder, workers=1)
    return folder


@pytest.mark.slow
def test_a_killed_run_goes_on_and_ends_with_the_same_bytes(unbroken, tmp_path):
    folder = tmp_path / "set"
    assert _kill_after(_start(folder, 1), 0.2)
    assert not (folder / "manifest.json").exists()
    generate(killed_plan(), folder, workers=1)
    assert files_of(folder) == files_of(unbroken)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_killed_at_many_instants_ends_with_the_same_bytes(unbroken, tmp_path, workers):
    draw = random.Random(workers)
    folder = tmp_path / "set"
    cut = 0
    for _ in range(12):
        # Often within a moment of starting and of a shard's end; between two kills at least a little is done.
        wait, after = (draw.uniform(0.0, 0.6), None) if workers == 1 else (draw.uniform(0.0, 0.2), folder)
        if not _kill_after(_start(folder, workers), wait, after):
            break
        cut += 1
    assert cut >= 3
    process = _start(folder, workers)
    process.communicate(timeout=120)
    assert process.returncode == 0
    assert files_of(folder) == files_of(unbroken)


@pytest.mark.slow
def test_no_process_of_the_pool_outlives_its_parent(tmp_path):
    process = _start(tmp_path / "set", 2)
    time.sleep(4)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert children
    _kill_after(process, 0)
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{child}").exists() for child in children):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def _end_this_process():
    os._exit(3)


@pytest.mark.slow
def test_a_process_of_the_pool_that_dies_is_said_and_the_shards_before_are_kept(tmp_path):
    plan = small_plan(("brick:6",), shard_size=4)
    fatal = dict(plan.objects)
    last = plan.shards[-1].objects[0].name
    fatal[last] = dataclasses.replace(fatal[last], load=_end_this_process)
    with pytest.raises(DataError, match=r"process .*memory.*finished is kept"):
        generate(dataclasses.replace(plan, objects=fatal), tmp_path, workers=2)
    generate(plan, tmp_path, workers=1)
    assert (tmp_path / "manifest.json").is_file()


@pytest.mark.slow
def test_a_script_that_asks_for_data_when_it_is_imported_is_told_where_to_put_the_call(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(CODE.replace('if __name__ == "__main__":', "if True:"))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, script, tmp_path / "set", "2"]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 1
    assert "this script asks again" in ended.stderr
    assert "works outside of: if __name__ == '__main__':" in ended.stderr.splitlines()[-1]
    assert not list((tmp_path / "set").glob("*.h5"))
