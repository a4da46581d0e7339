"""Contrasts have intervals that hold the truth, and the rule reads them."""

from __future__ import annotations

import doctest
import math

import numpy as np
import pytest

from brainbench.core.records import Interval
from tests.factories.benchmark_programs import benchmark_program

CONTRASTS = benchmark_program("reproduction.contrasts")
Effect, Matched, Observed = CONTRASTS.Effect, CONTRASTS.Matched, CONTRASTS.Observed
contrast, judge = CONTRASTS.contrast, CONTRASTS.judge

SWEEPS = 10_000


def _network(name, values, objective="supervised"):
    return Observed(name, dict(enumerate(values)), objective, SWEEPS)


@pytest.mark.parametrize(
    ("low", "high", "direction", "margin", "verdict"),
    [
        (0.1, 0.3, 1, 0, "holds"), (-0.3, -0.1, 1, 0, "does not hold"), (-0.1, 0.3, 1, 0, "undecided"),
        (-0.3, -0.1, -1, 0, "holds"), (0.1, 0.3, -1, 0, "does not hold"), (-0.1, 0.3, -1, 0, "undecided"),
        (-0.04, 0.03, 0, 0.05, "holds"), (0.06, 0.2, 0, 0.05, "does not hold"), (-0.2, -0.06, 0, 0.05, "does not hold"),
        (0.01, 0.2, 0, 0.05, "undecided"), (0.0, 0.2, 1, 0, "undecided"),
    ],
)  # fmt: skip
def test_a_verdict_follows_from_the_interval(low, high, direction, margin, verdict):
    effect = Effect((low + high) / 2, Interval(low, high))
    assert judge(effect, direction, margin=margin) == verdict


def test_what_is_missing_or_without_interval_gets_no_verdict():
    assert judge(None, 1) == "not trained yet"
    assert judge(Effect(0.5, None), 1) == "undecided"
    assert judge(Effect(0.6, Interval(0.55, 0.7)), 1, neutral=0.5) == "holds"
    assert judge(Effect(0.0, Interval(0.0, 0.4)), 1, neutral=0.5) == "does not hold"


@pytest.mark.parametrize("pairs", [1, 2, 6])
def test_intervals_of_equal_networks_hold_zero_as_often_as_they_say(pairs):
    rng = np.random.default_rng(pairs)
    held, runs = 0, 400
    for _ in range(runs):
        made = [[_network(f"{side}{i}", 0.5 + rng.normal(0, 0.02, 3)) for i in range(pairs)] for side in "ab"]
        found = contrast([Matched((a,), (b,)) for a, b in zip(*made, strict=True)], [*made[0], *made[1]])
        held += found.interval.low < 0 < found.interval.high
    # The binomial variance of sweeps is added although these values hold none of it: a little too often.
    assert 0.93 < held / runs <= 1


def test_without_repeated_seeds_one_comparison_has_no_interval_but_three_have():
    single = [Matched((_network(f"a{i}", [0.5 + 0.01 * i]),), (_network(f"b{i}", [0.4]),)) for i in range(3)]
    assert contrast(single[:1], single[0].one).interval is None
    interval = contrast(single).interval
    assert interval.low < 0.11 < interval.high
    repeated = _network("other", [0.4, 0.5], "simclr")
    assert contrast(single[:1], [repeated]).interval is not None
    assert contrast([]) is None


def test_the_variance_over_seeds_is_pooled_and_sweeps_are_binomial():
    a, b = _network("a", [0.60, 0.62]), _network("b", [0.50, 0.54])
    found = contrast([Matched((a,), (b,))], [a, b])
    within = (np.var([0.60, 0.62]) * 2 + np.var([0.50, 0.54]) * 2) / 2
    training = within * (1 / 2 + 1 / 2)
    test = (0.61 * 0.39 + 0.52 * 0.48) / SWEEPS
    freedom = (training + test) ** 2 / (training**2 / 2)
    from scipy.stats import t

    half = t.ppf(0.975, freedom) * math.sqrt(training + test)
    assert found.value == pytest.approx(0.09)
    assert found.interval.high - found.value == pytest.approx(half)


def test_paired_seeds_take_away_what_both_share():
    a, b = _network("a", [0.5, 0.6, 0.7]), _network("b", [0.4, 0.51, 0.59])
    wide, narrow = (contrast([Matched((a,), (b,))], [a, b], paired=paired).interval for paired in (False, True))
    assert narrow.high - narrow.low < wide.high - wide.low
    assert narrow.low > 0 > wide.low
    # Only the seeds that both have enter.
    assert contrast([Matched((_network("a", [0.5]),), (b,))], paired=True).value == pytest.approx(0.1)


def test_the_examples_of_the_module():
    assert doctest.testmod(CONTRASTS).failed == 0
