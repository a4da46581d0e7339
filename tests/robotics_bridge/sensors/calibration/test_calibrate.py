"""Calibration recovers what was planted, and says what it cannot know."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from brainbench.core.errors import DataError
from robotics_bridge.sensors.calibration.calibrate import calibrate, delay_of
from robotics_bridge.sensors.calibration.log import Log, find_quantum, read_log
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.noise.stages import simulate

DT = 0.005


def _presses(steps: int, seed: int = 0) -> np.ndarray:
    """Presses of random depth and length, with rises of random speed."""
    rng = np.random.default_rng(seed)
    signal = np.zeros(steps)
    at = 40
    while at < steps - 200:
        length, rise, depth = rng.integers(60, 200), rng.integers(2, 20), rng.uniform(0.5, 2.0)
        shape = np.minimum(np.minimum(np.arange(length) / rise, 1), np.arange(length)[::-1] / rise)
        signal[at : at + length] = depth * shape[: steps - at]
        at += length + int(rng.integers(30, 150))
    return signal


def _log(noise: Noise, steps: int = 2500, probes: int = 40, seed: int = 0) -> Log:
    x = _presses(steps, seed)
    y = simulate(noise, np.broadcast_to(x[:, None, None, None], (steps, 1, probes, 1)), dt=DT, seed=seed)
    return Log(np.arange(steps) * DT, y[:, 0, :, 0].astype(float), x)


PLANTED = Noise(
    white=0.02, walk=0.002, bias=0.05, quantum=0.01, gain=(0.8, 1.2), dead_probability=0.15, dead_range=(0.1, 0.6),
    hysteresis=0.4, hysteresis_tau=0.06, read_delay=0.03,
)  # fmt: skip


def test_planted_values_are_recovered_within_their_intervals():
    found = calibrate(_log(PLANTED))
    noise = found.noise
    assert noise.white == pytest.approx(0.02, rel=0.03)
    assert noise.walk == pytest.approx(0.002, rel=0.1)
    assert noise.quantum == pytest.approx(0.01, rel=1e-4)
    assert noise.hysteresis == pytest.approx(0.4, rel=0.05)
    assert noise.hysteresis_tau == pytest.approx(0.06, rel=0.05)
    assert noise.read_delay == pytest.approx(0.03, abs=1e-9)
    assert noise.jitter == 0
    assert noise.gain == pytest.approx((0.8, 1.2), abs=0.04)
    truth = {"walk": 0.002, "hysteresis": 0.4, "hysteresis_tau": 0.06, "dead_probability": 0.15, "gain_low": 0.8}
    truth |= {"gain_high": 1.2, "bias": 0.05}
    for name, value in truth.items():
        estimate = found.estimates[name]
        margin = 0.3 * (estimate.high - estimate.low)
        assert estimate.low - margin <= value <= estimate.high + margin, name
    assert 0.1 <= noise.dead_range[0] <= noise.dead_range[1] <= 0.6 + 1e-6


@pytest.mark.parametrize(
    ("jitter", "seed"),
    [(0.01, 1), pytest.param(0.005, 0, marks=pytest.mark.slow), pytest.param(0.02, 1, marks=pytest.mark.slow)],
)
def test_jitter_is_recovered_with_what_it_would_otherwise_blur(jitter, seed):
    noise = Noise(
        white=0.02, gain=(0.8, 1.2), hysteresis=0.4, hysteresis_tau=0.06, read_delay=0.03, jitter=jitter, bias=0.1
    )
    found = calibrate(_log(noise, steps=1500, probes=20, seed=seed))
    assert found.noise.jitter == pytest.approx(jitter, abs=1e-9)
    assert found.noise.read_delay == pytest.approx(0.03, abs=1e-9)
    assert found.noise.white == pytest.approx(0.02, rel=0.1)
    assert found.noise.hysteresis == pytest.approx(0.4, rel=0.1)
    assert found.noise.hysteresis_tau == pytest.approx(0.06, rel=0.1)


@pytest.mark.parametrize(("delay", "seed"), [(0.02, 0), (0.03, 1), (0.02, 4)])
def test_jitter_is_told_from_few_presses(delay, seed):
    found = calibrate(_log(Noise(white=0.02, read_delay=delay, jitter=0.01), steps=1500, probes=6, seed=seed))
    assert (found.noise.read_delay, found.noise.jitter) == pytest.approx((delay, 0.01), abs=1e-9)
    assert found.noise.white == pytest.approx(0.02, rel=0.05)
    assert abs(found.noise.hysteresis) < 0.02


def test_presses_that_the_model_does_not_explain_are_told():
    knobs = {"white": 0.02, "gain": (0.8, 1.2), "hysteresis": 0.4, "hysteresis_tau": 0.06, "bias": 0.1}
    told = [calibrate(_log(Noise(**knobs, read_delay=0.02, jitter=j), 1500, 6, seed=2)).notes for j in (0.0, 0.01)]
    assert [any("differ more from the model" in note for note in notes) for notes in told] == [False, True]


def test_a_log_may_begin_under_load():
    noise = Noise(white=0.02, hysteresis=0.4, hysteresis_tau=0.06, gain=(0.8, 1.2), read_delay=0.03)
    log = _log(noise, 1500, 12)
    assert log.reference[200] > 0.5
    found = calibrate(Log(log.time[200:], log.readings[200:], log.reference[200:])).noise
    assert (found.read_delay, found.jitter) == pytest.approx((0.03, 0.0), abs=1e-9)
    assert (found.hysteresis, found.hysteresis_tau) == pytest.approx((0.4, 0.06), rel=0.05)


@pytest.mark.slow
def test_a_sensor_may_be_reset_under_load():
    noise = Noise(white=0.02, hysteresis=0.4, hysteresis_tau=0.06, gain=(0.8, 1.2), read_delay=0.03)
    parts = []
    for seed in range(4):
        x = _presses(1000, seed)
        x = x[np.flatnonzero((x > 0.5) & (np.arange(1000) >= 200))[0] + 15 :][:600]
        y = simulate(noise, np.broadcast_to(x[:, None, None, None], (600, 1, 12, 1)), dt=DT, seed=seed)
        parts.append(np.column_stack([np.full(600, seed), x, y[:, 0, :, 0]]))
    table = np.concatenate(parts)
    found = calibrate(Log(np.arange(len(table)) * DT, table[:, 2:], table[:, 1], table[:, 0].astype(int))).noise
    assert (found.read_delay, found.jitter) == pytest.approx((0.03, 0.0), abs=1e-9)
    assert found.walk < 5e-4
    assert (found.hysteresis, found.hysteresis_tau) == pytest.approx((0.4, 0.06), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("rested", [True, False])
def test_creep_that_outlasts_the_delay_is_no_drift_and_no_gain(rested):
    x = np.where(np.arange(1200) * DT % 2 < 1, 1.0, 0.2)
    rest = np.ones(4000 if rested else 0)
    noise = Noise(white=0.02, hysteresis=0.5, hysteresis_tau=2.0)
    parts = []
    for seed in range(3):
        y = simulate(noise, np.concatenate([rest, x])[:, None, None, None].repeat(4, 2), dt=DT, seed=seed)
        parts.append(np.column_stack([np.full(1200, seed), x, y[len(rest) :, 0, :, 0]]))
    table = np.concatenate(parts)
    found = calibrate(Log(np.arange(len(table)) * DT, table[:, 2:], table[:, 1], table[:, 0].astype(int))).noise
    assert (found.hysteresis, found.hysteresis_tau) == pytest.approx((0.5, 2.0), rel=0.06)
    assert found.gain == pytest.approx((1.0, 1.0), rel=0.02)
    assert found.walk < 5e-4


@pytest.mark.slow
def test_the_bias_of_a_drifting_probe_under_load_lies_within_its_interval():
    x = _presses(1200, 0)[200:]
    hits = 0
    for seed in range(8):
        y = simulate(Noise(white=0.02, walk=0.003, bias=0.05), x[:, None, None, None], dt=DT, seed=seed)
        bias = calibrate(Log(np.arange(1000) * DT, y[:, 0, :, 0].astype(float), x)).estimates["bias"]
        hits += bias.low <= 0.05 <= bias.high
    assert x[0] > 0.5
    assert hits >= 6


def test_a_delay_beyond_the_longest_that_is_tried_is_refused():
    log = _log(Noise(white=0.02, read_delay=0.03), 1500, 6)
    assert calibrate(log, max_delay=0.03).noise.read_delay == pytest.approx(0.03)
    with pytest.raises(DataError, match=r"0\.02 s, 4 readings.*max_delay"):
        calibrate(log, max_delay=0.02)


@pytest.mark.parametrize("reference", [False, True])
def test_drift_without_white_noise_is_drift_alone(reference):
    log = _log(Noise(walk=0.01), 1500, 6)
    still = Log(log.time, log.readings - log.reference[:, None])
    found = calibrate(log if reference else still)
    assert found.noise.walk == pytest.approx(0.01, rel=0.05)
    assert found.noise.white < 1e-3


@pytest.mark.slow
def test_intervals_cover_the_planted_values_as_often_as_they_claim():
    noise = Noise(white=0.03, walk=0.003, hysteresis=0.3, hysteresis_tau=0.05, gain=(0.9, 1.1), bias=0.02)
    truth = {"white": 0.03, "walk": 0.003, "hysteresis": 0.3, "hysteresis_tau": 0.05, "bias": 0.02}
    hits = dict.fromkeys(truth, 0)
    for seed in range(40):
        found = calibrate(_log(noise, steps=1500, probes=6, seed=seed + 1)).estimates
        for name, value in truth.items():
            hits[name] += found[name].low <= value <= found[name].high
    # 95 % of 40 is 38; fewer than 33 would come about once in a thousand.
    assert min(hits.values()) >= 33, hits


def test_a_device_without_drift_or_hysteresis_is_not_given_any():
    found = calibrate(_log(Noise(white=0.02), steps=1500, probes=8))
    assert (found.noise.walk, found.noise.hysteresis, found.noise.quantum) == (0, 0, 0)
    assert found.noise.gain[0] == found.noise.gain[1] == pytest.approx(1.0, abs=0.01)
    assert found.noise.white == pytest.approx(0.02, rel=0.05)
    assert found.noise.dead_probability == 0


def test_episodes_restart_drift_and_redraw_gains():
    logs = [_log(Noise(white=0.02, walk=0.004, gain=(0.7, 1.3)), steps=800, probes=6, seed=seed) for seed in range(6)]
    joined = Log(
        np.concatenate([log.time for log in logs]), np.concatenate([log.readings for log in logs]),
        np.concatenate([log.reference for log in logs]), np.repeat(np.arange(6), 800),
    )  # fmt: skip
    found = calibrate(joined)
    assert found.estimates["gain_low"].how == "extremes of 36 gains"
    assert found.noise.gain == pytest.approx((0.7, 1.3), abs=0.06)
    assert found.noise.walk == pytest.approx(0.004, rel=0.1)


def test_a_log_at_rest_gives_the_knobs_of_rest_alone_and_says_so():
    y = simulate(Noise(white=0.5, walk=0.05, bias=3.0), np.zeros((3000, 1, 4, 1)), dt=DT)[:, 0, :, 0].astype(float)
    found = calibrate(Log(np.arange(3000) * DT, y))
    assert found.noise.white == pytest.approx(0.5, rel=0.05)
    assert found.noise.walk == pytest.approx(0.05, rel=0.2)
    assert abs(found.noise.bias - 3.0) < 1.0
    assert "gain_low" not in found.estimates
    assert any("Without a column 'reference'" in note for note in found.notes)


@pytest.mark.parametrize("step", [0.0, 0.01, 0.25, 1.0])
def test_the_quantum_is_found_or_denied(step):
    values = np.random.default_rng(0).normal(size=3000)
    values = step * np.round(values / step) if step else values
    assert find_quantum(values) == pytest.approx(step, rel=1e-6)


def test_a_preset_made_from_a_file_loads_again(tmp_path):
    log = _log(Noise(white=0.02, bias=0.1), steps=600, probes=3)
    path = tmp_path / "log.csv"
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", "reference", "a", "b", "c"])
        writer.writerows(np.column_stack([log.time, log.reference, log.readings]).tolist())
    read = read_log(path)
    assert read.probes == ("a", "b", "c")
    found = calibrate(read)
    found.save(tmp_path / "preset.json", log="log.csv")
    assert Noise.load(tmp_path / "preset.json") == found.noise
    assert list(found.estimates)[:2] == ["gain_low", "gain_high"]


def test_readings_that_fall_where_the_reference_rises_are_refused():
    log = _log(Noise(white=0.02), steps=800, probes=3)
    with pytest.raises(DataError, match="fall where the reference rises"):
        calibrate(Log(log.time, -log.readings, log.reference))


def test_no_gain_is_below_zero_however_few_probes_tell_its_range():
    log = _log(Noise(white=0.01), steps=800, probes=3)
    noise = calibrate(Log(log.time, log.readings * [0.05, 1.0, 2.0], log.reference)).noise
    assert noise.gain[0] == 0
    assert noise.gain[1] > 2


def test_unusable_logs_are_explained(tmp_path):
    path = tmp_path / "log.csv"
    with pytest.raises(DataError, match=r"/log\.csv'"):
        read_log(path)
    path.write_text("t,a\n1,2\n")
    with pytest.raises(DataError, match="header with 'time'"):
        read_log(path)
    path.write_text("time,a\n1,2\n")
    with pytest.raises(DataError, match="holds 1 readings"):
        read_log(path)
    path.write_text("time,a\n" + "0,x\n" * 30)
    with pytest.raises(DataError, match=r"log\.csv.*0,x"):
        read_log(path)
    path.write_text("time,a\n" + "0,1\n" * 30)
    with pytest.raises(DataError, match=r"log\.csv: times .*0…0 s"):
        read_log(path)
    with pytest.raises(DataError, match="Every probe"):
        calibrate(Log(np.arange(50) * 0.1, np.ones((50, 2)), np.arange(50.0)))
    with pytest.raises(DataError, match="never changes"):
        calibrate(Log(np.arange(50) * 0.1, np.random.default_rng(0).normal(size=(50, 2)), np.ones(50)))


@pytest.mark.parametrize("lags", [(0, 0), (3, 3), (0, 1), (0, 3), (0, 6), (2, 5)])
def test_delay_and_jitter_lie_within_their_intervals(lags: tuple[int, int]) -> None:
    for name, found in delay_of(lags, 100, 0.01).items():
        assert 0 <= found.low <= found.value <= found.high, name
