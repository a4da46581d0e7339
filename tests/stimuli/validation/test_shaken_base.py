"""A base that is shaken or pushed fast is felt as by an Euler-Bernoulli beam that shares nothing with the chain."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle, Trace
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.validation import references
from brainbench.stimuli.validation.references import beam_matrices
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.factories.engine_scenes import C2, H

_MODES = 40
"""Modes of the beam; their highest lies above 100 kHz for all published whiskers."""
_SAMPLES = 16
"""Samples of the beam's response between two readings."""


@dataclass(frozen=True, eq=False)
class ShakenBase:
    """Base moment of a whisker whose base was moved sideways, beside the beam's."""

    times: NDArray[np.float64]
    """[n] s"""
    moment: NDArray[np.float64]
    """[n] measured moment about z on the base (N·m)."""
    reference: NDArray[np.float64]
    """[n] that of the beam."""
    trace: Trace

    @property
    def peak_error(self) -> float:
        """Relative error of the largest moment (signed)."""
        return float(np.abs(self.moment).max() / np.abs(self.reference).max() - 1)

    @property
    def error(self) -> float:
        """Root mean square of the difference over that of the reference."""
        return float(np.linalg.norm(self.moment - self.reference) / np.linalg.norm(self.reference))


def base_moment_response(whisker: Whisker, frequencies: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the moment on the base per displacement of it along y (N), [f] at frequencies [f] (Hz).

    In modes of unit mass, q″ + β ω² q′ + ω² q = −L y″ with L = ∫ρ φ ds and β = 2 ζ₁/ω₁; the moment is
    −∫ρ s (y″ + Σ φ q″) ds. Straight whiskers, small bending.
    """
    squares, translation, rotation, first_moment = _modes(whisker)
    omega = 2 * np.pi * np.asarray(frequencies, dtype=float)[:, None]
    beta = 2 * whisker.damping_ratio / np.sqrt(squares[0])
    response = omega**2 * translation / (squares - omega**2 + 1j * omega * beta * squares)
    return omega[:, 0] ** 2 * (first_moment + response @ rotation)


@lru_cache(maxsize=16)
def _modes(whisker: Whisker) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    """Return ω² [m], ∫ρ φ ds and ∫ρ s φ ds [m] of the modes, and ∫ρ s ds (kg·m)."""
    from scipy.linalg import eigh

    stiffness, mass = beam_matrices(whisker)
    nodes = len(mass) // 2
    across = np.tile([1.0, 0.0], nodes)
    turning = np.ravel(np.column_stack([np.linspace(0, whisker.arc_length, nodes), np.ones(nodes)]))
    # Slopes counted in arc lengths make the matrices well conditioned; the base is clamped.
    scale = np.tile([1.0, 1 / whisker.arc_length], nodes)[2:]
    scaled = (matrix[2:, 2:] * np.outer(scale, scale) for matrix in (stiffness, mass))
    squares, shapes = eigh(*scaled, subset_by_index=[0, _MODES - 1])
    shapes = shapes * scale[:, None]
    return squares, shapes.T @ (mass @ across)[2:], shapes.T @ (mass @ turning)[2:], float(across @ mass @ turning)


def shaken_base(
    whisker: Whisker,
    displacement: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    times: NDArray[np.float64],
    *,
    backend: str = DEFAULT_ENGINE,
    fidelity: Fidelity | str = "accurate",
) -> ShakenBase:
    """Move the base of a straight whisker by ``displacement`` (m along y; 0 at and before t = 0) and read its moment.

    The displacement, of times [n] (s), is smooth and small against the whisker; the readings at ``times`` [n] (s) are
    evenly spaced from the first interval on.

    Raises:
        UsageError: the whisker is curved, or the readings are not evenly spaced.
        DataError: the simulation was unstable.
    """
    times = np.asarray(times, dtype=float)
    if whisker.curvature != 0:
        raise UsageError("The beam is straight; give a whisker with curvature 0.")
    if not np.allclose(times, times[0] * np.arange(1, len(times) + 1)):
        raise UsageError("The readings are evenly spaced, the first one interval after 0.")
    job = Job(whisker, _Displaced(displacement), (), times)
    trace = get_engine(backend).run([job], Fidelity.of(fidelity))[0]
    if trace.status != "ok":
        raise DataError(f"The simulation was unstable: {trace.reason}.")
    # The beam's response by Fourier series, in which the motion fades out behind the readings and rest follows.
    step, count = times[0] / _SAMPLES, _SAMPLES * (len(times) + 1)
    samples = np.arange(4 * count)
    fade = np.clip((2 * count - samples) / (count / 2), 0.0, 1.0)
    y = displacement(step * samples) * fade**3 * (6 * fade**2 - 15 * fade + 10)
    frequencies = np.fft.rfftfreq(len(y), step)
    reference = np.fft.irfft(np.fft.rfft(y) * base_moment_response(whisker, frequencies), len(y))
    return ShakenBase(times, trace.wrench[:, 5], reference[_SAMPLES : _SAMPLES * (len(times) + 1) : _SAMPLES], trace)


@dataclass(frozen=True, eq=False)
class _Displaced:
    """A follicle that moves along y alone."""

    displacement: Callable[[NDArray[np.float64]], NDArray[np.float64]]

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [n, 3] (m) and angles [n, 3] (rad)."""
        position, euler = StillFollicle().pose(times)
        position[:, 1] = self.displacement(times)
        return position, euler


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
