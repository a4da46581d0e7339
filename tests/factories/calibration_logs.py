"""Recordings of simulated devices for tests of their calibration."""

from __future__ import annotations

import numpy as np

from robotics_bridge.sensors.calibration.calibrate import Log
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.noise.stages import simulate

DT = 0.005


def presses(steps: int, seed: int = 0) -> np.ndarray:
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


def log_of(noise: Noise, steps: int = 2500, probes: int = 40, seed: int = 0) -> Log:
    x = presses(steps, seed)
    y = simulate(noise, np.broadcast_to(x[:, None, None, None], (steps, 1, probes, 1)), dt=DT, seed=seed)
    return Log(np.arange(steps) * DT, y[:, 0, :, 0].astype(float), x)
