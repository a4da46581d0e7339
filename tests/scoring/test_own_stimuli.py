"""Recordings whose trials have tracks of their own meet what is simulated of these tracks, trial by trial."""

import json
import random

import numpy as np
import pytest
from torch import nn

import brainbench
from brainbench.cli.leaderboard.verify import Repetition, score_again
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.models.features import write_features
from brainbench.scoring.own_stimuli import mean_rows, shared_variance
from brainbench.scoring.scores import score_record
from brainbench.stimuli import load_stimuli
from leaderboards.audit import differences

LABELS, REPEATS, ANIMALS, UNITS = ("a", "b", "c", "d", "e", "f"), 10, 2, 60
SCENES = """
[array]
whiskers = "C1,C2"
[whisking]
kind = "track"
layout = "angles"
path = "tracks/{trial}.csv"
[frames]
first_ms = 10
interval_ms = 10
count = 15
[[scene]]
label = "{trial}"
"""


def write_trial(path, mean, rng):
    """Both whiskers protract to angles (degrees) of the stimulus, more or less, at their own pace."""
    times = np.arange(0, 0.2, 0.002)
    heights = mean + rng.normal(0, 2, 2)
    pace = 1 + 0.2 * rng.normal(size=2)
    rows = [heights * np.sin(2 * np.pi * 6 * pace * time) ** 2 for time in times]
    lines = [f"{time:.3f},{one:.5f},{two:.5f}" for time, (one, two) in zip(times, rows, strict=True)]
    path.write_text("\n".join(["time_s,RC1.theta_deg,RC2.theta_deg", *lines]) + "\n")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Tracks of all trials, the scene file that plays them, and animals that feel the forces of their own trials."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "tracks").mkdir()
    (folder / "trials.toml").write_text(SCENES)
    rng = np.random.default_rng(3)
    means = rng.uniform(5, 40, (len(LABELS), 2))
    order = [rng.permutation(np.repeat(np.arange(len(LABELS)), REPEATS)) for _ in range(ANIMALS)]
    for animal, stimuli in enumerate(order):
        for trial, stimulus in enumerate(stimuli):
            write_trial(folder / "tracks" / f"m{animal}_s_{trial}.csv", means[stimulus], rng)
    stimuli = load_stimuli(folder / "trials.toml", fidelity="fast,links=6")
    forces = stimuli.dataset["wrench"].values[..., :3].reshape(len(stimuli.labels), -1)
    forces = (forces - forces.mean(axis=0)) / forces.std()
    felt = dict(zip(stimuli.labels, forces, strict=True))
    (folder / "recordings").mkdir()
    for animal, kinds in enumerate(order):
        mixing = rng.normal(size=(forces.shape[1], UNITS)) / np.sqrt(forces.shape[1])
        starts = 1.0 + 1.5 * np.arange(len(kinds))
        rates = [12 * np.exp(np.clip(felt[f"m{animal}_s_{trial}"] @ mixing, -2, 2)) for trial in range(len(kinds))]
        drawn = [start + rng.uniform(0, 1, (UNITS, 60)) for start in starts]
        counts = [np.minimum(rng.poisson(rate), 60) for rate in rates]
        spikes = [
            np.sort(np.concatenate([times[unit, : count[unit]] for times, count in zip(drawn, counts, strict=True)]))
            for unit in range(UNITS)
        ]
        table = {"start_time": starts, "stop_time": starts + 1.0, "stimulus": [LABELS[k] for k in kinds]}
        span = np.array([[0.0, starts[-1] + 2]])
        session = make_session(f"m{animal}", "s", spikes, {"trials": table}, observed=[span] * UNITS)
        write_recordings(folder / "recordings" / f"m{animal}.h5", session)
    return folder, stimuli


class Forces(nn.Module):
    """Hands its input on, so that features are the forces themselves."""

    def __init__(self):
        super().__init__()
        self.flat = nn.Flatten(2)

    def forward(self, x):
        return self.flat(x)


