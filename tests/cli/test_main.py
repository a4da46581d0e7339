import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer

import brainbench
from brainbench.cli import app
from brainbench.cli.application import COMMANDS as COMMAND_HELP
from brainbench.cli.application import OPTIONAL
from brainbench.core.plugins import optional_parts

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


def test_the_public_names_resolve():
    for name in brainbench.__all__:
        assert getattr(brainbench, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'scoer'"):
        _ = brainbench.scoer


def test_help_lists_the_commands(run):
    result = run("--help")
    assert result.status == 0
    for command in COMMANDS:
        assert command in result.out


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(run, command: str):
    result = run(command, "--help")
    assert result.status == 0
    assert "Usage" in result.out


def test_version_is_the_package_version(run):
    assert run("--version").out.strip() == brainbench.__version__


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


def test_the_help_of_all_commands_says_what_each_of_them_says():
    shown = typer.main.get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]
    optional = {name: part.summary for name, part in optional_parts(OPTIONAL).items() if "." not in name}
    assert {name: command.help.splitlines()[0] for name, command in shown.items()} == {**COMMAND_HELP, **optional}


def test_a_command_of_another_package_is_listed_and_a_broken_one_is_announced(run, tmp_path, monkeypatch, caplog):
    (tmp_path / "elsewhere.py").write_text(
        "from brainbench.cli.output import Output\n"
        "def greet(name: str) -> Output:\n    'Say hello.'\n    return Output({'name': name}, f'hello {name}')\n"
    )
    (tmp_path / "broken_elsewhere.py").write_text("raise RuntimeError('out of order')\n")
    info = tmp_path / "elsewhere-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: elsewhere\nVersion: 1.0\n")
    entries = "[brainbench.commands]\ngreet = elsewhere:greet\nstimuli.broken = broken_elsewhere:command\n"
    (info / "entry_points.txt").write_text(entries)
    monkeypatch.syspath_prepend(tmp_path)
    assert "Say hello." in run("--help").out
    assert run("greet", "you").out == "hello you\n"
    assert "simulate" in run("stimuli", "--help").out
    assert "'stimuli broken'" in caplog.text
    assert "out of order" in caplog.text
    assert "out of order" in run("stimuli", "broken").err


@pytest.mark.parametrize("words", [["score", "--help"], ["stimuli", "render", "--help"], ["--help"], ["-v", "doctor"]])
def test_no_more_is_imported_than_the_command_that_is_asked_for(words: list[str]):
    code = f"import sys; from brainbench.cli.application import build; build({words!r})"
    found = {name.split(".")[2] for name in _all_modules_after(code) if name.startswith("brainbench.cli.")}
    assert found & set(COMMAND_HELP) == {*words} & set(COMMAND_HELP)


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


def test_ctrl_c_does_not_wait_for_a_compiler_in_a_thread():
    code = """
import threading, time
import brainbench.cli as cli
from brainbench.core.progress import PREPARATION

def interrupted():
    threading.Thread(target=time.sleep, args=(60,), name=PREPARATION).start()
    raise KeyboardInterrupt

cli._run = interrupted
cli.main()
"""
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == 130
    assert "same command" in done.stderr
