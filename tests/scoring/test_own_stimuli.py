"""Recordings whose trials have tracks of their own meet what is simulated of these tracks, trial by trial."""

import numpy as np
import pytest
from torch import nn

import brainbench
from brainbench.cli.leaderboard.verify import Repetition, score_again
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.models.features import write_features
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