def score_of(study, model=None, *, stimuli=None, **options):
    folder, _ = study
    how = {"conditions": "trials:stimulus", "fidelity": "fast,links=6", "match": "trial", "time": "concatenate"}
    given = {"recordings": str(folder / "recordings"), "stimuli": str(stimuli or folder / "trials.toml")}
    return score_record(model or Forces(), **{"baselines": False, **how, **given, **options})


@pytest.mark.slow
def test_recordings_meet_the_stimuli_of_their_own_trials(study, tmp_path):
    record = score_of(study)
    assert record.score.stimuli == LABELS
    assert record.score.status == "ok"
    assert record.score.value > 0.8
    assert record.score.provenance.settings["match"] == "trial"
    assert not [reason for reason in record.score.reasons if "own" in reason]
    # The same tracks under the names of other trials.
    folder, _ = study
    (tmp_path / "tracks").mkdir()
    (tmp_path / "trials.toml").write_text(SCENES)
    paths = sorted((folder / "tracks").iterdir())
    for path, place in zip(paths, np.random.default_rng(0).permutation(len(paths)), strict=True):
        (tmp_path / "tracks" / path.name).write_text(paths[place].read_text())
    assert score_of(study, stimuli=tmp_path / "trials.toml").score.value < record.score.value - 0.3


def test_features_are_means_over_the_trials_of_a_label(study, tmp_path):
    folder, stimuli = study
    features = np.random.default_rng(1).normal(size=(len(stimuli.labels), 40))
    path = write_features(tmp_path / "own.h5", stimuli.labels, {"layer": features})
    data = open_recordings(folder / "recordings", conditions="trials:stimulus")
    names = [
        f"{animal}_s_{trial}" for animal, trial in zip(data["subject"].values, data["trial_id"].values, strict=True)
    ]
    rows = np.array([stimuli.labels.index(name) for name in names])
    means = [features[rows[data["stimulus"].values == label]].mean(axis=0) for label in LABELS]
    averaged = write_features(tmp_path / "means.h5", LABELS, {"layer": np.stack(means)})
    own, whole = (
        score_of(study, str(path), stimuli="rodgers", fidelity="balanced", time="mean"),
        score_of(study, str(averaged), stimuli="rodgers", fidelity="balanced", time="mean", match=None),
    )
    assert own.score.value == pytest.approx(whole.score.value, abs=1e-9)
    assert own.score.model_rdm == pytest.approx(whole.score.model_rdm, abs=1e-9)


def test_what_does_not_join_is_said(study, tmp_path):
    folder, stimuli = study
    lost = {"m0_s_3", "m1_s_5", "m1_s_6"}
    labels = [label for label in stimuli.labels if label not in lost] + ["m9_s_0"]
    path = write_features(tmp_path / "x.h5", labels, {"layer": np.random.default_rng(1).normal(size=(len(labels), 40))})
    how = {"stimuli": "rodgers", "fidelity": "balanced", "time": "mean"}
    record = score_of(study, str(path), baselines=True, **how)
    reasons = " ".join(record.score.reasons)
    assert "3 of 120 trials have no stimulus of their own and are left out: 's_3', 's_5', 's_6'" in reasons
    assert "1 of 118 stimuli belong to no trial: 'm9_s_0'" in reasons
    trials = record.score.provenance.recordings["ledger"]["trials"]
    assert trials["read"] == 117
    assert {"reason": "no stimulus of their own", "number": 3, "lost": True} in trials["left_out"]
    assert trials["found"] == trials["read"] + sum(entry["number"] for entry in trials["left_out"])
    with pytest.raises(DataError, match="3 of 120 trials"):
        score_of(study, str(path), strict=True, **how)
    again = score_again(record, Repetition(str(folder / "recordings"), trust_code=True))
    assert differences(record, again) == []


