"""A base that is shaken or pushed fast is felt as by an Euler-Bernoulli beam that shares nothing with the chain."""

import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.factories.shaken_base import base_moment_response, shaken_base
from tests.factories.whiskers import C2, H

ROD = Whisker(0.015, 30e-6, 30e-6, young_modulus=5e9, density=1300.0, damping_ratio=1e-6)


def test_the_response_has_its_closed_forms():
    # Far below the first mode the whisker is rigid: -a ∫ρ s ds, in phase with the displacement times ω².
    line = 1300.0 * math.pi * 30e-6**2
    found = base_moment_response(ROD, np.array([0.5]))[0]
    assert found == pytest.approx((math.pi) ** 2 * line * 0.015**2 / 2, rel=1e-3)
    # Uniform undamped beam shaken at any frequency: M = EI w″ with w = (cosh, cos, sinh, sin)(k s), clamped and free.
    stiffness = 5e9 * math.pi * 30e-6**4 / 4
    for frequency in (300.0, 1000.0, 3000.0):
        k = ((2 * math.pi * frequency) ** 2 * line / stiffness) ** 0.25
        z = k * 0.015
        c, s, ch, sh = math.cos(z), math.sin(z), math.cosh(z), math.sinh(z)
        system = [[1, 1, 0, 0], [0, 0, 1, 1], [ch, -c, sh, -s], [sh, s, ch, -c]]
        a, b, *_ = np.linalg.solve(system, [1.0, 0.0, 0.0, 0.0])
        bending = stiffness * k**2 * (a - b)
        assert base_moment_response(ROD, np.array([frequency]))[0].real == pytest.approx(bending, rel=2e-3)


@pytest.mark.parametrize("frequency", [400.0, 1000.0])
@pytest.mark.parametrize("backend", ["rod", "mujoco"])
def test_a_shaken_base_is_felt_as_by_the_beam(backend, frequency):
    times = np.arange(1, int(0.03 * frequency * 40) + 1) / (40 * frequency)

    def shake(t):
        return 1e-5 * smooth_step(t, 4 / frequency) * np.sin(2 * np.pi * frequency * t)

    found = shaken_base(C2, shake, times, backend=backend)
    assert abs(found.peak_error) < 0.02
    assert found.error < 0.04


@pytest.mark.parametrize("whisker", [C2, H])
@pytest.mark.parametrize("width", [1e-4, 6e-4])
def test_a_pulse_of_the_base_is_felt_as_by_the_beam(whisker, width):
    def pulse(t):
        return np.where((t > 2e-3) & (t < 2e-3 + width), 1e-5 * np.sin(np.pi * (t - 2e-3) / width) ** 4, 0.0)

    found = shaken_base(whisker, pulse, np.arange(1, 1001) * 1e-5)
    assert abs(found.peak_error) < 0.02
    assert found.error < 0.04


def test_curved_whiskers_and_uneven_readings_are_refused():
    curved = Whisker(0.015, 30e-6, 3e-6, young_modulus=5e9, density=1300.0, damping_ratio=0.3, curvature=10.0)
    with pytest.raises(UsageError):
        shaken_base(curved, np.zeros_like, np.array([1e-3, 2e-3]))
    with pytest.raises(UsageError):
        shaken_base(C2, np.zeros_like, np.array([1e-3, 5e-3]))
    assert references.beam_matrices(C2)[0].shape[0] % 2 == 0
