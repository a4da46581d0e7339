"""The identity of a score holds what its numbers follow from, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from brainbench.core.identity import OF_MODELS, SETTINGS, ScoreIdentity, unusual_settings
from brainbench.core.records import ModelCard
from brainbench.scoring.options import ScoreOptions
from tests.factories.records import make_record


def _identity(card=None, **provenance):
    record = make_record()
    score = replace(record.score, provenance={**record.score.provenance, **provenance})
    return ScoreIdentity.of(replace(record, score=score, card=card or record.card))


def test_settings_have_the_defaults_of_a_score():
    assert {name: getattr(ScoreOptions(), name) for name in SETTINGS} == SETTINGS


@pytest.mark.parametrize(
    "change",
    [
        {"version": "99.0"}, {"time": "2030"}, {"machine": "another"}, {"command": "brainbench score"},
        {"settings": {**SETTINGS, "estimator_version": 2}}, {"settings": {"estimator_version": 2, "metric": "rsa"}},
    ],
)  # fmt: skip
def test_time_machine_package_and_stated_defaults_do_not_count(change):
    stated = {"settings": {"estimator_version": 2, "metric": "rsa"}}
    assert _identity(**stated) == _identity(**stated | change)


@pytest.mark.parametrize(
    "change",
    [
        {"settings": {"estimator_version": 1}}, {"settings": {"seed": 3}}, {"settings": {"layer": "gru"}},
        {"recordings": {"content_hash": "1"}}, {"stimuli": {"config_hash": "2"}},
        {"recordings": {"window": "start..+0.3"}}, {"pairs": {"a": "b", "b": "a"}},
    ],
)  # fmt: skip
def test_data_settings_and_the_estimator_count(change):
    assert _identity() != _identity(**change)


def test_weights_count():
    assert _identity(ModelCard("m", weights="1")) != _identity(ModelCard("m", weights="2"))


def test_only_unusual_settings_of_a_model_are_told():
    assert set(OF_MODELS) < set(SETTINGS)
    stated = {"layers": ("a", "b"), "normalize": True, "readout": "published", "seed": 4}
    assert unusual_settings(stated) == {"layers": ["a", "b"], "readout": "published"}
