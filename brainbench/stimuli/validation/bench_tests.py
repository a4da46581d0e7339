"""Bench tests of the simulated whisker against mechanics that needs no simulation.

Each function sets up a known experiment, drives the real backend with it and returns what it measured
beside the reference of :mod:`brainbench.stimuli.validation.references`. Frame: base at the origin, whisker along +x,
bending in the x-y plane. Wrenches are the action of the whisker on its base, about the base point; SI.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, check_number
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle, Trace
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.objects.obstacle import Capsule, Cylinder, Obstacle, RigidMotion
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.whisker import Whisker, build_chain

_CLEARANCE = 1.2  # half width of a pulley's groove in base radii of the whisker


@dataclass(frozen=True, eq=False)
class BenchTest:
    """A static bench test: what the backend measured beside the reference."""

    wrench: NDArray[np.float64]
    """[6] measured force (N) and moment (N·m)."""
    reference: NDArray[np.float64]
    """[6] force and moment of the closed form or of the elastica."""
    contact_arc: float
    """Arc length of the contact or of the load (m); NaN when the whisker lost the peg."""
    trace: Trace = field(repr=False)
    """The whole simulation; the last frame is the result."""

    @property
    def force_error(self) -> float:
        """Length of the force difference over the length of the reference force."""
        return _relative(self.wrench[:3], self.reference[:3])

    @property
    def moment_error(self) -> float:
        """Length of the moment difference over the length of the reference moment."""
        return _relative(self.wrench[3:], self.reference[3:])


@dataclass(frozen=True, eq=False)
class PointLoad(BenchTest):
    """A point load, with the deflection it causes."""

    deflection: float
    """Measured displacement of the loaded point along the load (m)."""
    reference_deflection: float
    """Small-bending closed form δ = F a³/(3 E I_b) · r_b/r(a) (m)."""


@dataclass(frozen=True, eq=False)
class SlipOff:
    """A peg raised until the whisker slips off."""

    depth: float
    """Measured travel of the peg from first touch to losing the whisker (m)."""
    reference_depth: float
    """Travel at which the elastica has no equilibrium any more (m)."""
    trace: Trace = field(repr=False)
    """The whole simulation."""

    @property
    def error(self) -> float:
        """Relative error of the depth (signed)."""
        return self.depth / self.reference_depth - 1


def point_load(
    whisker: Whisker, force: float, at: float, *, backend: str = DEFAULT_ENGINE, fidelity: Fidelity | str = "balanced"
) -> PointLoad:
    """Load a straight whisker with ``force`` (N, along +y) at arc length ``at`` (m) and wait until it is at rest.

    The closed form holds for small bending; the base moment of the reference uses the undeformed lever.
    """
    if force == 0 or not math.isfinite(force):
        raise UsageError(f"force must be a finite number of newtons other than zero; received {force!r}.")
    expected = references.point_load_deflection(whisker, force, at)
    job = replace(job_at_rest(whisker, np.array([settling_time(whisker)])), loads=(Load(at, (0.0, force, 0.0)),))
    trace = run_one(backend, job, fidelity)
    assert trace.link_positions is not None
    links = trace.link_positions.shape[1] - 1
    place = at / whisker.arc_length * links
    deflection = float(np.interp(place, np.arange(links + 1), trace.link_positions[-1, :, 1]))
    reference = np.array([0.0, force, 0.0, 0.0, 0.0, force * at])
    return PointLoad(trace.wrench[-1], reference, at, trace, deflection, expected)


def peg(
    whisker: Whisker,
    at: float,
    offset: float,
    *,
    peg_radius: float = 2.5e-4,
    backend: str = DEFAULT_ENGINE,
    fidelity: Fidelity | str = "balanced",
) -> BenchTest:
    """Press a frictionless round peg against a straight whisker and compare with the elastica.

    The base stands still; the peg, a long rod along z, moves sideways from touching the undeformed
    whisker until the centre-line point at the contact is (``at``, ``offset``), and rests there. Its axis then
    lies one peg radius plus the local rod radius from that point, along the rod's normal. The end state is
    quasi-static, without gravity. ``offset`` > 0 pushes towards +y.
    """
    _check_peg(whisker, peg_radius)
    if offset == 0:
        raise UsageError("The peg test needs an offset other than zero.")
    contact = references.elastica(whisker, at, offset)
    end = np.array(references.peg_centre(whisker, contact, peg_radius))
    # Straight below the end point, touching the undeformed rod.
    start = np.array([end[0], -math.copysign(peg_radius + float(whisker.radius(end[0])), offset)])
    settling = settling_time(whisker)
    # Slow against the first mode, so that little swings when the peg stops.
    duration = max(0.1, 4 * settling)
    motion = sliding(lambda times: start + smooth_step(times, duration)[:, None] * (end - start))
    vars(motion)["finest"] = 2 * duration
    rod = _peg_obstacle(whisker, peg_radius, motion)
    trace = run_one(backend, job_at_rest(whisker, np.array([duration + settling]), rod), fidelity)
    return BenchTest(trace.wrench[-1], contact.wrench, float(trace.contact_arc[-1]), trace)


def slip_off(
    whisker: Whisker,
    at: float,
    *,
    peg_radius: float = 2.5e-4,
    backend: str = DEFAULT_ENGINE,
    fidelity: Fidelity | str = "balanced",
) -> SlipOff:
    """Raise a frictionless round peg at distance ``at`` (m) from the base until the whisker slips off it.

    The peg moves slowly and straight towards +y from touching the undeformed whisker; no gravity. It carries a flange
    on either side, as a pulley does, which keeps the whisker in the plane of the elastica: bent by more than 90° at the
    contact, as before most slip-offs at small ``at``, it would swing out sideways.
    """
    _check_peg(whisker, peg_radius)
    touch = -(peg_radius + float(whisker.radius(at)))
    expected = references.slip_off_offset(whisker, at, peg_radius=peg_radius) - touch
    settling = settling_time(whisker)
    # Near the end it creeps, because the last fold takes the longer the nearer it is to equilibrium.
    duration, approach = 70 * settling, 10 * settling

    def _depth(times: NDArray[np.float64]) -> NDArray[np.float64]:
        return expected * np.interp(times, [0.0, approach, duration], [0.0, 0.94, 1.12])

    times = np.linspace(0, duration, 2001)[1:]
    rod = _pulley(whisker, peg_radius, sliding(lambda t: np.column_stack([np.full(len(t), at), touch + _depth(t)])))
    trace = run_one(backend, job_at_rest(whisker, times, rod), fidelity)
    held = np.flatnonzero(trace.contact)
    if not len(held) or held[-1] == len(times) - 1:
        raise DataError(
            f"The whisker did not slip off the peg at {at:g} m within 1.12 times the depth of the elastica "
            f"({expected:.4g} m)."
        )
    return SlipOff(float(_depth(times[held[-1] + 1])), float(expected), trace)


def _relative(measured: NDArray, reference: NDArray) -> float:
    return float(np.linalg.norm(measured - reference) / np.linalg.norm(reference))


def job_at_rest(whisker: Whisker, times: NDArray[np.float64], *obstacles: Obstacle) -> Job:
    """Return the job of a static test: critical damping changes only how soon the end state is reached."""
    return Job(replace(whisker, damping_ratio=1.0), StillFollicle(), obstacles, times)


def sliding(place: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> RigidMotion:
    """Return the motion of a body that does not turn, through points [n, 3] (m), or [n, 2] in the plane of bending."""

    def _motion(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        points = place(times)
        return np.pad(points, ((0, 0), (0, 3 - points.shape[1]))), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    return _motion


def _peg_obstacle(whisker: Whisker, radius: float, motion: RigidMotion) -> Obstacle:
    """Return a frictionless round rod along z, longer than the whisker."""
    half = whisker.arc_length
    return Obstacle((Capsule((0.0, 0.0, -half), (0.0, 0.0, half), radius),), motion, friction=0.0)


def _pulley(whisker: Whisker, radius: float, motion: RigidMotion) -> Obstacle:
    """Return a frictionless rod along z between two flanges, which an undisturbed whisker does not touch."""
    groove = _CLEARANCE * whisker.base_radius
    rim, half = radius + 10 * whisker.base_radius, whisker.arc_length
    flanges = (Cylinder((0.0, 0.0, side * groove), (0.0, 0.0, side * half), rim) for side in (-1, 1))
    return Obstacle((*_peg_obstacle(whisker, radius, motion).parts, *flanges), motion, friction=0.0)


def _check_peg(whisker: Whisker, peg_radius: float) -> None:
    if whisker.curvature:
        raise UsageError(f"The peg test takes a straight whisker; this one has curvature {whisker.curvature:g} 1/m.")
    check_number("peg_radius (m)", peg_radius, above=0)


def settling_time(whisker: Whisker) -> float:
    """Return the time (s) in which the first mode decays far below 1e-6 at critical damping."""
    # Critically damped, (1 + ω t) e^(−ω t) of a swing is left: 2e-15 after six periods.
    return 6.0 / float(references.natural_frequencies(whisker, 1)[0])


def run_one(backend: str, job: Job, fidelity: Fidelity | str) -> Trace:
    """Run one job with its shapes; an unstable one is a :class:`DataError`."""
    (trace,) = get_engine(backend).run([job], Fidelity.of(fidelity), workers=1, record_shape=True)
    if trace.status != "ok":
        raise DataError(f"The simulation was unstable: {trace.reason}.")
    return trace


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
    step = fidelity.step(expected, whisker.damping_ratio)
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
    return fit_decay(times, trace.link_positions[:, -1, 1] - float(levers[:, -1] @ bends), 1 / period, ratio)


def fit_decay(times: NDArray, signal: NDArray, frequency: float, ratio: float) -> tuple[float, float]:
    """Return the undamped frequency (Hz) and damping ratio of a decaying sinusoid."""
    from scipy.optimize import curve_fit

    scale = float(np.abs(signal).max())

    def _model(t: NDArray, omega: float, zeta: float, a: float, b: float) -> NDArray:
        # ω is undamped; a damped mode rings at ω √(1 − ζ²).
        ringing = omega * math.sqrt(max(1 - zeta**2, 1e-12)) * t
        return np.exp(-zeta * omega * t) * (a * np.cos(ringing) + b * np.sin(ringing))

    start = (2 * math.pi * frequency, ratio, 1.0, 0.0)
    try:
        fitted, _ = curve_fit(
            _model, times, signal / scale, p0=start, bounds=((0, 0, -1e6, -1e6), (np.inf, 1, 1e6, 1e6))
        )
    except (RuntimeError, ValueError) as error:
        raise DataError(
            f"No decaying oscillation could be fitted to the ring-down ({error}); choose a smaller time step."
        ) from error
    return float(fitted[0]) / (2 * math.pi), float(fitted[1])
