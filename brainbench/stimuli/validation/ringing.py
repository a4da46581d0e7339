"""Ring-downs of the simulated whisker beside the frequencies of an Euler-Bernoulli beam.

Frame and units are those of :mod:`brainbench.stimuli.validation.bench_tests`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.validation import references
from brainbench.stimuli.validation.bench_tests import run_one
from brainbench.stimuli.whiskers.chain import build_chain
from brainbench.stimuli.whiskers.whisker import Whisker


@dataclass(frozen=True, eq=False)
class Ringdown:
    """Free vibration after a small tip load is let go."""

    frequencies: NDArray[np.float64]
    """[m] measured undamped frequencies of the lowest modes (Hz)."""
    damping_ratios: NDArray[np.float64]
    """[m] their measured damping ratios; those of all but the first were set to .05."""
    reference_frequencies: NDArray[np.float64]
    """[m] Euler-Bernoulli frequencies (Hz)."""
    times: NDArray[np.float64] = field(repr=False)
    """[n] time since the release (s)."""
    wrench: NDArray[np.float64] = field(repr=False)
    """[n, 6] base wrench during the ring-down; its last row is at rest."""

    @property
    def frequency(self) -> float:
        """Measured undamped frequency of the first mode (Hz)."""
        return float(self.frequencies[0])

    @property
    def damping_ratio(self) -> float:
        """Measured damping ratio of the first mode."""
        return float(self.damping_ratios[0])

    @property
    def frequency_error(self) -> float:
        """Relative error of the first frequency (signed)."""
        return float(self.frequency_errors[0])

    @property
    def frequency_errors(self) -> NDArray[np.float64]:
        """[m] relative errors of the frequencies (signed)."""
        return self.frequencies / self.reference_frequencies - 1


def ringdown(
    whisker: Whisker,
    *,
    modes: int = 3,
    deflection: float = 1e-3,
    own_step: bool = False,
    backend: str = DEFAULT_ENGINE,
    fidelity: Fidelity | str = "accurate",
) -> Ringdown:
    """Let a bent whisker go and fit its lowest modes.

    First mode, with the whisker's damping and the fidelity's time step: a tip load bends it by ``deflection`` (fraction
    of the arc length, small), settles, and vanishes; a decaying sinusoid is fitted to the base moment after the higher
    modes have died. Modes 2 … ``modes`` would not ring with the whisker's own damping. Each is rung alone, by loads
    that bend the chain in its shape, with damping ratio .05 and at most 1/100 of its period per step, and read at the
    tip: these frequencies test the chain of links, not the time step. With ``own_step`` they keep the fidelity's step
    too, and show what it makes of them: a backward Euler step h turns an undamped mode ω into one of frequency |ln(1 +
    i ω h)|/h with damping ratio ln(1 + ω² h²)/(2 |ln(1 + i ω h)|). A mode of fewer than six steps counts as NaN.
    """
    check_number("damping_ratio of a whisker that rings down", whisker.damping_ratio, above=0, below=1)
    check_number("modes of a ring-down", modes, least=1, most=5, whole=True)
    fidelity = Fidelity.of(fidelity)
    references_hz = references.natural_frequencies(whisker, modes)
    expected = float(references_hz[0])
    force = deflection * whisker.arc_length / references.point_load_deflection(whisker, 1.0, whisker.arc_length)
    # A first mode that settles under the load keeps e⁻⁸ of its swing, .03 %.
    release = 8 / (whisker.damping_ratio * 2 * math.pi * expected)
    step = fidelity.step(expected)
    release = math.ceil(release / step) * step
    times = release + np.arange(1.0, math.ceil(10 / (whisker.damping_ratio * 2 * math.pi * expected) / step)) * step
    # Half a step before the release: rounding cannot let the load act for one step more.
    load = Load(whisker.arc_length, (0.0, force, 0.0), stop=release - step / 2)
    trace = run_one(backend, Job(whisker, StillFollicle(), (), times, loads=(load,)), fidelity)
    times = times - release
    # Stiffness-proportional damping kills the second mode much sooner: one period is enough.
    later = times > 1 / expected
    fits = [fit_decay(times[later], trace.wrench[later, 5], expected, whisker.damping_ratio)]
    fits += [_ring_mode(whisker, mode, references_hz, backend, fidelity, own_step) for mode in range(1, modes)]
    frequencies, ratios = np.array(fits).T
    return Ringdown(frequencies, ratios, references_hz, times, trace.wrench)


def _ring_mode(
    whisker: Whisker, mode: int, expected: NDArray, backend: str, fidelity: Fidelity, own_step: bool
) -> tuple[float, float]:
    """Return frequency (Hz) and damping ratio of one mode (0 = first), rung alone by a constant load in its shape."""
    ratio, period = 0.05, 1 / float(expected[mode])
    step = fidelity.step(float(expected[0])) if own_step else min(fidelity.time_step, period / 100)
    if period < 6 * step:
        return math.nan, math.nan
    chain = build_chain(whisker, fidelity.link_count(whisker.arc_length))
    if mode >= chain.links:
        raise UsageError(f"A chain of {chain.links} links has no mode {mode + 1}; ask for fewer modes or more links.")
    # Torque of a load at node i about joint j is its lever; solve for the loads that bend the joints as the mode does.
    bends = chain.mode_shape(mode)
    levers = np.triu(chain.nodes[None, 1:] - chain.nodes[:-1, None])
    # A thousandth of the length is small enough for linear theory.
    bends = bends * (1e-3 * whisker.arc_length / np.abs(levers.T @ bends).max())
    forces = np.linalg.solve(levers, chain.stiffness * bends)
    fine = replace(fidelity, time_step=step, steps_per_period=None)
    # Damping proportional to stiffness grows with frequency.
    light = replace(whisker, damping_ratio=ratio * float(expected[0] / expected[mode]))
    interval = step if own_step else period / 100
    times = np.asarray(np.arange(1, math.ceil(12 * period / interval) + 1) * interval, dtype=np.float64)
    pairs = zip(chain.nodes[1:].tolist(), forces.tolist(), strict=True)
    loads = tuple(Load(arc, (0.0, force, 0.0)) for arc, force in pairs)
    trace = run_one(backend, Job(light, StillFollicle(), (), times, loads=loads), fine)
    assert trace.link_positions is not None
    # The mode swings about its static bend under the loads.
    tip = trace.link_positions[:, -1, 1] - float(levers[:, -1] @ bends)
    return fit_decay(times, tip, 1 / period, ratio)


def fit_decay(times: NDArray, signal: NDArray, frequency: float, ratio: float) -> tuple[float, float]:
    """Return the undamped frequency (Hz) and damping ratio of a decaying sinusoid."""
    from scipy.optimize import curve_fit

    scale = float(np.abs(signal).max())

    def model(t: NDArray, omega: float, zeta: float, a: float, b: float) -> NDArray:
        # ω is undamped; a damped mode rings at ω √(1 − ζ²).
        ringing = omega * math.sqrt(max(1 - zeta**2, 1e-12)) * t
        return np.exp(-zeta * omega * t) * (a * np.cos(ringing) + b * np.sin(ringing))

    start = (2 * math.pi * frequency, ratio, 1.0, 0.0)
    try:
        fitted, _ = curve_fit(
            model, times, signal / scale, p0=start, bounds=((0, 0, -1e6, -1e6), (np.inf, 1, 1e6, 1e6))
        )
    except (RuntimeError, ValueError) as error:
        raise DataError(
            f"No decaying oscillation could be fitted to the ring-down ({error}); choose a smaller time step."
        ) from error
    return float(fitted[0]) / (2 * math.pi), float(fitted[1])
