import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import pytest

import brainbench
from brainbench.cli import main
from leaderboards.store import write_record
from tests.factories.records import make_record

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
    # The shell is the one named, not the one among the parents of the process, of which there may be none.
    environment = {**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    words = [sys.executable, "-c", code, "--show-completion", "bash"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
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


@pytest.mark.slow
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


@pytest.fixture
def boards(tmp_path) -> tuple[str, str]:
    """Two folders of records, the second with one more model."""
    for folder, names in {"before": ("zhuang",), "after": ("zhuang", "ünet")}.items():
        for name in names:
            write_record(make_record(name), tmp_path / folder)
    return str(tmp_path / "before"), str(tmp_path / "after")


def _command(*words: str, stdout=subprocess.PIPE, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "brainbench", *words], stdout=stdout, stderr=subprocess.PIPE, check=False,
        encoding=environment.get("PYTHONIOENCODING", "utf-8"),
        env={**os.environ, **environment},
    )  # fmt: skip


@pytest.mark.slow
def test_a_board_is_built_without_docstrings_and_has_the_same_schema(boards, tmp_path):
    for level in ("", "2"):
        done = _command(
            "leaderboard", "build", boards[1], "--out", str(tmp_path / f"site{level}"), PYTHONOPTIMIZE=level
        )
        assert done.returncode == 0, done.stderr
    schemas = {(tmp_path / name / "data" / "record.schema.json").read_bytes() for name in ("site", "site2")}
    assert len(schemas) == 1


@pytest.mark.slow
@pytest.mark.parametrize("words", [("models", "list"), ("stimuli", "objects"), ("--help",), ("doctor",)])
def test_commands_need_no_docstrings(words):
    done = _command(*words, PYTHONOPTIMIZE="2")
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_characters_that_a_terminal_lacks_are_replaced(boards, encoding):
    done = _command("leaderboard", "diff", *boards, PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr) == (0, "")
    assert "added" in done.stdout
    data = _command("leaderboard", "diff", *boards, "--json", PYTHONIOENCODING="ascii")
    assert json.loads(data.stdout)["changes"][0]["name"] == "ünet (seed 3)"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize(
    "words", [("leaderboard", "diff"), ("leaderboard", "diff", "--json"), ("--help",), ("--version",)]
)
def test_a_full_output_is_one_sentence(boards, words):
    with Path("/dev/full").open("w") as full:
        done = _command(*words[:2], *(boards if "diff" in words else ()), *words[2:], stdout=full)
    assert done.returncode == 1
    assert done.stderr == "brainbench: The output cannot be written (No space left on device).\n"


@pytest.mark.skipif(os.name != "posix", reason="no shell that closes streams")
def test_streams_that_are_closed_are_as_if_nobody_reads_them():
    command = [sys.executable, "-m", "brainbench", "models", "show"]
    shown = subprocess.run(["sh", "-c", '"$@" <&- >&-', "-", *command, "zhuang"], stderr=subprocess.PIPE, check=False)
    assert (shown.returncode, shown.stderr) == (0, b"")
    refused = subprocess.run(["sh", "-c", '"$@" 2>&-', "-", *command, "none"], stdout=subprocess.PIPE, check=False)
    assert (refused.returncode, refused.stdout) == (2, b"")


@pytest.mark.parametrize(
    "words",
    [
        ("models", "add", "{}.py:Mine", "--name", "mine"), ("leaderboard", "verify", "{}"),
        ("stimuli", "objects", "{}"),
        ("leaderboard", "build", "{}", "--out", "site"), ("benchmark", "check", "{}"), ("recordings", "inspect", "{}"),
    ],
)  # fmt: skip
def test_a_name_longer_than_the_system_allows_is_one_sentence(run, words):
    outcome = run(*(word.format("/none" * 2000) for word in words))
    assert (outcome.status in (1, 2), outcome.out, outcome.err.count("\n")) == (True, "", 1)
    assert "File name too long" in outcome.err
    assert len(outcome.err) < 420


def test_no_place_for_temporary_files_is_one_sentence(run, tmp_path, monkeypatch):
    # A full disk looks like this, too: Python tries to write a file.
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path / "none")])
    for name in ("a.h5", "b.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            file["x"] = [1.0]
    ended = run("recordings", "inspect", str(tmp_path))
    assert (ended.status, ended.out, ended.err.count("\n")) == (1, "", 1)
    assert ended.err.startswith("brainbench: No folder for temporary files has room")


@pytest.mark.skipif(os.name != "posix", reason="a folder in use cannot be deleted")
def test_a_deleted_working_folder_is_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    monkeypatch.setattr("sys.argv", ["brainbench", "leaderboard", "add", "records", "--to", "board"])
    with pytest.raises(
        SystemExit, match=r"^brainbench: The current folder was deleted; change into one that exists\.$"
    ):
        main()


@pytest.mark.parametrize("words", [("models", "show", "local-dir:~nobody9/x"), ("recordings", "inspect", "~nobody9/x")])
def test_a_home_that_nobody_has_is_one_sentence(run, words):
    ended = run(*words)
    assert (ended.status, ended.out) == (2, "")
    assert "begins with the ~ of a user that there is not" in ended.err
