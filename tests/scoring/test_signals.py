"""Signals made from known spikes score as the spikes do."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.datasets.synthetic import ResponseGeometry
from brainbench.metrics.measures.rsa import RSA
from brainbench.scoring.neural_responses import NeuralResponses
from brainbench.scoring.options import ScoreOptions
from tests.factories.recordings import make_sessions, quiet_design

FRAME, DECAY = 0.05, 0.3
TIME = np.arange(-0.4, 1.2, FRAME)


class Quick(RSA):
    splits, orders = 20, 199


def imaged(session, random):
    """The ΔF/F of an indicator that every spike raises by 10 %, around the touch of each trial."""
    trials = session.tables["trials"]
    touch = session.tables["contacts_by_whisker_C1"].times("start_time")
    frames = np.arange(0.0, trials.times("stop_time").max() + 2.0, FRAME)
    spikes = session.units.rows("spike_times")
    raised = np.stack([np.histogram(times, np.append(frames, frames[-1] + FRAME))[0] for times in spikes], axis=1)
    kernel = np.exp(-np.arange(0, 2.0, FRAME) / DECAY)
    trace = 0.1 * np.apply_along_axis(np.convolve, 0, raised, kernel)[: len(frames)]
    trace += random.normal(0, 0.1, trace.shape)
    place = np.searchsorted(frames, touch[:, None] + TIME)
    table = {"start_time": touch, "stop_time": touch + 0.5, "stimulus": trials.column("stimulus")}
    return make_session(session.subject, "1", None, {"trials": table}, response=trace[place], time=TIME, unit="dF/F")


def scored(path, sessions, features, labels, window):
    data = open_recordings(write_recordings(path, sessions), conditions="trials:stimulus", window=window)
    metric = Quick()
    animals = NeuralResponses(data, "test").animals(labels, metric, ScoreOptions())
    return metric.score({"layer": features}, animals, name="truth", stimuli=labels)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_dff_of_known_spikes_scores_within_the_interval_of_the_spikes(tmp_path, seed):
    random = np.random.default_rng(seed)
    features = random.normal(size=(12, 5))
    geometry = ResponseGeometry.from_features(features)
    sessions = make_sessions(geometry, quiet_design(animals=5, trials=10, window=0.5, emphasis=0.3), seed=seed)
    spikes = scored(tmp_path / "a.h5", sessions, features, geometry.labels, "first-contact..choice")
    signals = [imaged(session, random) for session in sessions]
    window = "start..+0.8 minus start-0.3..start"
    dff = scored(tmp_path / "b.h5", signals, features, geometry.labels, window)
    assert spikes.status == dff.status == "ok"
    assert spikes.interval.low <= dff.value <= spikes.interval.high
    assert dff.value > 0.5
