"""Afferent bands: agreement with scipy, pass bands, static signals, resets."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.signal import sosfilt

from brainbench.core.errors import UsageError
from robotics_bridge.sensors.afferents import AfferentFilter, band_sections


def _run(signal: np.ndarray, rate: float = 2000.0) -> dict[str, np.ndarray]:
    filters = AfferentFilter(rate)
    read = [filters.step(torch.as_tensor(value)) for value in signal]
    return {name: np.stack([item[name].numpy() for item in read]) for name in filters.bands}


def test_the_filters_are_those_of_scipy_step_by_step():
    signal = np.random.default_rng(0).normal(size=(300, 2, 3))
    signal[0] = 0
    for name, read in _run(signal).items():
        assert read == pytest.approx(sosfilt(band_sections(name, 2000.0), signal, axis=0), abs=1e-9)


@pytest.mark.parametrize(
    ("frequency", "loudest"), [(1.0, "SA-I"), (20.0, "FA-I"), (200.0, "FA-II")]
)  # fmt: skip
def test_each_frequency_is_loudest_in_the_band_of_table_2_1(frequency, loudest):
    t = np.arange(4000) / 2000
    read = _run(np.sin(2 * np.pi * frequency * t)[:, None])
    power = {name: float(values[2000:].std()) for name, values in read.items()}
    assert max(power, key=lambda name: power[name]) == loudest
    assert power[loudest] > 0.9 / np.sqrt(2)


def test_a_static_press_is_felt_by_the_slow_band_alone_from_the_first_reading():
    read = _run(np.full((50, 1, 4), 3.0))
    assert read["SA-I"] == pytest.approx(np.full((50, 1, 4), 3.0), abs=1e-8)
    assert read["FA-I"] == pytest.approx(np.zeros((50, 1, 4)), abs=1e-8)
    assert read["FA-II"] == pytest.approx(np.zeros((50, 1, 4)), abs=1e-8)


def test_a_reset_forgets_in_its_environment_alone():
    filters = AfferentFilter(2000.0)
    rng = np.random.default_rng(2)
    for _ in range(50):
        filters.step(torch.as_tensor(rng.normal(size=(2, 3))))
    filters.reset([1], torch.full((2, 3), 4.0, dtype=torch.float64))
    read = filters.step(torch.full((2, 3), 4.0, dtype=torch.float64))
    assert read["SA-I"][1].numpy() == pytest.approx(np.full(3, 4.0))
    assert read["FA-I"][1].numpy() == pytest.approx(np.zeros(3), abs=1e-8)
    assert abs(float(read["FA-I"][0].mean())) > 1e-3
    filters.reset()
    assert filters.step(torch.full((2, 3), 1.0))["SA-I"].numpy() == pytest.approx(np.ones((2, 3)))


def test_bands_that_do_not_fit_the_rate_and_unknown_afferents_are_explained():
    with pytest.raises(UsageError, match=r"800 .*received 200"):
        AfferentFilter(200.0)
    assert set(AfferentFilter(200.0, ("SA-I", "FA-I")).bands) == {"SA-I", "FA-I"}
    with pytest.raises(UsageError, match=r"'FA-1'; .* 'FA-I'"):
        AfferentFilter(2000.0, ("FA-1",))
