from __future__ import annotations

import inspect
import os
import sys
from dataclasses import fields, replace
from importlib.util import find_spec

import pytest
from rich.text import Text
from typer.utils import get_params_from_function

from brainbench.cli import app
from brainbench.cli.options import (
    CACHED,
    DISTRIBUTIONS,
    EXTRAS,
    SCORE,
    SCORE_FLAGS,
    as_flags,
    check_requirements,
    commands,
    needs_of,
    numbers,
    option_fields,
    part_of,
    refuse,
    typed_options,
    with_options,
)
from brainbench.cli.output import Output
from brainbench.core.errors import FileWriteError, MissingDependencyError, UsageError
from brainbench.scoring import ScoreOptions

NAMES = [item.name for item in fields(ScoreOptions)]


def test_options_are_written_as_flags():
    assert as_flags(SCORE, ScoreOptions(), SCORE_FLAGS) == []
    options = replace(ScoreOptions(), layers=("a", "b"), normalize=False, explain=True, weights_seed=1)
    told = ["--layers", "a,b", "--no-normalize", "--weights-seed", "1", "--explain-estimator"]
    assert as_flags(SCORE, options, SCORE_FLAGS) == told
    assert set(option_fields(SCORE)) == set(NAMES)


def test_typed_flags_are_told_from_defaults():
    words = ["score", "zhuang", "-r", "data", "--seed=0", "--no-normalize", "--out", "x", "--json"]
    assert typed_options(words) == ["recordings", "normalize", "seed"]


def test_fields_of_one_name_stand_side_by_side_under_their_flags():
    encoder = "robotics_bridge.policies.encoders.arms:EncoderConfig"

    @with_options(SCORE, ("seed",), build=False)
    @with_options(
        encoder, ("seed", "name"), parameter="drawn", flags={"seed": ("--draw",)}, defaults={"seed": 5}, build=False
    )
    def command(options: dict, drawn: dict) -> Output:
        return Output(options, str(drawn))

    assert [(name, item.default) for name, item in inspect.signature(command).parameters.items()] == [
        ("seed", 0), ("draw", 5), ("name", "auto"),
    ]  # fmt: skip
    assert command(seed=1, draw=2, name="mlp") == Output({"seed": 1}, "{'seed': 2, 'name': 'mlp'}")
    with pytest.raises(UsageError, match="--draw must be"):
        command(seed=1, draw=-1, name="mlp")


def test_numbers_are_written_with_commas_or_as_a_size():
    assert numbers("3, 4,5", "--counts") == (3, 4, 5)
    assert numbers("640x480", "--size", count=2) == (640, 480)
    assert numbers("0.5,1", "--view", float, count=2) == (0.5, 1.0)


@pytest.mark.parametrize(
    ("text", "kind", "count", "words"),
    [("3,x", int, None, "whole numbers"), ("1,2", float, 3, "3 numbers"), ("1,2,inf", float, 3, "3 numbers")],
)
def test_what_are_no_such_numbers_is_told(text, kind, count, words):
    with pytest.raises(UsageError, match=f"--these takes {words} joined by commas; received '{text}'"):
        numbers(text, "--these", kind, count=count)


@pytest.mark.parametrize("text", ["4/4", "1", "-1/4", "a/b", "1/2/3", "0/0"])
def test_a_part_is_a_number_below_its_count(text):
    assert part_of("2/3", "--shard takes") == (2, 3)
    with pytest.raises(UsageError, match=r"--shard takes NUMBER/COUNT"):
        part_of(text, "--shard takes")


