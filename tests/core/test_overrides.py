"""Words become values of the kinds that annotations state."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

import pytest

from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.overrides import kind_of, read_pairs, read_value, with_changes


@dataclass(frozen=True)
@limited
class Solver:
    step: Annotated[float, Limit(above=0)] = 1e-3
    iterations: Count | None = 5
    order: Literal["first", "second"] = "first"
    twist: bool | None = None


@dataclass(frozen=True)
class Job:
    name: str = "press"
    solver: Solver = Solver()
    corner: tuple[float, float] = (0.0, 0.0)
    sizes: tuple[int, ...] = (1,)


def test_words_change_fields_and_those_of_parts():
    words = ["name=slide", "solver.step=2e-3", "solver.iterations=none", "solver.twist=True", "corner=1, 2", "sizes=3"]
    job = with_changes(Job(), read_pairs(words, "--change", "name=slide"))
    assert job == Job("slide", Solver(2e-3, None, twist=True), (1.0, 2.0), (3,))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("nme=slide", "Unknown field of Job 'nme'; did you mean 'name'?"),
        ("solver.stp=1", "Unknown field of Solver 'stp'; did you mean 'step'?"),
        ("solver.step=fast", "'step' takes a number, for instance 0.001; received 'fast'."),
        ("solver.step=nan", "'step' takes a number, for instance 0.001; received 'nan'."),
        ("solver.step=0", "step must be a finite number, above 0; received 0.0."),
        ("solver.iterations=2.5", "'iterations' takes a whole number, for instance 5; received '2.5'."),
        ("solver.order=frist", "did you mean 'first'?"),
        ("solver.twist=maybe", "'twist' takes true or false; received 'maybe'."),
        ("corner=1,x", "'corner' takes numbers joined by commas, for instance (0.0, 0.0); received '1,x'."),
        ("solver=3", "'solver' is more than a number; change it in Python, with dataclasses.replace."),
        ("name.first=3", "'name' has no parts; received 'name.first'."),
        ("name", "--change takes name=value, such as name=slide; received 'name'."),
    ],
)
def test_a_word_that_cannot_be_read_is_answered_in_one_sentence(word: str, message: str):
    with pytest.raises(UsageError, match=re.escape(message)):
        with_changes(Job(), read_pairs([word], "--change", "name=slide"))


def test_a_name_stands_once():
    with pytest.raises(UsageError, match="--fault names 'drop' more than once"):
        read_pairs(["drop=1", "drop = 2"], "--fault", "drop=0.2")


def test_values_without_annotation_are_read_like_the_present_ones():
    assert read_value("clip", "2", kind_of(1.0)) == 2.0
    assert read_value("count", "2", kind_of(1)) == 2
    assert read_value("target", "0,0,.5", kind_of((0.0, 0.0, 1.0))) == (0.0, 0.0, 0.5)
    assert read_value("limit", "3", kind_of(None)) == 3.0
