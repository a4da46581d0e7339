"""One ladder of words says what a score is worth, and who can compute it again."""

from __future__ import annotations

import doctest
import math
from dataclasses import replace

import pytest

from brainbench.core.records import ModelCard
from brainbench.metrics import list_metrics
from leaderboards import standing as module
from leaderboards.standing import BUILT_IN_METRICS, STANDINGS, not_repeatable, standing_of


@pytest.mark.parametrize(
    ("change", "above_raw", "standing"),
    [
        ({"p": 0.001}, True, "above raw input"),
        ({"p": 0.001}, False, "above chance"),
        ({"p": 0.2}, True, "not told apart from chance"),
        ({"p": math.nan}, True, "not tested"),
        ({"p": 0.001, "status": "unreliable"}, True, "unreliable"),
        ({"value": math.nan, "status": "undefined"}, True, "undefined"),
    ],
)
def test_every_score_stands_on_one_rung(make_score, change, above_raw, standing):
    score = replace(make_score(), **change)
    assert standing_of(score, above_raw=above_raw) == standing
    assert standing in STANDINGS


@pytest.mark.parametrize(
    ("name", "family", "repeatable"),
    [
        ("s4-small.simclr", "s4", True),
        ("features", "features computed elsewhere", False),
        ("mine.py:Mine", "user module", False),
        ("local-dir:there", "s4", False),
        ("hf-hub:me/there", "s4", False),
        ("bare", "", False),
    ],
)
def test_only_what_comes_with_the_package_can_be_repeated(make_record, name, family, repeatable):
    record = make_record(name)
    record = replace(record, card=ModelCard(name, family=family))
    assert (not_repeatable(record) == "") is repeatable


def test_a_metric_of_a_user_leaves_a_record_without_a_rank(make_record):
    def scored_by(metric):
        return make_record("s4-small", provenance={"settings": {"metric": metric}})

    assert set(BUILT_IN_METRICS) == set(list_metrics())
    assert not any(not_repeatable(scored_by(metric)) for metric in BUILT_IN_METRICS)
    for metric in ("mine", "mine.py:Mine", ["rsa"], 3):
        assert "metric" in not_repeatable(scored_by(metric))


def test_the_examples_hold():
    assert doctest.testmod(module).failed == 0