@pytest.mark.parametrize("lost", [0, 3])
def test_a_score_by_trial_is_not_computed_again(felt, run, tmp_path, lost):
    folder, values = felt
    names = ["_".join(map(str, trial)) for trial in values]
    path = write_features(tmp_path / "own.h5", names[lost:], {"layer": np.stack([*values.values()])[lost:]})
    options = f'recordings = "{folder}"\nconditions = "trials:stimulus"\nmatch = "trial"\n'
    (tmp_path / "batch.toml").write_text(f'[options]\n{options}[[entries]]\nmodels = ["{path}"]\n')
    add = ("leaderboard", "add", "--batch", str(tmp_path / "batch.toml"), "--to", str(tmp_path / "board"), "--json")
    states = [entry["state"] for _ in range(2) for entry in json.loads(run(*add).out)["results"]]
    assert states == ["scored", "known"]


def test_a_score_by_trial_is_computed_on_held_out_stimuli_too(felt, run, tmp_path, monkeypatch):
    # Nobody can know which stimuli are held out; of these six, a few draws of four are too alike to be scored.
    monkeypatch.setattr("secrets.SystemRandom", lambda: random.Random(0))
    folder, values = felt
    path = write_features(tmp_path / "own.h5", ["_".join(map(str, trial)) for trial in values],
                          {"layer": np.stack([*values.values()])})  # fmt: skip
    board, secret = str(tmp_path / "board"), ("--secret", str(tmp_path / "secret"))
    hold = ("leaderboard", "hold-out", str(folder), "--stimuli", "4", "--conditions", "trials:stimulus")
    assert run(*hold, "--out", board, *secret).status == 0
    score = ("score", str(path), "--recordings", f"{board}/public.h5", "--match", "trial", "--out", str(tmp_path))
    assert run(*score).status == 0
    (record,) = tmp_path.glob("own--*.json")
    verify = ("leaderboard", "verify", str(record), "--held-out", f"{board}/held-out.json", "--no-score", *secret)
    result = run(*verify, "--trust-code", "--json")
    assert json.loads(result.out)[0]["on_held_out"]["score"] > 0.5


def test_a_label_without_any_trial_is_dropped(study, tmp_path):
    data = open_recordings(study[0] / "recordings", conditions="trials:stimulus")
    names = zip(data["subject"].values, data["trial_id"].values, data["stimulus"].values, strict=True)
    labels = [f"{animal}_s_{trial}" for animal, trial, stimulus in names if stimulus != "f"]
    path = write_features(tmp_path / "x.h5", labels, {"layer": np.random.default_rng(1).normal(size=(len(labels), 40))})
    record = score_of(study, str(path), stimuli="rodgers", fidelity="balanced", time="mean")
    assert record.score.stimuli == LABELS[:5]
    assert record.score.provenance.pairs["f"] is None


def test_stimuli_of_no_trial_are_refused(study, tmp_path):
    path = write_features(tmp_path / "x.h5", LABELS, {"layer": np.eye(6)})
    with pytest.raises(UsageError, match=r"No trial has a stimulus of its own: trials are 'm0_s_0'.*Name each track"):
        brainbench.score(
            str(path), recordings=str(study[0] / "recordings"), conditions="trials:stimulus", match="trial"
        )


def write_animals(folder, *, names=(("m0", "s"), ("m1", "s")), apart=False, ids=None):
    """Write animals whose 40 units mix six features of each trial; return these by (animal, session, row)."""
    rng, felt = np.random.default_rng(4), {}
    shared = rng.normal(size=(8, 6))
    for animal, session in names:
        means = rng.normal(size=(8, 6)) if apart else shared
        kinds = rng.permutation(np.repeat(np.arange(8), 10))
        features = means[kinds] + 0.3 * rng.normal(size=(80, 6))
        rates = 20 * np.exp(np.clip(0.6 * features @ rng.normal(size=(6, 40)) / np.sqrt(6), -2, 2))
        starts = 1.0 + 1.5 * np.arange(80)
        spikes = [
            np.sort(np.concatenate([begin + rng.uniform(0, 1, rng.poisson(unit[k])) for k, begin in enumerate(starts)]))
            for unit in rates.T
        ]
        table = {"start_time": starts, "stop_time": starts + 1.0, "stimulus": [f"k{kind}" for kind in kinds]}
        table |= {} if ids is None else {"id": ids}
        made = make_session(animal, session, spikes, {"trials": table}, observed=[np.array([[0.0, 125.0]])] * 40)
        write_recordings(folder / f"{animal}-{session}.h5", made)
        felt |= {(animal, session, row): values for row, values in enumerate(features)}
    return felt


