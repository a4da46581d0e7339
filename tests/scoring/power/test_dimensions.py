"""Dimensions of a representation, from patterns and from trials."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.scoring.power.dimensions import MOST, pattern_dimensions, signal_dimensions


def _animals(rng, stimuli, dimensions, *, individual=0.0, noise=1.0, animals=6, units=60, trials=8):
    shared = rng.normal(size=(stimuli, dimensions))
    labels = np.repeat(np.arange(stimuli), trials)
    for _ in range(animals):
        own = rng.normal(size=(stimuli, dimensions))
        parts = [x @ rng.normal(size=(dimensions, units)) for x in (shared, own)]
        means = np.sqrt(1 - individual) * parts[0] + np.sqrt(individual) * parts[1]
        spread = noise * np.sqrt(dimensions)
        yield [Trials(means[labels] + spread * rng.normal(size=(len(labels), units)), labels)]


@pytest.mark.parametrize("dimensions", [1, 2, 10])
def test_patterns_have_as_many_dimensions_as_they_were_made_of(dimensions):
    rng = np.random.default_rng(dimensions)
    latent = rng.normal(size=(40, 40, dimensions))
    found = np.mean([pattern_dimensions(x @ rng.normal(size=(dimensions, 500))) for x in latent])
    assert found == pytest.approx(dimensions, rel=0.15)


@pytest.mark.parametrize("individual", [0.0, 0.3])
@pytest.mark.parametrize("dimensions", [2, 10])
def test_neither_noise_nor_an_animals_own_part_adds_dimensions(dimensions, individual):
    rng = np.random.default_rng(3)
    found = [signal_dimensions(_animals(rng, 16, dimensions, individual=individual), 16) for _ in range(12)]
    assert np.median(found) == pytest.approx(dimensions, rel=0.25)


def test_time_is_averaged_and_one_animal_is_enough():
    rng = np.random.default_rng(4)
    (sessions,) = _animals(rng, 30, 2, animals=1)
    (block,) = sessions
    moving = Trials(np.stack([block.responses, block.responses], axis=1), block.labels)
    assert signal_dimensions([[moving]], 30) == pytest.approx(signal_dimensions([sessions], 30))
    assert signal_dimensions([sessions], 30) == pytest.approx(2, rel=0.4)


def test_equal_distances_have_the_most_dimensions():
    assert pattern_dimensions(np.eye(6)) == MOST


def test_what_cannot_be_estimated_is_said():
    rng = np.random.default_rng(5)
    with pytest.raises(UsageError, match="at least 3 stimuli; received 2"):
        signal_dimensions(_animals(rng, 2, 2), 2)
    with pytest.raises(UsageError, match=r"received shape \(4,\)"):
        pattern_dimensions(np.ones(4))
    with pytest.raises(DataError, match="4 trials of every stimulus"):
        signal_dimensions(_animals(rng, 6, 2, trials=3), 6)
    with pytest.raises(DataError, match="do not differ"):
        pattern_dimensions(np.ones((6, 3)))
