import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import brainbench

HEAVY = {"torch", "xarray", "h5py", "mujoco", "scipy", "trimesh", "pandas", "matplotlib", "plotly"}
COMMANDS = ["score", "models", "recordings", "stimuli", "leaderboard", "doctor"]


def _all_modules_after(statement: str) -> set[str]:
    code = f"{statement}\nimport sys, json\nprint(json.dumps([*sys.modules]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def _modules_after(statement: str) -> set[str]:
    return {name for name in _all_modules_after(statement) if "." not in name}


@pytest.mark.parametrize("statement", ["import brainbench", "import brainbench.cli", "import leaderboards"])
def test_importing_loads_nothing_heavy(statement: str):
    assert not _modules_after(statement) & HEAVY


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(run, command: str):
    result = run(command, "--help")
    assert result.status == 0
    assert "Usage" in result.out


def test_a_wrong_option_is_a_usage_error(run):
    assert run("score", "zhuang", "--nonsense").status == 2


def test_a_wrong_name_ends_with_status_two_and_one_line_on_stderr(run):
    result = run("models", "show", "zhuagn")
    assert result.status == 2
    assert result.out == ""
    assert "did you mean 'zhuang'" in result.err
    assert "Traceback" not in result.err


def test_unusable_data_ends_with_status_one(run, tmp_path):
    (tmp_path / "a.nwb").write_text("this is not HDF5")
    result = run("recordings", "inspect", str(tmp_path / "a.nwb"))
    assert result.status == 1
    assert "not an HDF5 file" in result.err


def test_shell_completion_can_be_shown():
    code = "from brainbench.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "--show-completion", "bash"], capture_output=True, text=True, check=False
    )
    assert "complete" in done.stdout.lower() + done.stderr.lower()


def test_ctrl_c_while_the_command_line_itself_is_imported_prints_no_traceback(tmp_path):
    (tmp_path / "typer.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    place = os.pathsep.join([str(tmp_path), str(Path(brainbench.__file__).parents[1])])
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); import brainbench.__main__ as m"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; m.main()"],
        env={**os.environ, "PYTHONPATH": place}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 130
    assert len(done.stderr.strip().splitlines()) == 1


def test_ctrl_c_is_answered_in_one_sentence_that_says_how_to_go_on(tmp_path):
    model, begun = tmp_path / "slow.py", tmp_path / "begun"
    model.write_text(f"import pathlib, time\npathlib.Path({str(begun)!r}).touch()\ntime.sleep(60)\n")
    words = [sys.executable, "-m", "brainbench", "models", "add", f"{model}:make", "--name", "slow"]
    # A shell's background jobs ignore Ctrl-C; what is started from here must not.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        signal.signal(signal.SIGINT, before)
        while running.poll() is None and not begun.exists():
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=60)
    assert running.returncode == 130
    assert len(err.strip().splitlines()) == 1
    assert "same command" in err