def score_features(folder, labels, values, **options):
    path = write_features(folder.parent / "features.h5", list(labels), {"layer": np.asarray(values)})
    how = {"recordings": str(folder), "conditions": "trials:stimulus", "match": "trial", "baselines": False}
    return score_record(str(path), **how, **options).score


@pytest.fixture(scope="module")
def felt(tmp_path_factory):
    folder = tmp_path_factory.mktemp("felt") / "recordings"
    folder.mkdir()
    return folder, write_animals(folder)


NAMES = {
    "as they are": "{}_{}_{}",
    "with slashes": "{}/{}/{}",
    "with zeros": "{}_{}_{:03d}",
    "with blanks": " {}_{}_{} ",
}


def test_spellings_and_order_of_names_change_nothing(felt):
    folder, values = felt
    scores = [
        score_features(folder, (name.format(*trial) for trial in reversed(values)), [*values.values()][::-1])
        for name in NAMES.values()
    ]
    assert {score.status for score in scores} == {"ok"}
    assert len({score.value for score in scores}) == 1
    assert scores[0].value > 0.8


@pytest.mark.parametrize(("first", "step", "word"), [(0, 1, "after"), (1, -1, "before")])
def test_stimuli_that_count_from_another_number_are_not_trusted(tmp_path, first, step, word):
    (tmp_path / "recordings").mkdir()
    values = write_animals(tmp_path / "recordings", ids=np.arange(first, first + 80))
    names = (f"{animal}_{session}_{first + row + step}" for animal, session, row in values)
    score = score_features(tmp_path / "recordings", names, [*values.values()])
    assert score.status == "unreliable"
    assert f"160 trials have a stimulus of the number {word} theirs, 158 of their own" in score.reasons[0]


def test_missing_trials_beside_unused_stimuli_put_the_names_in_doubt(felt):
    folder, values = felt
    names = [f"{animal}_{session}_{row if row < 70 else row + 500}" for animal, session, row in values]
    score = score_features(folder, names, [*values.values()])
    assert score.status == "unreliable"
    assert "20 trials have no stimulus and 20 stimuli no trial" in score.reasons[0]


def test_two_stimuli_of_one_trial_are_refused(felt):
    folder, values = felt
    names = [f"{animal}_{session}_{row}" for animal, session, row in values]
    with pytest.raises(UsageError, match="'m0_s_0', 'm0/s/00' are of one trial"):
        score_features(folder, [*names, "m0/s/00"], [*values.values(), np.zeros(6)])


def test_numbers_of_several_sessions_are_named(felt):
    folder, values = felt
    with pytest.raises(UsageError, match="'0' names several trials"):
        score_features(folder, map(str, range(80)), [*values.values()][:80])


def test_the_command_joins_by_trial_and_others_say_that_they_do_not(felt, run, tmp_path):
    folder, values = felt
    names = ["_".join(map(str, trial)) for trial in values]
    path = write_features(tmp_path / "own.h5", names, {"layer": np.stack([*values.values()])})
    how = ("--recordings", str(folder), "--conditions", "trials:stimulus", "--match", "trial")
    found = run("score", str(path), *how, "--out", str(tmp_path), "--json")
    assert found.status == 0, found.err
    assert score_features(folder, names, [*values.values()]).value == pytest.approx(
        json.loads(found.out)["record"]["score"]["value"], abs=1e-9
    )
    (tmp_path / "trials.toml").write_text(SCENES)
    refused = run("recovery", "--stimuli", str(tmp_path / "trials.toml"))
    assert (refused.status, "are single trials, and a recovery shows each" in refused.err) == (2, True)
    made = run("benchmark", "make", *how, "--name", "x", "--out", str(folder / "b.toml"))
    assert (made.status, "'trial' joins the single trials of a score, and only that" in made.err) == (2, True)


