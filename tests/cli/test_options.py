import inspect
from dataclasses import fields, replace

import pytest

from brainbench.cli.options import (
    SCORE,
    SCORE_FLAGS,
    as_flags,
    numbers,
    option_fields,
    part_of,
    refuse,
    typed_options,
    with_options,
)
from brainbench.cli.output import Output
from brainbench.core.errors import UsageError
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
