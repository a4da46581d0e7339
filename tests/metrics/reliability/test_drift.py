"""Drift that was planted is found, within sessions and between them; without it halves by time are as random ones."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.metrics.reliability.drift import LEVEL, drift_between, drift_within
from brainbench.metrics.reliability.subject_rdm import subject_rdm

STIMULI, UNITS, REPEATS = 10, 24, 8


def _make_session(rng, name, *, change=0.0, start=0.0, gain=0.0):
    """Trials in random order whose tuning turns from one geometry to another, by ``change`` over the session."""
    before, after = (rng.normal(size=(STIMULI, 2)) @ rng.normal(size=(2, UNITS)) for _ in range(2))
    labels = rng.permutation(np.repeat(np.arange(STIMULI), REPEATS))
    time = np.linspace(0, 1, len(labels))
    angle = (np.pi / 2) * np.clip(start + change * time, 0, 1)[:, None]
    responses = np.cos(angle) * before[labels] + np.sin(angle) * after[labels] + gain * time[:, None]
    responses = responses + 1.5 * rng.normal(size=responses.shape)
    keys = [f"{name}/{trial}" for trial in range(len(labels))]
    return Trials(responses, labels, keys, times=60.0 * time, session=name)


def _make_animals(seed, count=3, method="crossnobis", comparison="whitened-cosine", **drift):
    rng = np.random.default_rng(seed)
    how = {"method": method, "comparison": comparison, "noise": "none", "splits": 100}
    return [
        subject_rdm(f"m{index}", [_make_session(rng, f"{seed}/{index}", **drift)], STIMULI, **how)
        for index in range(count)
    ]


def _make_geometries(seed, sessions, *, change):
    """An animal of sessions with units of their own, whose geometry turns from session to session."""
    rng = np.random.default_rng(seed)
    first, last = rng.normal(size=(2, STIMULI, 4))
    blocks = []
    for place in range(sessions):
        angle = (np.pi / 2) * change * place / (sessions - 1)
        latent = np.cos(angle) * first + np.sin(angle) * last
        labels = np.repeat(np.arange(STIMULI), REPEATS)
        responses = (latent @ rng.normal(size=(4, UNITS)))[labels] + rng.normal(size=(len(labels), UNITS))
        blocks.append(Trials(responses, labels, [f"{place}/{row}" for row in range(len(labels))], session=f"s{place}"))
    return blocks


@pytest.mark.parametrize(("method", "comparison"), [("crossnobis", "whitened-cosine"), ("correlation", "pearson")])
def test_tuning_that_changes_over_a_session_is_found(method, comparison):
    drift = drift_within(_make_animals(0, method=method, comparison=comparison, change=1.0))
    assert drift.present
    assert drift.by_time < drift.random - 0.15


def test_without_drift_p_is_uniform_and_rates_that_drift_alike_are_none():
    drifts = [drift_within(_make_animals(seed, count=1, gain=3.0 * (seed % 2))) for seed in range(60)]
    p = np.array([drift.p for drift in drifts])
    assert 0.35 < p.mean() < 0.65
    assert (p <= 0.1).sum() <= 12
    assert abs(np.mean([drift.by_time - drift.random for drift in drifts])) < 0.02


def test_the_order_of_trials_and_sessions_changes_nothing_and_unknown_times_say_nothing():
    block, other = (_make_session(np.random.default_rng(seed), str(seed), change=0.5) for seed in (1, 2))
    order = np.random.default_rng(3).permutation(len(block.labels))
    animal = subject_rdm("a", [block, other], STIMULI, splits=5)
    again = subject_rdm("a", [other, block.take(order)], STIMULI, splits=5)
    assert animal.by_time == pytest.approx(again.by_time, abs=1e-12)
    assert list(animal.presented) == list(again.presented) == ["1", "2"]
    unknown = Trials(block.responses, block.labels, block.keys)
    assert drift_within([subject_rdm("a", [unknown], STIMULI, splits=5)]) is None


def test_a_geometry_that_turns_from_session_to_session_is_found_and_sampled_units_are_no_drift():
    def drift(seed, change):
        animals = [
            subject_rdm(f"m{i}", _make_geometries(100 * seed + i, 6, change=change), STIMULI, method="crossnobis",
                        comparison="whitened-cosine", noise="none", splits=5)
            for i in range(3)
        ]  # fmt: skip
        return drift_between(animals)

    turned = [drift(seed, 1.0) for seed in range(3)]
    assert all(each.present and each.by_time < 0.9 for each in turned)
    still = [drift(seed, 0.0) for seed in range(20)]
    assert sum(each.p <= 0.1 for each in still) <= 5
    assert 0.3 < np.mean([each.p for each in still]) < 0.7
    assert still[0].level == LEVEL


def test_two_sessions_have_no_order():
    assert drift_between([subject_rdm("a", _make_geometries(0, 2, change=1.0), STIMULI, splits=5)]) is None
