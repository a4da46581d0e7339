"""What a command needs is asked before its input is read: extras, and a cache that can be written."""

from __future__ import annotations

import os
import sys

import pytest

from brainbench.cli import app
from brainbench.cli.requirements import CACHED, DISTRIBUTIONS, EXTRAS, check_requirements, commands, needs_of
from brainbench.core.errors import FileWriteError, MissingDependencyError

WORDS = {
    "export": ("no-such-model",),
    "policy export": ("no-such-policy",),
    "policy train": ("no-such-task",),
    "policy distill": ("no-such-task", "--teacher", "none"),
    "policy sweep": ("none.toml",),
    "policy play": ("no-such-task", "--video", "film.mp4"),
    "policy report": ("none", "--picture", "x.png"),
    "policy deploy": ("none", "--record", "session"),
    "policy evaluate": ("no-such-task",),
    "stimuli render": ("no-such-scene", "--out", "film.mp4"),
    "stimuli plot": ("no-such-scene", "--out", "x.png"),
    "stimuli separability": ("none",),
    "stimuli simulate": ("no-such-scene",),
    "stimuli sweep": ("no-such-grid", "--out", "set", "--scheduler", "tcp://127.0.0.1:9"),
    "stimuli hand": ("--hand", "no-such-hand"),
    "recovery": ("--out", "made", "--scheduler", "tcp://127.0.0.1:9"),
    "leaderboard add": ("no-such-model", "--scheduler", "tcp://127.0.0.1:9"),
    "leaderboard report": ("none", "--out", "x.pdf"),
    "leaderboard verify": ("none",),
    "tradeoff score": (),
    "tactile demo": ("--hand", "no-such-hand"),
    "tactile bench": (),
    "train": ("no-such-model", "--data", "none"),
    "score": ("no-such-model",),
    "recordings compare": ("none.h5", "no-such-model"),
    "power": (),
    "benchmark make": ("--recordings", "none", "--out", "lab.toml"),
    "benchmark check": ("none",),
}
"""Command lines whose input does not exist: that would be told next."""


NEEDS = {name: needs_of(name, command.callback) for name, command in commands(app)}


def _packages():
    return [(name, module) for name, needs in NEEDS.items() for item in needs.packages for module in item.packages]


def test_the_table_names_commands_that_exist():
    assert {*EXTRAS, *CACHED} <= {name for name, _ in commands(app)}


@pytest.mark.parametrize(("command", "module"), _packages())
def test_a_missing_package_is_told_before_the_input_is_read(run, tmp_path, monkeypatch, command, module):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "cache"))
    for name in {name for needs in NEEDS.values() for item in needs.packages for name in item.packages} - {module}:
        # All others are there, whatever is installed here.
        monkeypatch.setitem(sys.modules, name, sys.modules.get(name) or _module(name))
    monkeypatch.setitem(sys.modules, module, None)
    outcome = run(*command.split(), *WORDS[command])
    assert outcome.status != 0
    assert DISTRIBUTIONS.get(module, module) in outcome.err
    assert "Traceback" not in outcome.err
    assert sorted(path.name for path in tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [name for name, needs in NEEDS.items() if needs.cache])
def test_an_unwritable_cache_is_told_before_the_input_is_read(run, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    cache = tmp_path / "cache"
    cache.mkdir()
    monkeypatch.setenv("BRAINBENCH_CACHE", str(cache))
    writable = os.access
    # Whoever runs the tests may be allowed everything.
    monkeypatch.setattr(os, "access", lambda path, mode: path != cache and writable(path, mode))
    outcome = run(*command.split(), *WORDS[command])
    assert outcome.status != 0
    assert str(cache)[-30:] in outcome.err
    assert "Traceback" not in outcome.err


def test_what_is_not_asked_for_is_not_needed(tmp_path, monkeypatch):
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setitem(sys.modules, "onnx", None)
    check_requirements(NEEDS["export"], {"format": "torch"})
    with pytest.raises(MissingDependencyError):
        check_requirements(NEEDS["export"], {"format": "onnx"})
    (tmp_path / "file").touch()
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "file" / "cache"))
    check_requirements(NEEDS["doctor"], {})
    with pytest.raises(FileWriteError):
        check_requirements(NEEDS["score"], {})


def _module(name):
    import importlib.machinery
    import types

    made = types.ModuleType(name)
    made.__spec__ = importlib.machinery.ModuleSpec(name, None)
    return made


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [
        ("policy train", "--minutes", "nan"),
        ("policy distill", "--stop-after", "inf"),
        ("policy deploy", "--timeout", "nan"),
        ("stimuli render", "--step", "nan"),
        ("leaderboard verify", "--tolerance", "nan"),
        ("power", "--target", "-inf"),
        ("score", "--units-reliability", "nan"),
    ],
)
def test_a_number_that_is_none_is_refused(run, command, option, value):
    # Under --minutes nan a training went on without end: no time is later than that.
    outcome = run(*command.split(), *WORDS[command], option, value)
    assert outcome.status != 0
    assert f"takes a finite number; received {float(value)}" in " ".join(outcome.err.split())


def test_a_tolerance_below_nothing_is_refused(run):
    outcome = run("leaderboard", "verify", *WORDS["leaderboard verify"], "--tolerance", "-1")
    assert outcome.status == 2
    assert "tolerance" in outcome.err


def test_every_command_is_guarded():
    assert all(getattr(command, "guarded", False) for _, command in commands(app))
