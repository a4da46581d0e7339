import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.records import Score
from brainbench.core.statistics import paired_differences, t_interval, two_factor_error, wilson_interval


def test_wilson_equals_a_published_value():
    # 10 of 100 (Newcombe 1998, method 3, without continuity correction): .0552 to .1744.
    interval = wilson_interval(10, 100)
    assert (interval.low, interval.high) == pytest.approx((0.0552, 0.1744), abs=5e-5)
    assert all(wilson_interval(count, count).high == 1 and wilson_interval(0, count).low == 0 for count in range(1, 99))
    with pytest.raises(UsageError, match="at least 1; received 0"):
        wilson_interval(0, 0)


def test_two_factors_are_those_of_a_crossed_design():
    # A mean over animals × stimuli of a + s: its variance is var(a)/A + var(s)/K exactly.
    generator = np.random.default_rng(0)
    animals, stimuli = generator.normal(0.0, 2.0, (4000, 6)), generator.normal(0.0, 3.0, (4000, 12))
    mean = stimuli.mean(axis=1, keepdims=True)
    without = (stimuli.sum(axis=1, keepdims=True) - stimuli) / 11
    error, freedom = two_factor_error(animals + mean, without + animals.mean(axis=1, keepdims=True))
    expected = 4.0 / 6 + 9.0 / 12
    assert np.mean(error**2) == pytest.approx(expected, rel=0.03)
    assert np.var(animals.mean(axis=1) + stimuli.mean(axis=1)) == pytest.approx(expected, rel=0.06)
    assert 5 < freedom.mean() < 17


def test_one_factor_without_spread_leaves_the_other():
    values = np.array([0.2, 0.5, 0.9, np.nan])
    error, freedom = two_factor_error(values, np.full(8, 0.3))
    interval = t_interval(values[:3])
    assert interval is not None
    assert 4.302653 * error == pytest.approx((interval.high - interval.low) / 2, rel=1e-6)
    assert freedom == pytest.approx(2.0)
    assert np.isnan(two_factor_error([0.2], np.full(8, 0.3))[0])


def test_paired_differences_follow_the_stimuli_of_the_first_score_on_every_run():
    # The order of a set of strings changes with PYTHONHASHSEED, and with it the last digits of a sum.
    stimuli = tuple(f"stimulus-{index}" for index in range(12))
    first = Score("a", 0.5, "ok", stimuli=stimuli, without_stimulus=tuple(range(12)), chance=0.0, attainable=1.0)
    second = Score("b", 0.5, "ok", stimuli=stimuli[::-1], without_stimulus=(0.0,) * 12, chance=0.0, attainable=1.0)
    _, without = paired_differences(first, second)
    assert without.tolist() == list(range(12))


@pytest.mark.parametrize("successes", [4, -1, float("nan")])
def test_more_successes_than_observations_are_refused(successes):
    with pytest.raises(UsageError, match="3 observations"):
        wilson_interval(successes, 3)
    assert wilson_interval(3 * (1 + 1e-16), 3).high == 1
