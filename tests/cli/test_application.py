import json
import subprocess
import sys

import pytest
import typer

from brainbench.cli import app
from brainbench.cli.application import COMMANDS as COMMAND_HELP
from brainbench.cli.application import OPTIONAL
from brainbench.core.plugins import optional_parts

COMMANDS = ["score", "models", "recordings", "stimuli", "leaderboard", "doctor"]


def _all_modules_after(statement: str) -> set[str]:
    code = f"{statement}\nimport sys, json\nprint(json.dumps([*sys.modules]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_help_lists_the_commands(run):
    result = run("--help")
    assert result.status == 0
    for command in COMMANDS:
        assert command in result.out


def test_the_help_of_all_commands_says_what_each_of_them_says():
    shown = typer.main.get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]
    optional = {name: part.summary for name, part in optional_parts(OPTIONAL).items() if "." not in name}
    assert {name: command.help.splitlines()[0] for name, command in shown.items()} == {**COMMAND_HELP, **optional}


def test_a_command_of_another_package_is_listed_and_a_broken_one_is_announced(run, tmp_path, monkeypatch, caplog):
    (tmp_path / "greeting.py").write_text(
        "from brainbench.cli.output import Output\n"
        "def greet(name: str) -> Output:\n    'Say hello.'\n    return Output({'name': name}, f'hello {name}')\n"
    )
    (tmp_path / "broken_greeting.py").write_text("raise RuntimeError('out of order')\n")
    info = tmp_path / "greeting-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: greeting\nVersion: 1.0\n")
    entries = "[brainbench.commands]\ngreet = greeting:greet\nstimuli.broken = broken_greeting:command\n"
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


@pytest.mark.parametrize(
    "words", [["score", "zhang-small"], ["export", "zhang-small"], ["train", "zhuang-small", "--data", "none"]]
)
def test_a_wrong_name_is_told_before_pytorch_is_imported(words: list[str]):
    code = f"import contextlib, sys; from brainbench.cli import main; sys.argv[1:] = {words!r}\n"
    modules = _all_modules_after(f"{code}with contextlib.suppress(SystemExit): main()")
    assert "torch" not in modules
