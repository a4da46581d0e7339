"""The learning rate stays within its own range, whatever is asked for."""

from __future__ import annotations

import pytest
from rsl_rl.algorithms import PPO

from robotics_bridge.policies.training.bounded_ppo import BoundedPPO


@pytest.fixture(autouse=True)
def without_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Construct the algorithm without networks: it sets its learning rate and nothing else."""
    monkeypatch.setattr(PPO, "__init__", lambda self, *, learning_rate: setattr(self, "learning_rate", learning_rate))


@pytest.mark.parametrize(("asked", "found"), [(1e-9, 1e-4), (5e-4, 5e-4), (1.0, 1e-3)])
def test_the_first_rate_lies_within_the_range(asked: float, found: float) -> None:
    assert BoundedPPO(learning_rate_range=(1e-4, 1e-3), learning_rate=asked).learning_rate == found


def test_an_adaptive_rate_goes_to_the_bounds_and_back_but_not_beyond() -> None:
    algorithm = BoundedPPO(learning_rate_range=(1e-4, 1e-3), learning_rate=5e-4)
    for _ in range(10):
        algorithm.learning_rate *= 1.5
    assert algorithm.learning_rate == 1e-3
    algorithm.learning_rate /= 1.5
    assert algorithm.learning_rate == pytest.approx(1e-3 / 1.5)
    for _ in range(10):
        algorithm.learning_rate /= 1.5
    assert algorithm.learning_rate == 1e-4
