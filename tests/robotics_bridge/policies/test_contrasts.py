"""Differences between students of several training seeds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from brainbench.core.errors import UsageError
from robotics_bridge.policies.contrasts import contrast, pooled_spread


def test_two_students_are_compared_as_by_students_t_test() -> None:
    one, other = [0.57, 0.60, 0.55], [0.41, 0.43]
    found = contrast(one, other, *pooled_spread([one, other]))
    reference = stats.ttest_ind(one, other)
    assert found.p == pytest.approx(reference[1])
    assert (found.interval.low, found.interval.high) == pytest.approx(tuple(reference.confidence_interval()))


def test_the_spread_of_all_students_is_that_of_an_analysis_of_variance() -> None:
    groups = [[0.57, 0.60, 0.55], [0.41, 0.43], [0.22, 0.25, 0.21], [0.34]]
    spread, freedom = pooled_spread(groups)
    design = np.repeat(np.eye(4), [len(group) for group in groups], axis=0)
    values = np.concatenate(groups)
    _, (residual,), rank, _ = np.linalg.lstsq(design, values, rcond=None)
    assert freedom == len(values) - rank == 5
    assert spread**2 == pytest.approx(residual / freedom)
    between = sum(len(group) * (np.mean(group) - values.mean()) ** 2 for group in groups) / 3
    assert between / spread**2 == pytest.approx(stats.f_oneway(*groups).statistic)


def test_a_single_seed_each_is_refused() -> None:
    with pytest.raises(UsageError, match=r"training seed.* --seed"):
        pooled_spread([[0.5], [0.6]])


def test_intervals_of_no_difference_hold_it_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    held = []
    for _ in range(2000):
        groups = rng.normal(0.4, 0.03, (4, 2)).tolist()
        found = contrast(groups[0], groups[1], *pooled_spread(groups))
        held.append(found.interval.low <= 0 <= found.interval.high)
    assert abs(np.mean(held) - 0.95) < 3 * np.sqrt(0.95 * 0.05 / 2000)
