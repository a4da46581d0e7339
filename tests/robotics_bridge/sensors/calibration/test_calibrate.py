"""Calibration recovers what was planted, and says what it cannot know."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from robotics_bridge.sensors.calibration.calibrate import Log, calibrate, delay_of, find_quantum, read_log
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.noise.stages import simulate
from tests.factories.calibration_logs import DT, log_of, presses

TIME = np.arange(200) * 0.01
SIGNAL = np.sin(3 * TIME)
READINGS = SIGNAL[:, None] + 0.01 * np.random.default_rng(0).normal(size=(200, 2))


@pytest.mark.parametrize(
    "parts",
    [
        {"readings": np.where(READINGS > 0.9, np.nan, READINGS)},
        {"reference": np.where(SIGNAL > 0.9, np.nan, SIGNAL)},
        {"reference": READINGS},
        {"time": -TIME},
        {"time": 0 * TIME},
        {"time": 1e3 * TIME},
        {"time": TIME * np.nan},
        {"readings": READINGS[:, :0]},
        {"probes": ("a",)},
        {"episode": np.zeros(3, int)},
    ],
)
def test_a_log_holds_finite_numbers_that_fit_each_other_at_rising_times(parts) -> None:
    with pytest.raises(UsageError, match=rf"{next(iter(parts))}|Times|names|Readings"):
        Log(**{"time": TIME, "readings": READINGS, "reference": SIGNAL, **parts})


@pytest.mark.parametrize("rows", [np.r_[0:80, 120:200], np.r_[0:80, 79:199], np.r_[0:80, 81, 80, 82:200]])
def test_a_log_with_a_gap_or_rows_written_twice_or_swapped_is_refused(rows) -> None:
    with pytest.raises(UsageError, match="must rise in equal steps within an episode"):
        Log(TIME[rows], READINGS[rows], SIGNAL[rows])
    # An episode may begin at a gap.
    if len(rows) == 160:
        Log(TIME[rows], READINGS[rows], SIGNAL[rows], (rows >= 120).astype(int))


def test_readings_before_their_reference_are_refused_and_hysteresis_is_not_taken_for_that() -> None:
    knobs = {"white": 0.02, "gain": (0.9, 1.1)}
    early = log_of(Noise(**knobs), 1200, 4)
    assert early.reference is not None
    with pytest.raises(DataError, match=r"come 0\.015 s before the reference.*\(3 rows\)"):
        calibrate(replace(early, reference=np.roll(early.reference, 3)), max_delay=0.05)
    springy = calibrate(log_of(Noise(**knobs, hysteresis=1.5, hysteresis_tau=0.02), 1200, 4), max_delay=0.05)
    assert springy.noise.hysteresis == pytest.approx(1.5, rel=0.05)


@pytest.mark.parametrize(("hysteresis", "tau", "delay"), [(-0.9, 0.02, 0.02), (-0.7, 0.1, 0.0)])
def test_readings_that_follow_slowly_are_not_taken_for_late_ones(hysteresis, tau, delay) -> None:
    slow = Noise(white=0.02, hysteresis=hysteresis, hysteresis_tau=tau, read_delay=delay)
    noise = calibrate(log_of(slow, 1200, 4), max_delay=0.1).noise
    assert (noise.hysteresis, noise.hysteresis_tau) == pytest.approx((hysteresis, tau), rel=0.03)
    assert (noise.read_delay, noise.jitter) == pytest.approx((delay, 0.0), abs=1e-9)


def test_the_noise_of_a_reference_is_mentioned_or_refused() -> None:
    log, noise = log_of(Noise(white=0.02), 1200, 4), np.random.default_rng(1).normal(size=1200)
    assert log.reference is not None
    noted = calibrate(replace(log, reference=log.reference + 0.02 * noise), max_delay=0.02).notes
    assert any("The reference has noise of its own of about 0.02" in note for note in noted)
    assert not any("of its own" in note for note in calibrate(log, max_delay=0.02).notes)
    with pytest.raises(DataError, match="No delay and hysteresis explain the readings"):
        calibrate(replace(log, reference=log.reference + 0.2 * noise), max_delay=0.05)


@pytest.mark.parametrize("step", [0.0, 0.01, 0.25, 1.0])
def test_the_quantum_is_found_or_denied(step):
    values = np.random.default_rng(0).normal(size=3000)
    values = step * np.round(values / step) if step else values
    assert find_quantum(values) == pytest.approx(step, rel=1e-6)


PLANTED = Noise(
    white=0.02, walk=0.002, bias=0.05, quantum=0.01, gain=(0.8, 1.2), dead_probability=0.15, dead_range=(0.1, 0.6),
    hysteresis=0.4, hysteresis_tau=0.06, read_delay=0.03,
)  # fmt: skip


@pytest.mark.slow
def test_planted_values_are_recovered_within_their_intervals():
    found = calibrate(log_of(PLANTED))
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


@pytest.mark.slow
def test_presses_that_the_model_does_not_explain_are_told():
    knobs = {"white": 0.02, "gain": (0.8, 1.2), "hysteresis": 0.4, "hysteresis_tau": 0.06, "bias": 0.1}
    told = [calibrate(log_of(Noise(**knobs, read_delay=0.02, jitter=j), 1500, 6, seed=2)).notes for j in (0.0, 0.01)]
    assert [any("differ more from the model" in note for note in notes) for notes in told] == [False, True]


@pytest.mark.slow
def test_the_bias_of_a_drifting_probe_under_load_lies_within_its_interval():
    x = presses(1200, 0)[200:]
    hits = 0
    for seed in range(8):
        y = simulate(Noise(white=0.02, walk=0.003, bias=0.05), x[:, None, None, None], dt=DT, seed=seed)
        bias = calibrate(Log(np.arange(1000) * DT, y[:, 0, :, 0].astype(float), x)).estimates["bias"]
        hits += bias.low <= 0.05 <= bias.high
    assert x[0] > 0.5
    assert hits >= 6


@pytest.mark.slow
def test_intervals_cover_the_planted_values_as_often_as_they_claim():
    noise = Noise(white=0.03, walk=0.003, hysteresis=0.3, hysteresis_tau=0.05, gain=(0.9, 1.1), bias=0.02)
    truth = {"white": 0.03, "walk": 0.003, "hysteresis": 0.3, "hysteresis_tau": 0.05, "bias": 0.02}
    hits = dict.fromkeys(truth, 0)
    for seed in range(40):
        found = calibrate(log_of(noise, steps=1500, probes=6, seed=seed + 1)).estimates
        for name, value in truth.items():
            hits[name] += found[name].low <= value <= found[name].high
    # 95 % of 40 is 38; fewer than 33 would come about once in a thousand.
    assert min(hits.values()) >= 33, hits


def test_a_device_without_drift_or_hysteresis_is_not_given_any():
    found = calibrate(log_of(Noise(white=0.02), steps=1500, probes=8))
    assert (found.noise.walk, found.noise.hysteresis, found.noise.quantum) == (0, 0, 0)
    assert found.noise.gain[0] == found.noise.gain[1] == pytest.approx(1.0, abs=0.01)
    assert found.noise.white == pytest.approx(0.02, rel=0.05)
    assert found.noise.dead_probability == 0


def test_episodes_restart_drift_and_redraw_gains():
    logs = [log_of(Noise(white=0.02, walk=0.004, gain=(0.7, 1.3)), steps=800, probes=6, seed=seed) for seed in range(6)]
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


def test_a_preset_made_from_a_file_loads_again(tmp_path):
    log = log_of(Noise(white=0.02, bias=0.1), steps=600, probes=3)
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
    log = log_of(Noise(white=0.02), steps=800, probes=3)
    with pytest.raises(DataError, match="fall where the reference rises"):
        calibrate(Log(log.time, -log.readings, log.reference))


def test_no_gain_is_below_zero_however_few_probes_tell_its_range():
    log = log_of(Noise(white=0.01), steps=800, probes=3)
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
    with pytest.raises(DataError, match=r"log\.csv: Times .*0 to 0 s"):
        read_log(path)
    with pytest.raises(DataError, match="Every probe"):
        calibrate(Log(np.arange(50) * 0.1, np.ones((50, 2)), np.arange(50.0)))
    with pytest.raises(DataError, match="never changes"):
        calibrate(Log(np.arange(50) * 0.1, np.random.default_rng(0).normal(size=(50, 2)), np.ones(50)))


@pytest.mark.parametrize("lags", [(0, 0), (3, 3), (0, 1), (0, 3), (0, 6), (2, 5)])
def test_delay_and_jitter_lie_within_their_intervals(lags: tuple[int, int]) -> None:
    for name, found in delay_of(lags, 100, 0.01).items():
        assert 0 <= found.low <= found.value <= found.high, name


@pytest.mark.parametrize("delay", [np.nan, np.inf, -1.0])
def test_delays_of_a_calibration_have_a_range(delay) -> None:
    with pytest.raises(UsageError, match="max_delay"):
        calibrate(Log(TIME, READINGS, SIGNAL), max_delay=delay)


def test_lists_are_a_log_and_short_episodes_are_told() -> None:
    whole = calibrate(Log(TIME.tolist(), READINGS.tolist(), SIGNAL.tolist()))  # type: ignore[arg-type]
    assert whole.noise == calibrate(Log(TIME, READINGS, SIGNAL)).noise
    short = np.repeat([0, 1], [195, 5])
    assert any("1 episode" in note for note in calibrate(Log(TIME, READINGS, SIGNAL, short)).notes)
    with pytest.raises(DataError, match="fewer than 10"):
        calibrate(Log(TIME, READINGS, SIGNAL, np.arange(200) // 8))


@pytest.mark.parametrize("seed", range(3))
def test_a_slow_reference_gives_a_prompt_device_no_delay_and_no_hysteresis(seed: int) -> None:
    """A delay and a hysteresis of a reading cancel where the reference hardly bends."""
    time, rng = 0.01 * np.arange(4000), np.random.default_rng(seed)
    reference = 2 * np.maximum(0, np.sin(time / 3 + seed))
    readings = np.stack([gain * reference + 0.02 * rng.normal(size=4000) for gain in (1.1, 0.9, 1.0)], axis=1)
    result = calibrate(Log(time, readings, reference))
    assert result.estimates["hysteresis"].value == 0
    assert result.estimates["read_delay"].value == 0
    assert any("no better than none" in note for note in result.notes) or seed == 2
