"""Differences between students of several training seeds and draws of their encoders."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from brainbench.core.errors import UsageError
from robotics_bridge.policies.contrasts import MixedModel, TrainedPolicy


def _model(groups: dict[str, list[float]]) -> MixedModel:
    return MixedModel(tuple(TrainedPolicy(arm, v, seed) for arm, values in groups.items()
                            for seed, v in enumerate(values)))  # fmt: skip


def _crossed(rng: np.random.Generator, arms: dict[str, float], draw: float, draws: int = 3, seeds: int = 5):
    made = []
    for arm, mean in arms.items():
        drawn = rng.normal(0, draw, draws)
        made += [TrainedPolicy(arm, mean + drawn[d] + rng.normal(0, 0.02), s, d) for d in range(draws)
                 for s in range(seeds)]  # fmt: skip
    return MixedModel(tuple(made))


def test_students_without_draws_are_compared_as_in_an_analysis_of_variance() -> None:
    groups = {"a": [0.57, 0.60, 0.55], "b": [0.41, 0.43, 0.38], "c": [0.22, 0.25, 0.21]}
    # Seeds that share nothing: the variances of seeds leave the model, and the residual is the mean square within.
    model = MixedModel(tuple(TrainedPolicy(arm, v, 10 * i + s) for i, (arm, vs) in enumerate(groups.items())
                             for s, v in enumerate(vs)))  # fmt: skip
    found = model.contrast("a", "b")
    within = np.mean([np.var(values, ddof=1) for values in groups.values()])
    half = stats.t.ppf(0.975, 6) * np.sqrt(within * 2 / 3)
    assert found.freedom == pytest.approx(6, rel=1e-4)
    assert found.interval is not None
    assert found.interval.high - found.difference == pytest.approx(half, rel=1e-4)
    assert found.p == pytest.approx(2 * stats.t.sf(found.difference / np.sqrt(within * 2 / 3), 6), rel=1e-3)


def test_nested_draws_count_as_the_analysis_of_their_means() -> None:
    # Balanced, draws spread more than seeds: REML is the analysis of variance of the draws' means.
    model = _crossed(np.random.default_rng(0), {"a": 0.5, "b": 0.4}, draw=0.1)
    means = {arm: [np.mean([p.success for p in model.policies if (p.arm, p.draw) == (arm, d)]) for d in range(3)]
             for arm in "ab"}  # fmt: skip
    found, reference = model.contrast("a", "b"), stats.ttest_ind(means["a"], means["b"])
    assert found.difference == pytest.approx(np.mean(means["a"]) - np.mean(means["b"]))
    assert found.freedom == pytest.approx(4, rel=0.02)
    assert found.interval is not None
    ends = reference.confidence_interval()
    assert (found.interval.low, found.interval.high) == pytest.approx((ends.low, ends.high), rel=0.02, abs=1e-4)
    assert found.p == pytest.approx(reference[1], rel=0.05)
    assert model.spread["draw"] > 0.04 > model.spread["residual"] > 0.01


def test_shared_policy_seeds_cancel_in_a_difference_of_arms() -> None:
    rng = np.random.default_rng(1)
    shared, noise = rng.normal(0, 0.2, 8), rng.normal(0, 0.01, (2, 8))
    found = _model({"a": (0.5 + shared + noise[0]).tolist(), "b": (0.4 + shared + noise[1]).tolist()})
    difference = found.contrast("a", "b")
    assert difference.interval is not None
    assert difference.interval.high - difference.interval.low < 0.05
    mean = found.mean("a").interval
    assert mean is not None
    assert mean.high - mean.low > 0.1


def test_more_policies_of_a_draw_are_no_more_draws() -> None:
    rng = np.random.default_rng(2)
    widths = []
    for seeds in (2, 20):
        interval = _crossed(rng, {"a": 0.5, "b": 0.5}, draw=0.1, seeds=seeds).contrast("a", "b").interval
        assert interval is not None
        widths.append(interval.high - interval.low)
    assert widths[1] > 0.15


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    # Three draws × five seeds against five draws of one seed each; benchmarks.policies.coverage has more designs.
    rng, held = np.random.default_rng(3), []
    for _ in range(200):
        some = _crossed(rng, {"trained": 0.5}, draw=0.03).policies
        five = [TrainedPolicy("random", 0.5 + rng.normal(0, 0.03) + rng.normal(0, 0.02), s, s) for s in range(5)]
        interval = MixedModel((*some, *five)).contrast("trained", "random").interval
        assert interval is not None
        held.append(interval.low <= 0 <= interval.high)
    assert 0.91 < np.mean(held) < 0.985


@pytest.mark.parametrize(("gain", "helps"), [(0.0, False), (0.04, False), (0.2, True)])
def test_an_arm_helps_only_far_above_the_best_random_one(gain: float, helps: bool) -> None:
    model = _crossed(np.random.default_rng(4), {"low": 0.3, "reservoir": 0.5, "simclr": 0.5 + gain}, draw=0.01)
    found = model.judge("simclr", ["low", "reservoir"])
    assert (found.best, found.helps) == ("reservoir", helps)
    assert found.contrast.interval is not None
    # .04 is told from nothing, and below the margin all the same.
    assert (found.contrast.interval.low > 0) == (gain > 0)


def test_a_large_difference_of_few_draws_is_not_shown_to_help() -> None:
    spread = {"simclr": (0.45, 0.8), "reservoir": (0.35, 0.65)}
    model = MixedModel(tuple(TrainedPolicy(arm, v + 0.01 * s, s, d) for arm, values in spread.items()
                             for (d, v), s in itertools.product(enumerate(values), range(3))))  # fmt: skip
    found = model.judge("simclr", ["reservoir"])
    assert found.contrast.difference > 0.05
    assert not found.helps


def test_policies_that_all_succeed_alike_tell_nothing_of_their_spread() -> None:
    found = _model({"a": [0.0, 0.0, 0.0], "b": [0.0, 0.0]}).contrast("a", "b")
    assert (found.difference, found.interval) == (0.0, None)
    assert np.isnan(found.p)


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(UsageError, match=r"training seed.* --seed"):
        _model({"a": [0.5], "b": [0.6]})
    with pytest.raises(UsageError, match=r"'a', draw 1 and seed 0 is given twice"):
        MixedModel((TrainedPolicy("a", 0.5, 0, 1), TrainedPolicy("a", 0.6, 0, 1), TrainedPolicy("a", 0.6, 1, 1)))
    model = _model({"reservoir": [0.5, 0.6], "simclr": [0.5, 0.7]})
    with pytest.raises(UsageError, match="did you mean 'simclr'"):
        model.contrast("simcl", "reservoir")
    with pytest.raises(UsageError, match="at least one random arm"):
        model.judge("simclr", [])
