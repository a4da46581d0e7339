"""The benchmarks' own machinery: kernels compiled without a GPU, readings taken along, tables of records."""

from __future__ import annotations

import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

from robotics_bridge.physics import HandState
from tests.factories.benchmark_programs import benchmark_program

ROOT = Path(__file__).parents[2]
PROGRAM = """
import numpy as np, warp as wp
from brainbench.core.devices import pick_device, warp

@wp.kernel(module="unique")
def add(x: wp.array(dtype=float), y: float):
    i = wp.tid()
    x[i] = x[i] + y

wp = warp()
device = pick_device("cuda")
x = wp.zeros(8, dtype=float, device=device)
with wp.ScopedCapture(device) as capture:
    wp.launch(add, dim=8, inputs=[x, 1.0], device=device)
wp.capture_launch(capture.graph)
print(device.is_cuda, x.numpy().sum())
"""


@pytest.mark.slow
def test_kernels_are_compiled_for_a_gpu_that_is_not_there(tmp_path: Path) -> None:
    script, archive = tmp_path / "program.py", tmp_path / "kernels.tar.xz"
    script.write_text(PROGRAM)
    command = [
        sys.executable,
        str(ROOT / "benchmarks" / "whiskers" / "precompile.py"),
        "--folder",
        str(tmp_path / "kept"),
    ]

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*command, *more, str(script)], capture_output=True, text=True, check=True, cwd=ROOT)

    first = run("--pack", str(archive))
    assert first.stdout.split() == ["True", "0.0"]
    assert "1 modules" in first.stderr
    with tarfile.open(archive) as packed:
        names = packed.getnames()
    assert [Path(name).suffix for name in sorted(names)] == [".meta", ".cubin"]
    assert all("add" in name and name.split("/")[0].count(".") == 2 for name in names)
    assert "0 modules" in run().stderr


def test_a_state_that_is_kept_and_repeated_is_the_same() -> None:
    rng = np.random.default_rng(0)
    state = HandState.empty(2, 3, 5)
    state.set_pose(rng.normal(size=(2, 3, 7)))
    state.set_velocity(rng.normal(size=(2, 3, 6)))
    state.set_contacts([1, 0, 1], [(0, 1), (0, 2), (2, 1)], distance=[-1.0, -2.0, -3.0], force=[1.0, 2.0, 3.0])
    scene = benchmark_program("tactile.scene")
    found = scene.snapshot(state)
    assert found["env"].tolist() == [0, 1, 1]
    again = scene.snapshot(scene.restore(found, 5, "cpu"))
    np.testing.assert_array_equal(again["pose"], found["pose"][[0, 1, 0, 1, 0]])
    assert again["env"].tolist() == [0, 1, 1, 2, 3, 3, 4]
    assert again["distance"].tolist() == [-2, -1, -3, -2, -1, -3, -2]
    np.testing.assert_array_equal(again["geom"][5], found["geom"][2])
    assert scene.CHECKED > 2


def test_the_last_record_of_a_case_is_laid_out() -> None:
    base = {"device": "gpu", "part": "step", "case": "none", "share": 1.0}
    rows = [{**base, "envs": n, "env_steps_per_s": rate} for n, rate in ((8, 1.0), (16, 2.0), (8, 3.0))]
    (heading, body) = benchmark_program("tactile.tables").tables(rows)["step"]
    assert heading == "Tactile whole step on the pyramid (gpu)"
    assert [line.split(" | ")[2] for line in body.splitlines()[2:]] == ["3", "2"]