def test_animals_that_met_other_stimuli_under_one_label_are_scored_apart(tmp_path):
    (tmp_path / "recordings").mkdir()
    values = write_animals(tmp_path / "recordings", apart=True)
    names = ["_".join(map(str, trial)) for trial in values]
    together = score_features(tmp_path / "recordings", names, [*values.values()])
    assert together.status == "unreliable"
    assert "animals met other stimuli under one label: 0% of the variance" in together.reasons[0]
    # A layer that animals have in common takes no doubt from the others.
    data = open_recordings(tmp_path / "recordings", conditions="trials:stimulus")
    ids = zip(*(data[name].values.tolist() for name in ("subject", "session", "trial_id")), strict=True)
    kinds = dict(zip(map("_".join, ids), data["stimulus"].values.tolist(), strict=True))
    noise = np.random.default_rng(0).normal(size=(len(names), 8))
    common = np.array([np.eye(8)[int(kinds[name][1:])] for name in names]) + 1e-3 * noise
    for layer in (common, noise):
        path = write_features(tmp_path / "two.h5", names, {"own": np.stack([*values.values()]), "other": layer})
        how = {"recordings": data, "match": "trial", "baselines": False}
        assert score_record(str(path), **how).score.status == "unreliable"
    path = write_features(tmp_path / "two.h5", names, {"common": common, "noise": noise})
    assert "animals met" not in " ".join(score_record(str(path), **how).score.reasons)
    alone = score_features(tmp_path / "recordings", names, [*values.values()], select="subjects=m1")
    assert alone.status == "ok"
    assert alone.value > together.value + 0.05


def test_whole_numbers_in_memory_keep_the_digits_of_their_means(felt):
    folder, values = felt
    data = open_recordings(folder, conditions="trials:stimulus")
    whole = np.round(3 * np.stack([*values.values()]))
    path = write_features(folder.parent / "names.h5", ["_".join(map(str, trial)) for trial in values], {"x": whole})
    means = mean_rows(whole.astype(np.int16), [[0, 1], [2]])
    assert means.dtype == np.float32
    np.testing.assert_allclose(means[0], whole[:2].mean(axis=0))
    assert brainbench.score(str(path), recordings=data, match="trial").status == "ok"


def test_the_common_share_of_variance_is_that_of_its_model():
    rng = np.random.default_rng(0)
    animals, labels = np.repeat(list("wxyz"), 400).tolist(), np.tile(np.repeat(np.arange(20), 20), 4).astype(str)
    for share in (0.0, 0.5, 0.9, 1.0):
        common, single = rng.normal(size=(20, 30)), rng.normal(size=(4, 20, 30))
        means = np.sqrt(share) * common + np.sqrt(1 - share) * single + 5 * rng.normal(size=(4, 1, 30))
        values = np.repeat(means.reshape(80, 30), 20, axis=0) + rng.normal(size=(1600, 30))
        order = rng.permutation(1600)
        shuffled = values[order], [animals[row] for row in order], labels[order].tolist()
        assert shared_variance(values, animals, labels.tolist()) == pytest.approx(share, abs=0.05)
        assert shared_variance(*shuffled) == pytest.approx(shared_variance(values, animals, labels.tolist()))
        assert shared_variance(1e3 * values, animals, labels.tolist()) == pytest.approx(share, abs=0.05)
    assert np.isnan(shared_variance(values[:400], animals[:400], labels[:400].tolist()))
