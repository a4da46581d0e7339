"""The main job on recordings whose geometry is known, through files, as a user would run it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from torch import nn

import brainbench
from brainbench.cli.leaderboard.verify import Repetition, score_again
from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.core.records import Score, SubjectScore
from brainbench.datasets import write_recordings
from brainbench.datasets.trials.session_trials import pooled
from brainbench.metrics import get_metric
from brainbench.models.features import write_features
from brainbench.scoring.scores import (
    effective_number,
    held_parts,
    influence_of,
    of_no_neurons,
    score_record,
    unit_shares,
)
from leaderboards.audit import differences

LABELS = ("a", "b", "c", "d", "e", "f")


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory, geometry) -> Path:
    layers = {"other": geometry(9), "true": geometry()}
    return write_features(tmp_path_factory.mktemp("features") / "model.h5", LABELS, layers)


def test_the_true_geometry_scores_near_one_and_chooses_its_layer(truth: Path, recordings: xr.Dataset):
    score = brainbench.score(str(truth), recordings=recordings)
    assert score.status == "ok"
    assert score.value == pytest.approx(1.0, abs=0.15)
    assert score.layer == "true"
    assert {item.layer for item in score.subjects} == {"true"}
    assert score.p <= 0.01
    assert score.ceiling is not None
    assert score.ceiling.lower < score.ceiling.upper <= 1
    assert score.best_layer_value >= score.value - 1e-12
    assert len(score.model_rdm) == len(score.brain_rdm) == 15


def test_features_with_labels_of_their_own_state_no_stimuli(truth: Path, recordings: xr.Dataset):
    from leaderboards.text import methods

    record = score_record(str(truth), recordings=recordings, baselines=False)
    origin = record.score.provenance
    assert not origin.stimuli
    assert [origin.settings[name] for name in ("stimuli", "whiskers", "fidelity")] == [None, None, None]
    assert "idelity" not in methods([record])


def test_an_unrelated_geometry_does_not(recordings: xr.Dataset, tmp_path: Path, geometry):
    path = write_features(tmp_path / "other.h5", LABELS, {"fc": geometry(9)})
    score = brainbench.score(str(path), recordings=recordings)
    assert score.scaled < 0.8
    assert score.p > 0.02


def test_order_of_trials_and_labels_changes_nothing(truth: Path, recordings: xr.Dataset, tmp_path: Path, geometry):
    first = brainbench.score(str(truth), recordings=recordings)
    order = np.random.default_rng(1).permutation(recordings.sizes["trial"])
    shuffled = recordings.isel(trial=order)
    rows = [3, 0, 5, 1, 4, 2]
    turned = write_features(
        tmp_path / "turned.h5",
        [LABELS[row] for row in rows],
        {"other": geometry(9)[rows], "true": geometry()[rows]},
    )
    second = brainbench.score(str(turned), recordings=shuffled)
    assert second.value == pytest.approx(first.value, abs=1e-12)
    assert second.reliability == pytest.approx(first.reliability, abs=1e-12)
    assert second.p == first.p
    np.testing.assert_allclose(second.model_rdm, first.model_rdm, atol=1e-12)


def test_order_of_files_changes_nothing(folder: Path, truth: Path):
    paths = sorted(folder.glob("*.h5"))
    both = [
        brainbench.score(str(truth), recordings=order, conditions="trials:stimulus") for order in (paths, paths[::-1])
    ]
    assert both[0].value == both[1].value


def test_a_seed_reproduces_a_record_and_provenance_says_what_was_scored(truth: Path, folder: Path):
    first, second = (
        score_record(str(truth), recordings=str(folder), conditions="trials:stimulus", seed=3) for _ in range(2)
    )
    assert first.identity == second.identity
    origin = first.score.provenance
    assert origin["recordings"]["content_hash"]
    assert origin["settings"]["seed"] == 3
    assert first.card is not None
    assert first.card.weights
    assert first.animal_to_animal is not None
    assert first.animal_to_animal.value == pytest.approx(1.0, abs=0.15)
    assert not first.synthetic


def test_a_subject_without_a_stimulus_is_named_and_the_others_still_count(truth: Path, tmp_path: Path, make_recordings):
    folder = make_recordings(tmp_path, missing="c", units=30, trials=12)
    score = brainbench.score(str(truth), recordings=str(folder), conditions="trials:stimulus")
    lost = score.subjects[0]
    assert lost.subject == "m0"
    assert lost.status == "undefined"
    assert any("m0" in reason and "'c'" in reason for reason in score.reasons)
    assert math.isfinite(score.value)


def test_recordings_in_memory_that_are_a_part_have_another_hash(truth: Path, recordings: xr.Dataset, tmp_path: Path):
    def told(dataset):
        return score_record(truth, recordings=dataset, baselines=False).score.provenance.recordings_hash

    first = recordings["subject"].values != recordings["subject"].values[0]
    parts = [recordings.isel(trial=first), recordings.isel(trial=slice(5, None)), recordings.isel(unit=slice(5, None))]
    whole, *hashes = map(told, (recordings, *parts))
    assert whole == recordings.attrs["content_hash"]
    assert len({whole, *hashes}) == 4
    assert told(write_recordings(tmp_path / "part.h5", parts[0])) == hashes[0]
    assert told(write_recordings(tmp_path / "whole.h5", recordings)) == whole


def test_recordings_that_were_edited_in_memory_have_another_hash(truth: Path, recordings: xr.Dataset, tmp_path: Path):
    def told(dataset):
        return score_record(truth, recordings=dataset, baselines=False).score.provenance.recordings_hash

    turned = recordings.assign_coords(stimulus=("trial", recordings["stimulus"].values[::-1]))
    for edited in (turned, recordings.assign(counts=recordings["counts"] * 2)):
        assert told(edited) != told(recordings)
        assert told(pooled(edited, "session")) != told(pooled(recordings, "session"))
    assert told(write_recordings(tmp_path / "turned.h5", turned)) == told(turned)
    assert told(pooled(recordings, "session")) == pooled(recordings, "session").attrs["content_hash"]


def test_contacts_are_hashed_where_the_metric_takes_them(truth: Path, recordings: xr.Dataset):
    def told(contacts, metric):
        dataset = recordings.assign_coords(contacts=("trial", contacts.astype(float)))
        return score_record(truth, recordings=dataset, baselines=False, metric=metric).score.provenance.recordings_hash

    contacts = np.arange(recordings.sizes["trial"])
    assert told(contacts, "rsa-partial") != told(contacts[::-1], "rsa-partial")
    assert told(contacts, "rsa") == told(contacts[::-1], "rsa") == recordings.attrs["content_hash"]


def test_doubts_about_recordings_are_reasons_of_every_score(truth: Path, recordings: xr.Dataset):
    record = score_record(truth, recordings=recordings.assign_attrs(doubts=["two animals may be one"]))
    for found in (record.score, record.animal_to_animal, *record.baselines.values()):
        assert "two animals may be one" in found.reasons


def test_dropped_labels_leave_the_comparison(truth: Path, recordings: xr.Dataset):
    score = brainbench.score(str(truth), recordings=recordings, match={"f": None})
    assert score.stimuli == LABELS[:5]
    assert len(score.model_rdm) == 10


def test_a_record_with_a_dropped_label_is_repeated_without_it(truth: Path, folder: Path):
    how = {"recordings": str(folder), "conditions": "trials:stimulus"}
    record = score_record(str(truth), match={"f": None}, **how)
    again = score_again(record, Repetition(str(folder), trust_code=True))
    assert differences(record, again) == []


@pytest.mark.parametrize("more", [{"by": "area"}, {"by": "area=S1"}, {"explain": True}])
def test_what_a_record_states_beside_its_score_is_repeated_too(
    truth: Path, recordings: xr.Dataset, tmp_path: Path, more: dict[str, object]
):
    area = np.where(np.arange(recordings.sizes["unit"]) % 2, "S1", "M1")
    path = str(write_recordings(tmp_path / "counts.h5", recordings.assign_coords(area=("unit", area))))
    record = score_record(str(truth), recordings=path, **more)
    assert {"groups", "estimator_walk"} & {*record.score.provenance.statistics}
    assert differences(record, score_again(record, Repetition(path, trust_code=True))) == []


@pytest.mark.parametrize(
    "choice", [{"select": "stimulus=a|b"}, {"window": "start..+0.1"}, {"conditions": "trials:stimulus"}, {"bin": 0.1}]
)
def test_a_choice_that_recordings_in_memory_cannot_follow_is_refused(truth: Path, recordings: xr.Dataset, choice):
    with pytest.raises(UsageError, match=f"{next(iter(choice))} cannot apply"):
        brainbench.score(str(truth), recordings=recordings, **choice)


def test_unmatched_labels_are_an_error_that_lists_both_sides(recordings: xr.Dataset, tmp_path: Path, geometry):
    path = write_features(tmp_path / "x.h5", [*LABELS[:5], "z"], {"fc": geometry()})
    with pytest.raises(UsageError, match=r"without a stimulus: 'f'; without recordings: 'z'.*--match"):
        brainbench.score(str(path), recordings=recordings)


@pytest.mark.parametrize("fill", [np.nan, 1.0])
def test_nan_or_constant_activations_give_an_undefined_score_with_a_reason(
    recordings: xr.Dataset, tmp_path: Path, fill: float
):
    path = write_features(tmp_path / "x.h5", LABELS, {"fc": np.full((6, 5), fill)})
    record = score_record(str(path), recordings=recordings)
    assert record.score.status == "undefined"
    assert math.isnan(record.score.value)
    assert "constant or not finite" in record.score.reasons[0]
    assert record.from_json(record.to_json()).to_json() == record.to_json()


def test_a_layer_of_nan_is_never_chosen(recordings: xr.Dataset, tmp_path: Path, geometry):
    bad = np.full_like(geometry(), np.nan)
    path = write_features(tmp_path / "x.h5", LABELS, {"bad": bad, "true": geometry()})
    score = brainbench.score(str(path), recordings=recordings)
    assert score.layer == "true"
    assert next(item for item in score.layers if item.layer == "bad").status == "undefined"


def test_layers_can_be_chosen_and_a_typo_is_corrected(truth: Path, recordings: xr.Dataset):
    score = brainbench.score(str(truth), recordings=recordings, layers=("other",))
    assert [item.layer for item in score.layers] == ["other"]
    with pytest.raises(UsageError, match="did you mean 'true'"):
        brainbench.score(str(truth), recordings=recordings, layers=("treu",))


def test_the_published_estimator_says_that_it_is_optimistic(truth: Path, recordings: xr.Dataset):
    score = brainbench.score(str(truth), recordings=recordings, estimator="thesis")
    assert score.estimator == "thesis"
    assert any("optimistic" in reason for reason in score.reasons)
    with pytest.raises(UsageError, match="did you mean 'thesis'"):
        brainbench.score(str(truth), recordings=recordings, estimator="theses")


class _Tiny(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.fc = nn.Linear(8, 5)

    def forward(self, x):
        return self.fc(x.flatten(2)).relu().mean(1)


@pytest.fixture
def arrays(tmp_path: Path) -> Path:
    import h5py

    path = tmp_path / "stimuli.h5"
    values = np.random.default_rng(2).normal(size=(6, 4, 2, 2, 2)).astype(np.float32)
    with h5py.File(path, "w") as file:
        file["stimuli"] = values
        file["labels"] = np.array(LABELS, dtype=h5py.string_dtype())
    return path


def test_a_plain_module_is_scored_on_arrays_without_registration(recordings: xr.Dataset, arrays: Path):
    record = score_record(_Tiny(), recordings=recordings, stimuli=str(arrays))
    assert [item.layer for item in record.score.layers] == ["fc", "output"]
    assert set(record.baselines) == {"raw input", "random features", "presentation time"}
    assert record.card is not None
    assert record.card.parameters == 45
    assert record.card.input == "as given"


def test_one_stimulus_under_two_labels_puts_every_score_in_doubt(recordings: xr.Dataset, arrays: Path):
    import h5py

    # Animals and any network respond alike to it: of unrelated networks a third had p ≤ .05 with six stimuli.
    with h5py.File(arrays, "r+") as file:
        file["stimuli"][4] = file["stimuli"][1]
    record = score_record(_Tiny(), recordings=recordings, stimuli=str(arrays))
    for result in (record.score, record.animal_to_animal, *record.baselines.values()):
        assert result.status == "unreliable"
        assert "labels of one stimulus (b = e)" in " ".join(result.reasons)


def test_a_layer_within_a_list_of_modules_that_is_called_layers_can_be_committed_to(
    recordings: xr.Dataset, arrays: Path
):
    class Stack(_Tiny):
        def __init__(self) -> None:
            super().__init__()
            self.layers = nn.ModuleList([self.fc])

    score = brainbench.score(Stack(), recordings=recordings, stimuli=str(arrays), layer="fc")
    assert (score.layer, score.layer_rule) == ("fc", "committed to beforehand")


def test_units_can_be_chosen_for_plain_modules_alone(recordings: xr.Dataset, arrays: Path, truth: Path):
    given = {"recordings": recordings, "stimuli": str(arrays), "normalize": False}
    assert brainbench.score(_Tiny(), **given).status == "ok"
    for model, why in ((str(truth), "elsewhere"), ("zhuang-small", "by itself")):
        with pytest.raises(UsageError, match=f"normalize=False .*{why}"):
            brainbench.score(model, **given)


def test_the_published_readout_scores_the_layers_of_the_study(recordings: xr.Dataset, tmp_path: Path):
    import h5py

    values = 1e-4 * np.random.default_rng(2).normal(size=(6, 9, 30, 5, 7)).astype(np.float32)
    with h5py.File(tmp_path / "sweeps.h5", "w") as file:
        file["stimuli"] = values
        file["labels"] = np.array(LABELS, dtype=h5py.string_dtype())
    given = {"recordings": recordings, "stimuli": str(tmp_path / "sweeps.h5"), "readout": "published"}
    record = score_record("s4-small", **given)
    assert [item.layer for item in record.score.layers][1:3] == ["enc_s4_l0", "enc_s4_l1"]
    assert record.score.provenance.settings["readout"] == "published"
    with pytest.raises(UsageError, match="received _Tiny"):
        score_record(_Tiny(), **given)
    with pytest.raises(UsageError, match="computed elsewhere"):
        score_record({"fc": np.ones((6, 2))}, **given)


def test_scores_of_mappings_follow_the_order_of_the_stimuli(
    recordings: xr.Dataset, arrays: Path, truth: Path, geometry
):
    by_file = brainbench.score(str(truth), recordings=recordings)
    by_mapping = brainbench.score(
        {"other": geometry(9), "true": geometry()}, recordings=recordings, stimuli=str(arrays)
    )
    assert by_mapping.value == pytest.approx(by_file.value, abs=1e-6)
    with pytest.raises(UsageError, match=r"expected \[6, F\]"):
        brainbench.score({"fc": np.ones((5, 2))}, recordings=recordings, stimuli=str(arrays))


def test_both_time_rules_agree_when_there_is_one_step(truth: Path, recordings: xr.Dataset):
    mean, concatenated = (
        brainbench.score(str(truth), recordings=recordings, time=rule) for rule in ("mean", "concatenate")
    )
    assert mean.value == pytest.approx(concatenated.value, abs=1e-12)
    assert dataclasses.asdict(mean)["stimuli"] == LABELS


def test_steps_that_are_compared_with_one_bin_of_the_recordings_are_said(recordings: xr.Dataset, tmp_path: Path):
    steps = np.random.default_rng(0).normal(size=(len(LABELS), 5, 3))
    path = str(write_features(tmp_path / "steps.h5", LABELS, {"fc": steps}))
    told = {
        rule: " ".join(brainbench.score(path, recordings=recordings, time=rule).reasons)
        for rule in ("mean", "concatenate")
    }
    assert "5 time steps of the network are compared with one bin of the recordings" in told["concatenate"]
    assert "one bin" not in told["mean"]


def test_a_layer_can_be_committed_to_and_a_typo_is_corrected(truth: Path, recordings: xr.Dataset):
    record = score_record(str(truth), recordings=recordings, layer="other", baselines=False)
    assert (record.score.layer, record.score.layer_rule) == ("other", "committed to beforehand")
    assert record.card is not None
    assert record.card.layer == record.score.provenance.settings["layer"] == "other"
    with pytest.raises(UsageError, match="did you mean 'other'"):
        score_record(str(truth), recordings=recordings, layer="othr")


@pytest.mark.parametrize("choice", [{"layer": "fcc"}, {"layers": ("fc", "fcc")}, {"layer": "fcc[0]"}])
@pytest.mark.parametrize("named", [False, True])
def test_a_layer_that_a_network_does_not_have_is_told_before_recordings_are_read(tmp_path: Path, choice, named):
    class Named(_Tiny):
        layers = ("fc",)

        def activations(self, x, layers):
            return {"fc": self(x)}

    with pytest.raises(UsageError, match=r"Unknown layer 'fcc.*did you mean 'fc'"):
        score_record(Named() if named else _Tiny(), recordings=str(tmp_path / "none.nwb"), **choice)


def test_unreliable_units_can_be_left_out_and_are_counted(truth: Path, recordings: xr.Dataset):
    every = brainbench.score(str(truth), recordings=recordings)
    some = brainbench.score(str(truth), recordings=recordings, units_reliability=0.9)
    assert sum(item.units for item in some.subjects) < sum(item.units for item in every.subjects)
    assert any("reliability of their tuning below 0.9" in reason for reason in some.reasons)
    none = brainbench.score(str(truth), recordings=recordings, units_reliability=1 - 1e-12)
    assert none.status == "undefined"
    assert all("reliability of their tuning below" in reason for reason in none.reasons if "left out" in reason)
    with pytest.raises(UsageError, match=r"received 1\.5"):
        brainbench.score(str(truth), recordings=recordings, units_reliability=1.5)


def test_the_published_estimators_use_correlation_distances(truth: Path, recordings: xr.Dataset):
    assert "correlation RDM, pearson" in brainbench.score(str(truth), recordings=recordings, estimator="thesis").metric
    with pytest.raises(UsageError, match="'ridge'"):
        brainbench.score(str(truth), recordings=recordings, estimator="thesis", metric="ridge")


def test_a_record_states_the_part_or_why_there_is_none(files):
    options = {"recordings": files["recordings"], "stimuli": files["arrays"], "conditions": "trials:texture"}
    part = score_record(files["model"], **options).score.provenance.unique
    assert part.status == "undefined"
    assert "stimuli are too few" in part.reasons[0]
    assert score_record(files["model"], baselines=False, **options).score.provenance.unique is None
    assert score_record(files["model"], metric="cka", **options).score.provenance.unique is None


def test_a_doubted_score_has_a_doubted_unique_part():
    rng, labels = np.random.default_rng(0), np.repeat(np.arange(12), 8)
    hidden, names = rng.normal(size=(12, 5)), [f"s{place}" for place in range(12)]
    metric, animals = get_metric("rsa"), []
    for animal in range(3):
        responses = (hidden @ rng.normal(size=(5, 40)))[labels] + rng.normal(size=(96, 40))
        keys = [f"{animal}/{trial}" for trial in range(96)]
        animals.append(metric.animal(f"m{animal}", [Trials(responses, labels, keys)], 12))
    how = {"name": "net", "stimuli": names, "controls": {"raw input": rng.normal(size=(12, 5))}}
    score = metric.score({"layer": hidden}, animals, **how)
    part = score.provenance.unique
    assert (score.status, part.status) == ("ok", "ok")
    assert part.unique > 0.8
    doubted = held_parts(replace(score, status="unreliable")).provenance.unique
    assert (doubted.status, doubted.unique) == ("unreliable", part.unique)
    assert held_parts(score) is score
    undefined = metric.score({"layer": np.ones((12, 5))}, animals, **how).provenance.unique
    assert (undefined.status, undefined.reasons) == ("undefined", ("the score is undefined",))
    assert metric.score({"layer": hidden}, animals, name="net", stimuli=names).provenance.unique is None
    assert get_metric("cka").score({"layer": hidden}, animals, **how).provenance.unique is None


def test_progress_names_animals_and_models_as_they_are_done(files):
    stages = []
    how = {"recordings": files["recordings"], "stimuli": files["arrays"], "conditions": "trials:texture"}
    score_record(files["model"], progress=lambda done, total, what: stages.append((done, total, what)), **how)
    assert [stage for stage in stages if stage[2] == "animals"] == [
        (0, 2, "animals"),
        (1, 2, "animals"),
        (2, 2, "animals"),
    ]
    assert [done for done, total, what in stages if what == "models"] == [0, 1, 2, 3]


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


def test_units_that_never_vary_between_trials_are_no_neurons_where_they_decide():
    hidden, animals = _make_animals()
    metric = get_metric("rsa")
    rng, marked = np.random.default_rng(1), []
    for animal in animals:
        # Three channels of the apparatus, each a number of the stimulus: none has half of the tuning.
        exact = 20 * rng.normal(size=(10, 3))
        patterns = np.concatenate([animal.patterns, exact], axis=1)
        marked.append(replace(animal, patterns=patterns, noise=np.pad(animal.noise, ((0, 0), (0, 3))), units=33))
    assert influence_of(_score(hidden, marked), metric, marked)[1] == ()
    assert of_no_neurons(metric, marked).endswith("3 of 3 animals (m0: 3 of 33): leave them out")
    assert of_no_neurons(metric, animals) == of_no_neurons(get_metric("rsa-crossnobis"), marked) == ""
    # Of a program all units are exact.
    assert of_no_neurons(metric, [replace(each, noise=0 * each.noise) for each in marked]) == ""


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
