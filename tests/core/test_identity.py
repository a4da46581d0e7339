"""The identity of a score holds what its numbers follow from, and nothing else; a sealed plan shows what deviates."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import to_plain
from brainbench.core.identity import OF_MODELS, SETTINGS, ScoreIdentity, SealedPlan, plan_note, unusual_settings
from brainbench.core.records import LayerScore, ModelCard, ResultRecord, Score, SubjectScore
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


PLAN = SealedPlan("recovery", 3, 2, names=("a", "b", "c"), models=("net",), units=10, trials=5, pilot="0123")


def _planned(plan: SealedPlan | None = PLAN, *, units: int = 12, trials: int = 15, **changes):
    animals = tuple(SubjectScore(name, 0.5, 0.4, 0.9, units=units, trials=trials) for name in "xy")
    layers = (LayerScore("one", 0.5, 0.4), LayerScore("two", 0.5, 0.4))
    origin = {"settings": {"metric": "rsa"}, "recordings": {"content_hash": "4567"}}
    stated = {"plan": to_plain(plan)} if plan else {}
    score = Score("net", 0.5, "ok", subjects=animals, layers=layers, stimuli=("a", "b", "c"))
    score = replace(score, provenance={**origin, **stated, **changes.pop("provenance", {})})
    return ResultRecord(replace(score, **changes))


def test_a_plan_is_read_as_it_was_written(tmp_path):
    assert SealedPlan.read(PLAN.write(tmp_path / "plan.json")) == PLAN


@pytest.mark.parametrize("change", [{"animals": 3}, {"layer": "fc"}, {"more": 1}, {"hash": "0"}])
def test_a_plan_that_was_changed_is_refused(tmp_path, change):
    path = PLAN.write(tmp_path / "plan.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DataError, match="was changed after it was written"):
        SealedPlan.read(path)


def test_a_file_that_is_no_plan_is_named(tmp_path):
    (tmp_path / "x.json").write_text("[1]")
    with pytest.raises(DataError, match="is no plan"):
        SealedPlan.read(tmp_path / "x.json")


def test_a_record_that_follows_its_plan_says_so():
    assert not list(PLAN.deviations(_planned()))
    assert plan_note(_planned()) == f"follows the sealed plan {PLAN.hash}"
    assert plan_note(_planned(None)) == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "other"}, "the network 'other' is not among the 1 planned"),
        ({"stimuli": ("a", "b")}, "1 planned stimuli are not scored ('c')"),
        ({"stimuli": ("a", "b")}, "2 stimuli, planned 3"),
        ({"stimuli": ("a", "b", "d")}, "1 stimuli are not in the plan ('d')"),
        ({"provenance": {"settings": {"metric": "cka"}}}, "metric 'cka', planned 'rsa'"),
        ({"provenance": {"settings": {"metric": "rsa", "layer": "one"}}}, "layer 'one', planned a choice"),
        ({"provenance": {"recordings": {"content_hash": "0123"}}}, "the recordings are the pilot"),
        ({"subjects": (SubjectScore("x", 0.5, 0.4, 0.9, units=12, trials=15),)}, "1 animals, planned 2"),
        ({"units": 9}, "2 of 2 animals have fewer than the planned 10 units"),
        ({"trials": 14}, "2 of 2 animals have fewer than the planned 5 trials"),
    ],
)
def test_each_deviation_is_named(changes, words):
    note = plan_note(_planned(**changes))
    assert note.startswith("deviates from the sealed plan")
    assert words in note


def test_a_committed_layer_and_the_number_of_layers_are_held():
    committed = replace(PLAN, layer="one")
    assert "layer chosen among 2, planned 'one'" in plan_note(_planned(committed))
    settings = {"metric": "rsa", "layer": "one"}
    assert plan_note(_planned(committed, provenance={"settings": settings})).startswith("follows")
    assert "layer chosen among 2, planned 1" in plan_note(_planned(replace(PLAN, layers=1)))


def test_stimuli_may_have_other_names_in_the_recordings():
    pairs = {"1": "a", "2": "b", "3": "c"}
    assert plan_note(_planned(stimuli=("1", "2", "3"), provenance={"pairs": pairs})).startswith("follows")


def test_a_plan_of_other_recordings_is_refused_in_one_sentence():
    with pytest.raises(UsageError, match=r"of other recordings: none of its 3 stimuli \('a', 'b', 'c'\)"):
        PLAN.check_stimuli(("x", "y"))
    PLAN.check_stimuli(("c", "y"))


def test_a_plan_in_a_record_that_makes_no_sense_is_named():
    record = _planned(None, provenance={"plan": {"made_by": "me"}})
    assert plan_note(record).startswith("its plan cannot be read")
