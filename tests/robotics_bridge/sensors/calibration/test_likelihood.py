"""The likelihood of a log: dynamics that were planted are found, with their delays and what came before."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import DataError
from robotics_bridge.sensors.calibration.calibrate import Log, calibrate
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.noise.stages import simulate
from tests.factories.calibration_logs import DT, log_of, presses


@pytest.mark.parametrize(
    ("jitter", "seed"),
    [(0.01, 1), pytest.param(0.005, 0, marks=pytest.mark.slow), pytest.param(0.02, 1, marks=pytest.mark.slow)],
)
def test_jitter_is_recovered_with_what_it_would_otherwise_blur(jitter, seed):
    noise = Noise(
        white=0.02, gain=(0.8, 1.2), hysteresis=0.4, hysteresis_tau=0.06, read_delay=0.03, jitter=jitter, bias=0.1
    )
    found = calibrate(log_of(noise, steps=1500, probes=12, seed=seed))
    assert found.noise.jitter == pytest.approx(jitter, abs=1e-9)
    assert found.noise.read_delay == pytest.approx(0.03, abs=1e-9)
    assert found.noise.white == pytest.approx(0.02, rel=0.1)
    assert found.noise.hysteresis == pytest.approx(0.4, rel=0.1)
    assert found.noise.hysteresis_tau == pytest.approx(0.06, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "seed"), [(0.02, 0), (0.03, 1), (0.02, 4)])
def test_jitter_is_told_from_few_presses(delay, seed):
    found = calibrate(log_of(Noise(white=0.02, read_delay=delay, jitter=0.01), steps=1500, probes=6, seed=seed))
    assert (found.noise.read_delay, found.noise.jitter) == pytest.approx((delay, 0.01), abs=1e-9)
    assert found.noise.white == pytest.approx(0.02, rel=0.05)
    assert abs(found.noise.hysteresis) < 0.02


@pytest.mark.slow
def test_a_log_may_begin_under_load():
    noise = Noise(white=0.02, hysteresis=0.4, hysteresis_tau=0.06, gain=(0.8, 1.2), read_delay=0.03)
    log = log_of(noise, 1500, 12)
    assert log.reference[200] > 0.5
    found = calibrate(Log(log.time[200:], log.readings[200:], log.reference[200:])).noise
    assert (found.read_delay, found.jitter) == pytest.approx((0.03, 0.0), abs=1e-9)
    assert (found.hysteresis, found.hysteresis_tau) == pytest.approx((0.4, 0.06), rel=0.05)


@pytest.mark.slow
def test_a_sensor_may_be_reset_under_load():
    noise = Noise(white=0.02, hysteresis=0.4, hysteresis_tau=0.06, gain=(0.8, 1.2), read_delay=0.03)
    parts = []
    for seed in range(4):
        x = presses(1000, seed)
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


def test_a_delay_beyond_the_longest_that_is_tried_is_refused():
    log = log_of(Noise(white=0.02, read_delay=0.03), 1500, 6)
    assert calibrate(log, max_delay=0.03).noise.read_delay == pytest.approx(0.03)
    with pytest.raises(DataError, match=r"0\.02 s, 4 readings.*max_delay"):
        calibrate(log, max_delay=0.02)


@pytest.mark.parametrize("reference", [False, True])
def test_drift_without_white_noise_is_drift_alone(reference):
    log = log_of(Noise(walk=0.01), 1500, 6)
    still = Log(log.time, log.readings - log.reference[:, None])
    found = calibrate(log if reference else still)
    assert found.noise.walk == pytest.approx(0.01, rel=0.05)
    assert found.noise.white < 1e-3
