"""Animals behind a score: who is scored, who is left out in words."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import rdm
from brainbench.metrics.measures.rsa import score_rdms
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.animals import STIMULI, make_block, make_latent, make_rdm, make_subject


def _make_animals(latent, count=6, noise=2.0, seed=100, splits=60):
    return [
        subject_rdm(f"m{i}", [make_block(latent, seed=seed + i, noise=noise)], len(latent), splits=splits)
        for i in range(count)
    ]


def _make_layers(latent, count=4, seed=50):
    rng = np.random.default_rng(seed)
    return {f"conv{i}": rdm(np.c_[latent * i, rng.normal(size=(len(latent), 6))]) for i in range(count)}


def _score(layers, subjects, **options):
    return score_rdms(layers, subjects, name="model", stimuli=STIMULI, **options)


def test_unreliable_animals_do_not_vote_and_are_named():
    latent = make_latent(5)
    layers, good = _make_layers(latent), _make_animals(latent, 4)
    rng = np.random.default_rng(0)
    noisy = make_subject("z", make_rdm(rng), reliability=0.2)
    score, without = _score(layers, [*good, noisy]), _score(layers, good)
    assert score.value == pytest.approx(without.value, abs=1e-15)
    assert score.p == without.p
    assert score.status == "ok"
    assert "animal z left out: reliability 0.20 is below 0.3" in score.reasons
    last = score.subjects[-1]
    assert (last.subject, last.status) == ("z", "unreliable")
    assert math.isfinite(last.value)


@pytest.mark.parametrize(("reliabilities", "status"), [((0.4, 0.45, 0.6), "unreliable"), ((0.4, 0.6, 0.65), "ok")])
def test_the_mean_reliability_of_the_study_decides_not_that_of_single_animals(reliabilities, status):
    rng = np.random.default_rng(6)
    animals = [make_subject(f"m{i}", make_rdm(rng), reliability=r, seed=i) for i, r in enumerate(reliabilities)]
    score = _score({"a": make_rdm(rng)}, animals)
    assert score.status == status
    assert [subject.status for subject in score.subjects] == [status] * 3
    assert ("reliability, 0.45, is below 0.5" in "; ".join(score.reasons)) == (status == "unreliable")


def test_when_no_animal_is_reliable_the_value_is_reported_as_unreliable():
    rng = np.random.default_rng(6)
    animals = [make_subject(f"m{i}", make_rdm(rng), reliability=0.3, seed=i) for i in range(3)]
    score = _score({"a": make_rdm(rng), "b": make_rdm(rng)}, animals)
    assert score.status == "unreliable"
    assert score.reasons[0] == "no animal is reliable"
    assert math.isfinite(score.value)


def test_animals_without_a_stimulus_are_left_out_in_words():
    latent = make_latent(7)
    lacking = subject_rdm("a0", [make_block(latent, gap=(2,))], 6, stimuli=STIMULI)
    score = _score(_make_layers(latent), [lacking, *_make_animals(latent, 3)])
    assert score.status == "ok"
    assert "animal a0 left out: no trials of 'convex-far'" in score.reasons
    assert score.subjects[0].status == "undefined"
    alone = _score(_make_layers(latent), [lacking])
    assert alone.status == "undefined"
    assert alone.reasons == ("no animal can be used", "animal a0 left out: no trials of 'convex-far'")
    assert math.isnan(alone.value)
    assert alone.p_smallest == pytest.approx(1 / 720)


def test_an_animal_given_twice_or_with_other_stimuli_is_refused():
    latent = make_latent(16)
    (animal,) = _make_animals(latent, 1)
    with pytest.raises(UsageError, match="Subject 'm0' appears twice"):
        _score(_make_layers(latent), [animal, animal])
    with pytest.raises(UsageError, match="'m0' has an RDM of 5"):
        _score(_make_layers(latent), _make_animals(make_latent(16, stimuli=5), 1))