def test_options_that_mean_nothing_are_refused_together_and_defaults_are_not():
    refuse({"--a": None, "--b": False, "--c": ""}, "here")
    with pytest.raises(UsageError, match="--a and --c cannot be used for a picture"):
        refuse({"--a": 0, "--b": None, "--c": "x"}, "for a picture")


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        (("--out", "file/inside"), "file"),
        (("--report", "x.txt2"), "txt2"),
        (("--report", "none"), "'none'"),
        (("--report", "file/x.md"), "file"),
        (("--report", "."), "report"),
    ],
)
def test_score_refuses_what_it_cannot_write_before_anything_is_loaded(run, tmp_path, monkeypatch, options, culprit):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x")
    # The model does not exist either: that is found later.
    outcome = run("score", "no-such-model", *options)
    assert outcome.status == 2
    assert culprit in outcome.err
    assert "no-such-model" not in outcome.err
    assert outcome.out == ""


@pytest.mark.skipif(find_spec("weasyprint") is not None, reason="weasyprint is installed")
def test_a_pdf_without_its_engine_is_refused_at_once(run):
    assert "weasyprint" in run("score", "no-such-model", "--report", "x.pdf").err


@pytest.mark.parametrize("command", [("train", "zhuang-small", "--data", "none"), ("stimuli", "simulate", "rodgers")])
def test_other_commands_refuse_such_an_out_too(run, tmp_path, command):
    (tmp_path / "file").write_text("x")
    outcome = run(*command, "--out", str(tmp_path / "file" / "a"))
    assert (outcome.status, "--out" in outcome.err) == (2, True)


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (("stimuli", "fit", "none"), "--picture"),
        (("policy", "play", "in_palm_rotate"), "--video"),
        (("policy", "sweep"), "--out"),
        (("policy", "export", "none"), "--out"),
        (("leaderboard", "add", "none"), "--to"),
        (("leaderboard", "hold-out", "demo"), "--secret"),
        (("stimuli", "objects", "torus"), "--export"),
    ],
)
def test_every_option_that_names_a_destination_is_checked_first(run, tmp_path, command, option):
    (tmp_path / "file").write_text("x")
    outcome = run(*command, option, str(tmp_path / "file" / "a.png"))
    assert (outcome.status, option in outcome.err) == (2, True)


@pytest.mark.parametrize("command", [("stimuli", "convert", "none"), ("recordings", "export", "demo")])
def test_destinations_without_an_option_are_checked_first(run, tmp_path, command):
    (tmp_path / "file").write_text("x")
    outcome = run(*command, str(tmp_path / "file" / "a"))
    assert (outcome.status, str(tmp_path / "file") in outcome.err) == (2, True)


@pytest.mark.parametrize("command", [("stimuli", "fit", "none", "--picture")])
def test_a_picture_of_an_unknown_format_is_refused_first(run, tmp_path, command):
    outcome = run(*command, str(tmp_path / "x.txt2"))
    assert (outcome.status, "txt2" in outcome.err) == (2, True)


def test_a_cache_that_cannot_be_made_is_one_sentence(run, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "file" / "cache"))
    outcome = run("score", "pixels", "--out", str(tmp_path / "out"))
    assert outcome.status != 0
    assert "Traceback" not in outcome.err


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
    "tactile demo": ("--hand", "no-such-hand"),
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


@pytest.mark.parametrize("command", ["score", "power", "stimuli simulate"])
def test_an_unwritable_cache_is_told_and_does_not_stand_in_the_way(tmp_path, monkeypatch, caplog, command):
    cache = tmp_path / "cache"
    cache.mkdir()
    monkeypatch.setenv("BRAINBENCH_CACHE", str(cache))
    writable = os.access
    # Whoever runs the tests may be allowed everything.
    monkeypatch.setattr(os, "access", lambda path, mode: path != cache and writable(path, mode))
    check_requirements(NEEDS[command], {})
    assert f"The cache folder {cache} cannot be written" in caplog.text
    assert not list(cache.iterdir())


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


@pytest.mark.parametrize("name", [name for name, _ in commands(app)])
def test_no_word_of_a_help_is_lost_as_markup(name):
    parameters = get_params_from_function(dict(commands(app))[name].callback).values()
    helps = [text for item in parameters if (text := getattr(item.default, "help", None))]
    assert [text for text in helps if Text.from_markup(text).plain != text.replace("\\[", "[")] == []
