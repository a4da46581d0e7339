"""Ring-downs: the real backend against an Euler-Bernoulli beam."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.validation.ringing import ringdown
from tests.factories.whiskers import C2, GATE_WHISKERS


@pytest.mark.slow
@pytest.mark.parametrize("name", GATE_WHISKERS)
def test_every_preset_rings_as_the_rod_and_is_damped_as_asked(name):
    whisker = GATE_WHISKERS[name]
    for preset, promise in (("fast", 0.15), ("balanced", 0.05), ("accurate", 0.01)):
        result = ringdown(whisker, fidelity=preset)
        np.testing.assert_allclose(result.frequencies, result.reference_frequencies, rtol=promise)
        np.testing.assert_allclose(result.damping_ratios[0], whisker.damping_ratio, rtol=max(promise, 0.05))


def test_a_short_whisker_rings_as_it_should_at_preset_balanced():
    whisker = GATE_WHISKERS["E5"]
    ring = ringdown(whisker, modes=2, fidelity="balanced")
    np.testing.assert_allclose(ring.frequency_errors, 0, atol=0.05)
    assert ring.damping_ratio == pytest.approx(whisker.damping_ratio, rel=0.05)


def test_modes_are_rung_one_by_one():
    ring = ringdown(C2, modes=2, fidelity=Fidelity(links=20, time_step=5e-5))
    np.testing.assert_allclose(ring.frequencies, ring.reference_frequencies, rtol=0.01)
    assert ring.damping_ratios[1] == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize("fidelity", [Fidelity.preset("balanced"), Fidelity(links=12, time_step=6e-5)])
def test_the_second_mode_at_a_presets_own_step_is_the_rods_as_a_backward_euler_step_shows_it(fidelity):
    ring = ringdown(C2, modes=2, own_step=True, fidelity=fidelity)
    step = fidelity.step(float(ring.reference_frequencies[0]))
    pole = np.log(1 + 2j * np.pi * ring.reference_frequencies[1] * step) / step
    assert ring.frequencies[1] == pytest.approx(abs(pole) / (2 * np.pi), rel=5e-3)
    assert ring.damping_ratios[1] == pytest.approx(max(pole.real / abs(pole), 0.05), rel=0.02)


def test_a_mode_that_a_presets_own_step_cannot_show_is_nan():
    ring = ringdown(C2, modes=3, own_step=True, fidelity="fast")
    assert np.isfinite(ring.frequencies[0])
    assert np.isnan(ring.frequencies[2])


def test_halving_the_time_step_halves_the_error_of_the_ringdown():
    errors = [ringdown(C2, fidelity=Fidelity(links=10, time_step=step)).frequency_error for step in (1e-4, 5e-5)]
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ringdown(replace(C2, damping_ratio=1.5)), r"damping_ratio .*below 1.*received 1\.5"),
        (lambda: ringdown(C2, modes=0), r"modes .*1 and at most 5; received 0"),
    ],
)
def test_impossible_ring_downs_are_refused(call, message):
    with pytest.raises(UsageError, match=message):
        call()
