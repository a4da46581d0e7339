"""Models are told apart where they differ for new animals and new stimuli, and no more often than stated."""

from __future__ import annotations

import doctest
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from brainbench.core.records import ModelCard
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, compare_scores
from brainbench.metrics import list_metrics
from leaderboards import ranking
from leaderboards.ranking import (
    BUILT_IN_METRICS,
    STANDINGS,
    Sample,
    lacking,
    not_repeatable,
    rank_ranges,
    standing_of,
    told_apart,
)
from tests.factories.records import draw_board


def _samples(truths, **design):
    return [Sample.of([record.score]) for record in draw_board(truths, **design)]


@given(
    st.integers(1, 8).flatmap(
        lambda n: st.lists(st.lists(st.booleans(), min_size=n, max_size=n), min_size=n, max_size=n)
    )
)
def test_a_range_counts_who_is_above_and_who_is_below(drawn):
    above = np.array(drawn)
    for i, (first, last) in enumerate(rank_ranges(above)):
        assert first == 1 + sum(above[i])
        assert last == len(above) - sum(above[:, i])


@pytest.mark.slow
def test_equal_models_are_rarely_told_apart():
    wrong = 0
    for seed in range(200):
        samples = _samples({f"m{i}": 0.5 for i in range(6)}, seed=seed)
        wrong += told_apart(samples).any()
    assert wrong / 200 <= 0.08  # 5 % of the boards, and chance of the simulation


def test_variance_over_animals_alone_would_tell_equal_models_apart():
    p = []
    for seed in range(100):
        one, other = _samples({"a": 0.5, "b": 0.5}, seed=seed)
        p.append(stats.ttest_rel(list(one.animals.values()), list(other.animals.values())).pvalue)
    assert np.mean(np.array(p) <= 0.05) > 0.15


def test_a_better_model_is_found_with_forty_stimuli():
    found = [told_apart(_samples({"good": 0.9, "weak": 0.4}, seed=seed))[1, 0] for seed in range(100)]
    assert np.mean(found) >= 0.8


def test_the_test_is_the_two_factor_t_test():
    one, other = (record.score for record in draw_board({"a": 0.8, "b": 0.4}))
    found = compare_scores(one, other)
    animals = np.array([a.value - b.value for a, b in zip(one.subjects, other.subjects, strict=True)])
    left_out = np.array(one.without_stimulus) - np.array(other.without_stimulus)
    size, count = len(animals), len(left_out)
    over_animals = animals.var(ddof=1) / size
    over_stimuli = (count - 1) / count * ((left_out - left_out.mean()) ** 2).sum()
    freedom = (over_animals + over_stimuli) ** 2 / (over_animals**2 / (size - 1) + over_stimuli**2 / (count - 1))
    error = math.sqrt(over_animals + over_stimuli)
    assert found.difference == pytest.approx(animals.mean())
    assert found.p == pytest.approx(2 * stats.t.sf(abs(animals.mean()) / error, freedom))
    assert found.interval.high - found.difference == pytest.approx(error * stats.t.ppf(0.975, freedom))


def test_metrics_with_another_chance_are_compared_on_the_common_scale():
    plain = [record.score for record in draw_board({"a": 0.8, "b": 0.4})]
    lifted = [record.score for record in draw_board({"a": 0.8, "b": 0.4}, chance=0.6)]
    assert lifted[0].value == pytest.approx(0.6 + 0.4 * plain[0].value)
    assert compare_scores(*lifted).difference == pytest.approx(compare_scores(*plain).difference)
    assert compare_scores(*lifted).p == pytest.approx(compare_scores(*plain).p)


@pytest.mark.parametrize("design", [{"animals": FEWEST_ANIMALS - 1}, {"stimuli": FEWEST_STIMULI - 1}])
def test_too_few_animals_or_stimuli_are_not_tested(design):
    records = draw_board({"a": 0.9, "b": 0.1}, **design)
    assert compare_scores(*(record.score for record in records)).verdict == ""
    assert not told_apart([Sample.of([record.score]) for record in records]).any()


def test_what_a_design_lacks_is_said():
    assert lacking(10, 40) == ""
    assert lacking(3, 40) == f"at least {FEWEST_ANIMALS} animals (here 3)"
    assert "and" in lacking(1, 2)


def test_a_model_does_not_differ_from_itself():
    (record,) = draw_board({"a": 0.8})
    found = compare_scores(record.score, record.score)
    assert (found.difference, found.p) == (0.0, 1.0)


def test_the_variance_of_seeds_widens_intervals_and_ties():
    one, other = (record.score for record in draw_board({"a": 0.9, "b": 0.5}, spread=0.05))
    assert told_apart([Sample.of([one]), Sample.of([other])])[1, 0]

    def shifted(score, by):
        subjects = tuple(replace(item, value=item.value + by) for item in score.subjects)
        left_out = tuple(value + by for value in score.without_stimulus)
        return replace(score, value=score.value + by, subjects=subjects, without_stimulus=left_out)

    seeds = [Sample.of([shifted(score, by) for by in (-0.5, 0.0, 0.5)]) for score in (one, other)]
    assert seeds[0].value == pytest.approx(one.value)
    assert seeds[0].seed_variance == (pytest.approx(0.25 / 3), 2)
    assert not told_apart(seeds).any()
    narrow, wide = Sample.of([one]).interval, seeds[0].interval
    assert wide.high - wide.low > narrow.high - narrow.low


def test_nothing_to_rank_is_no_error():
    assert told_apart([]).shape == (0, 0)
    assert rank_ranges(np.zeros((0, 0), bool)) == []


def test_the_examples_hold():
    assert doctest.testmod(ranking).failed == 0


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
