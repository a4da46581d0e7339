"""What carries a score: units and animals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.records import Score, SubjectScore
from brainbench.metrics import get_metric
from brainbench.scoring.influence import effective_number, influence_of, unit_shares


def _make_animals(*, loud: float = 1.0, units: int = 30, number: int = 3):
    rng, labels = np.random.default_rng(0), np.repeat(np.arange(10), 8)
    hidden, animals = rng.normal(size=(10, 5)), []
    for animal in range(number):
        responses = (hidden @ rng.normal(size=(5, units)))[labels] + 0.5 * rng.normal(size=(80, units))
        responses[:, 0] *= loud
        keys = [f"{animal}/{trial}" for trial in range(80)]
        animals.append(get_metric("rsa").animal(f"m{animal}", [Trials(responses, labels, keys)], 10))
    return hidden, animals


def _score(hidden, animals):
    names = [f"s{place}" for place in range(10)]
    return get_metric("rsa").score({"layer": hidden}, animals, name="net", stimuli=names)


def test_units_that_are_alike_all_count_and_a_loud_one_is_named():
    hidden, animals = _make_animals()
    stated, remarks = influence_of(_score(hidden, animals), get_metric("rsa"), animals)
    assert 15 < stated["effective"]["units"] <= 30
    assert stated["effective"]["animals"] == pytest.approx(3, abs=0.1)
    assert remarks == ()
    hidden, animals = _make_animals(loud=30)
    stated, remarks = influence_of(_score(hidden, animals), get_metric("rsa"), animals)
    assert stated["effective"]["units"] < 1.5
    assert len(remarks) == 1
    assert remarks[0].startswith("one unit decides in 3 of 3 animals (m")
    assert "one of 30 units has 9" in remarks[0]
    # Divided by its noise, a loud unit is one of many.
    assert influence_of(_score(hidden, animals), get_metric("rsa-crossnobis"), animals)[1] == ()


def test_the_share_of_a_unit_is_what_it_adds_to_squared_distances_without_noise():
    _, animals = _make_animals(loud=3)
    silent = replace(animals[0], patterns=animals[0].patterns * 0, noise=animals[0].noise)
    assert not unit_shares(silent).any()
    shares = unit_shares(animals[0])
    assert shares.sum() * 2 / animals[0].units == pytest.approx(animals[0].rdm.mean(), rel=1e-6)


def test_an_animal_that_has_more_than_half_of_a_score_is_named():
    def score(*values: float, p: float = 0.01) -> Score:
        subjects = tuple(SubjectScore(f"m{place}", value, value, 0.9) for place, value in enumerate(values))
        return Score("net", float(np.mean(values)), "ok", p=p, chance=0.0, attainable=1.0, subjects=subjects)

    stated, remarks = influence_of(score(0.9, 0.1, 0.1, -0.1), get_metric("rsa"), [])
    assert remarks == ("one animal decides: m0 has 82% of the score",)
    assert stated["effective"]["animals"] == pytest.approx(effective_number([0.9, 0.1, 0.1]))
    assert influence_of(score(0.5, 0.4, 0.5), get_metric("rsa"), [])[1] == ()
    assert influence_of(score(0.9, 0.1, 0.1, p=0.4), get_metric("rsa"), [])[1] == ()
