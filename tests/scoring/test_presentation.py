"""The order of presentation: blocks under drift are no tuning, and the times of presentation are a control."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.statistics import presentation_order
from brainbench.scoring.presentation import CONTROL
from brainbench.scoring.scores import score_record

STIMULI, TRIALS, UNITS = 12, 8, 30
NAMES = tuple(f"s{index:02d}" for index in range(STIMULI))


def _make_recordings(*, blocked, tuning=0.0, animals=4, times=True, blocks=1, turn=0.0, steps=()):
    """Counts of neurons whose rates drift over the session, tuned to a shared geometry by ``tuning``.

    Each stimulus has ``blocks`` runs of trials in changing order, or one run in each of the orders that ``steps`` say:
    1 for that of the stimuli, −1 for the reverse. By the end of the session the tuning is to another geometry, by
    ``turn`` of a right angle.
    """
    rng, parts = np.random.default_rng(0), []
    geometry, later = rng.normal(size=(STIMULI, 4)), np.random.default_rng(7).normal(size=(STIMULI, 4))
    counts = np.full((animals, STIMULI * TRIALS, 1, animals * UNITS), np.nan)
    for animal in range(animals):
        labels = np.repeat(np.arange(STIMULI), TRIALS)
        if blocks > 1 or steps:
            runs = [np.random.default_rng(place).permutation(STIMULI) for place in range(blocks)]
            runs = [np.arange(STIMULI)[::step] for step in steps] or runs
            labels = np.repeat(np.concatenate(runs), TRIALS // len(runs))
        labels = labels if blocked else rng.permutation(labels)
        time = np.linspace(-1, 1, len(labels))[:, None]
        drift = 0.35 * np.concatenate([time, time**2], axis=1) @ rng.normal(size=(2, UNITS))
        angle = np.pi / 2 * turn * (time + 1) / 2
        weights = rng.normal(size=(4, UNITS))
        tuned = np.cos(angle) * (geometry @ weights)[labels] + np.sin(angle) * (later @ weights)[labels]
        rate = 20 * np.exp(drift + tuning * tuned)
        counts[animal, :, 0, animal * UNITS : (animal + 1) * UNITS] = rng.poisson(rate)
        parts.append(labels)
    trials, units = np.repeat(np.arange(animals), STIMULI * TRIALS), np.repeat(np.arange(animals), UNITS)
    coordinates = {
        "time": ("time", [0.0]),
        "stimulus": ("trial", [NAMES[label] for labels in parts for label in labels]),
        "subject": ("trial", [f"m{animal}" for animal in trials]),
        "session": ("trial", ["1"] * len(trials)),
        "trial_id": ("trial", [str(row) for row in range(len(trials))]),
        "unit_subject": ("unit", [f"m{animal}" for animal in units]),
        "unit_session": ("unit", ["1"] * len(units)),
        "unit_id": ("unit", [str(unit) for unit in range(len(units))]),
    }
    if times:
        coordinates["window_start"] = ("trial", np.tile(np.arange(STIMULI * TRIALS, dtype=float), animals))
    values = counts.reshape(-1, 1, animals * UNITS)
    dataset = xr.Dataset(
        {
            "counts": (("trial", "time", "unit"), values.astype(np.float32)),
            "duration": (("trial", "time"), np.ones(values.shape[:2])),
        },
        coordinates,
    )
    about = {"window": "", "selection": {}, "removed": {}, "synthetic": True, "content_hash": "made", "source": "test"}
    return dataset.assign_attrs(vocabulary=list(NAMES), **about), geometry


def _score(folder, features, recordings):
    path = folder / "features.h5"
    with h5py.File(path, "w") as file:
        file.attrs["brainbench_features"] = 1
        file.create_dataset("labels", data=list(NAMES), dtype=h5py.string_dtype())
        file["activations/layer"] = features
    return score_record(str(path), recordings=recordings)


def _rank():
    return np.arange(STIMULI)[:, None] + 0.3 * np.random.default_rng(1).normal(size=(STIMULI, 3))


def test_the_label_explains_the_times_of_blocks_and_nothing_of_interleaved_trials():
    labels, times = np.repeat(np.arange(8), 10), np.arange(80.0)
    blocked = presentation_order(times, labels)
    assert (round(blocked.share, 2), blocked.confounded) == (0.98, True)
    for seed in range(200):
        shuffled = presentation_order(times, np.random.default_rng(seed).permutation(labels))
        assert not shuffled.confounded
        assert shuffled.expected == pytest.approx(7 / 79, abs=0.02)
    # One of each label in every block of eight explains less than chance.
    assert not presentation_order(times, np.tile(np.arange(8), 10)).confounded
    assert presentation_order(times, np.tile([0, 1], 40)) is None
    for steps in [(1, -1), (1, 1), (1, 1, 1, 1), (1, -1, 1, -1)]:
        again = np.concatenate([np.repeat(np.arange(8)[::step], 20 // len(steps)) for step in steps])
        order = presentation_order(np.arange(160.0), again)
        assert (order.waves, order.confounded) == (2 * len(steps) // (1 + (-1 in steps)), True)
        assert f"slow changes ({order.waves} half waves over the session)" in str(order)


def test_the_clock_scores_in_blocks_under_drift_and_is_not_believed(tmp_path):
    recordings, _ = _make_recordings(blocked=True)
    record = _score(tmp_path, _rank(), recordings)
    assert record.score.p <= 0.01
    assert record.score.status == "unreliable"
    assert "confounded in 4 of 4 sessions" in record.score.reasons[0]
    assert record.baselines[CONTROL].scaled > 0.7
    assert record.score.provenance.statistics["presentation"]["confounded"] == 4


@pytest.mark.parametrize("steps", [(1, -1), (1, 1, 1, 1)])
def test_blocks_that_come_again_in_one_order_or_the_reverse_are_not_believed(tmp_path, steps):
    # The mean times of all stimuli are then equal, or nearly so, and parts by time agree: drift repeats its geometry.
    recordings, _ = _make_recordings(blocked=True, steps=steps)
    record = _score(tmp_path, _rank(), recordings)
    assert record.score.p <= 0.01
    assert record.score.scaled > 0.3
    assert record.score.status == "unreliable"
    assert "confounded in 4 of 4 sessions" in record.score.reasons[0]
    assert record.baselines[CONTROL].scaled > 0.3


def test_tuned_neurons_in_repeated_blocks_are_believed_where_slow_waves_explain_nothing(tmp_path):
    recordings, geometry = _make_recordings(blocked=False, tuning=0.2)
    order = np.tile(np.concatenate([np.repeat(np.arange(STIMULI)[::step], TRIALS // 2) for step in (1, -1)]), 4)
    labels, times = recordings["stimulus"].values.reshape(4, -1), np.empty(4 * STIMULI * TRIALS)
    for animal, place in enumerate(times.reshape(4, -1)):
        place[np.argsort(labels[animal], kind="stable")] = np.argsort(order[: place.size], kind="stable")
    record = _score(tmp_path, geometry, recordings.assign_coords(window_start=("trial", times)))
    assert record.score.provenance.statistics["presentation"]["confounded"] == 4
    assert record.baselines[CONTROL].p > 0.05
    assert record.score.status == "ok"


def test_tuned_neurons_in_an_interleaved_session_are_believed(tmp_path):
    recordings, geometry = _make_recordings(blocked=False, tuning=0.2)
    record = _score(tmp_path, geometry, recordings)
    assert record.score.status == "ok"
    assert not any("confounded" in reason for reason in record.score.reasons)
    assert record.baselines[CONTROL].scaled < 0.3


def test_blocks_whose_times_explain_nothing_are_believed_and_unknown_times_make_no_control(tmp_path):
    recordings, geometry = _make_recordings(blocked=False, tuning=0.2)
    # Blocked order without drift of the tuned neurons: the times are those of blocks, the rates are not.
    order = np.argsort(recordings["stimulus"].values.reshape(4, -1), axis=1, kind="stable")
    times = np.empty(order.shape)
    np.put_along_axis(times, order, np.arange(order.shape[1], dtype=float)[None], axis=1)
    record = _score(tmp_path, geometry, recordings.assign_coords(window_start=("trial", times.ravel())))
    assert record.score.provenance.statistics["presentation"]["confounded"] == 4
    assert record.baselines[CONTROL].p > 0.05
    assert record.score.status == "ok"
    unknown, _ = _make_recordings(blocked=True, times=False)
    assert CONTROL not in _score(tmp_path, _rank(), unknown).baselines


def test_trials_that_begin_together_have_one_place_however_they_are_listed(tmp_path):
    recordings, _ = _make_recordings(blocked=True)
    alike = recordings.assign_coords(window_start=("trial", np.zeros(recordings.sizes["trial"])))
    # In the order of their labels the trials of one time were a clock, which explains the drift of these rates.
    assert _score(tmp_path, _rank(), alike).baselines[CONTROL].status == "undefined"


def test_runs_of_each_stimulus_under_drift_are_reliable_in_random_halves_alone(tmp_path):
    # Four runs each, as in many experiments: the label explains nothing of the times, and random halves share the runs.
    recordings, geometry = _make_recordings(blocked=True, blocks=4)
    score = _score(tmp_path, geometry, recordings).score
    statistics = score.provenance.statistics
    assert statistics["presentation"]["confounded"] == 0
    assert statistics["drift"]["within"]["random"] > 0.9 > 0.4 > statistics["drift"]["within"]["by_time"]
    assert score.status == "unreliable"
    assert score.reasons[0].startswith("responses drift within sessions: parts by time have a reliability of 0.00")


def test_tuning_that_turns_within_a_session_is_a_remark_where_both_halves_are_reliable(tmp_path):
    recordings, geometry = _make_recordings(blocked=False, tuning=0.2, turn=1.0)
    score = _score(tmp_path, geometry, recordings).score
    assert score.status == "ok"
    assert sum("drift within sessions" in reason for reason in score.reasons) == 1
    steady = _make_recordings(blocked=False, tuning=0.2)[0]
    assert not any("drift" in reason for reason in _score(tmp_path, geometry, steady).score.reasons)
