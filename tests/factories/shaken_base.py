"""A whisker whose base is moved fast, beside an Euler-Bernoulli beam: what a follicle's motion alone makes it feel.

The beam is solved in its modes from finite elements (``references.beam_matrices``), with the whisker's damping in
proportion to stiffness; nothing of it comes from the chain of links. Frame as in ``stimuli.validation.bench_tests``.
Letters: n time, f frequency, m mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle, Trace
from brainbench.stimuli.validation.references import beam_matrices
from brainbench.stimuli.whiskers.whisker import Whisker

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
