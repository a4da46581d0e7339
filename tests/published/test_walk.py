"""The walk from the published estimator to the default one."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import noise_corrected
from brainbench.metrics.measures.rsa import score_rdms
from brainbench.published.walk import (
    CORRECTED,
    PUBLISHED,
    PUBLISHED_INPUT,
    Switches,
    corrected_value,
    explain_score,
    explain_splits,
)
from tests.factories.animals import STIMULI, make_rdm, make_subject


@pytest.mark.shared
def test_the_stored_splits_walk_from_the_published_bar_to_no_trustworthy_number(reference):
    with np.load(reference / "rsa" / "thesis_model_input_rsa_plain.npz") as stored:
        steps = explain_splits(stored["r_xy"], stored["r_yy"], r_xx=stored["r_xx"])
        published = stored["r_xy_n_sb"]
    values = [step.value for step in steps]
    assert values == pytest.approx([0.45774, 0.59880, 0.32945, 0.59880, 0.57052, 0.57052], abs=5e-6)
    assert values[0] == pytest.approx(np.nanmedian(published), abs=1e-12)
    assert "286 with negative reliability" in steps[0].detail
    assert steps[2].detail == "75 of 1,000 splits"
    assert steps[-1].status == "unreliable"
    assert "no correction of these data is trustworthy" in steps[-1].detail


def test_the_ends_of_the_walk_are_the_estimators():
    rng = np.random.default_rng(0)
    halves = rng.uniform(-0.2, 0.9, 200)
    for switches, estimator in ((PUBLISHED, "thesis"), (PUBLISHED_INPUT, "thesis-input"), (CORRECTED, "default")):
        expected = noise_corrected(0.4, halves, estimator=estimator)
        assert corrected_value(0.4, halves, switches) == pytest.approx((expected.value, expected.splits))


def test_two_negative_reliabilities_pass_only_as_published():
    splits = [-0.5, 0.6, -0.3]
    assert corrected_value(0.4, splits, Switches(drop_splits=False), r_xx=splits)[1] == 3
    assert corrected_value(0.4, splits, Switches(drop_splits=False, negative_pairs=False), r_xx=splits)[1] == 1


def test_each_step_of_a_score_changes_one_switch_and_the_last_is_the_score():
    rng = np.random.default_rng(1)
    shared = make_rdm(rng)
    animals = [make_subject(f"m{i}", shared + 0.1 * rng.normal(size=15), seed=i, splits=60) for i in range(6)]
    animals.append(make_subject("noisy", make_rdm(rng), reliability=0.3, splits=60))
    layers = {str(i): make_rdm(rng) for i in range(8)} | {"true": shared}
    steps = explain_score(layers, animals)
    score = score_rdms(layers, animals, name="x", stimuli=STIMULI)
    assert steps[-1].value == pytest.approx(score.value)
    assert steps[-1].switches == CORRECTED
    assert steps[0].switches == PUBLISHED
    changed = [
        sum(getattr(a.switches, f.name) != getattr(b.switches, f.name) for f in dataclasses.fields(Switches))
        for a, b in itertools.pairwise(steps)
    ]
    assert changed == [1] * 6
    assert steps[0].value >= steps[1].value


def test_the_maximum_over_targets_and_layers_makes_a_score_of_nothing():
    rng = np.random.default_rng(2)
    first, last = [], []
    for _ in range(40):
        animals = [make_subject(f"m{i}", make_rdm(rng), seed=i, reliability=0.8) for i in range(11)]
        steps = explain_score({str(i): make_rdm(rng) for i in range(12)}, animals)
        first.append(steps[0].value)
        last.append(steps[-1].value)
    assert np.mean(first) > 0.6
    assert abs(np.mean(last)) < 0.15


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="no split halves"):
        explain_splits(0.3, [np.nan])
    with pytest.raises(UsageError, match="nothing to explain"):
        explain_score({"a": np.ones(15)}, [make_subject("a", make_rdm(np.random.default_rng(0)))])
