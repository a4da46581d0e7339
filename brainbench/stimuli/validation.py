"""Bench tests of the simulated whisker against mechanics that needs no simulation.

Each function sets up a known experiment, drives the real backend with it and returns what it measured
beside the reference of :mod:`brainbench.stimuli.references`. Frame: base at the origin, whisker along +x,
bending in the x-y plane. Wrenches are the action of the whisker on its base, about the base point; SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from brainbench.errors import DataError, UsageError
from brainbench.stimuli import references
from brainbench.stimuli.backends import get_backend
from brainbench.stimuli.backends.protocol import Job, Load, StillFollicle
from brainbench.stimuli.fidelity import Fidelity
from brainbench.stimuli.obstacle import Capsule, Obstacle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.stimuli.backends.protocol import Trace
    from brainbench.stimuli.whisker import Whisker


@dataclass(frozen=True, eq=False)
class BenchTest:
    """A static bench test: what the backend measured beside the reference."""

    wrench: NDArray[np.float64]
    """[6] measured force (N) and moment (N·m)."""
    reference: NDArray[np.float64]
    """[6] force and moment of the closed form or of the elastica."""
    contact_arc: float
    """Arc length of the contact or of the load (m); NaN when the whisker lost the peg."""
    trace: Trace
    """The whole simulation; the last frame is the result."""

    @property
    def force_error(self) -> float:
        """Length of the force difference over the length of the reference force."""
        return float(np.linalg.norm(self.wrench[:3] - self.reference[:3]) / np.linalg.norm(self.reference[:3]))

    @property
    def moment_error(self) -> float:
        """Length of the moment difference over the length of the reference moment."""
        return float(np.linalg.norm(self.wrench[3:] - self.reference[3:]) / np.linalg.norm(self.reference[3:]))


@dataclass(frozen=True, eq=False)
class PointLoad(BenchTest):
    """A point load, with the deflection it causes."""

    deflection: float
    """Measured displacement of the loaded point along the load (m)."""
    reference_deflection: float
    """Small-bending closed form δ = F a³/(3 E I_b) · r_b/r(a) (m)."""


@dataclass(frozen=True, eq=False)
class Ringdown:
    """Free vibration after a small tip load is let go."""

    frequency: float
    """Measured undamped frequency of the first mode (Hz)."""
    damping_ratio: float
    """Measured damping ratio of the first mode."""
    reference_frequency: float
    """Euler-Bernoulli frequency of the first mode (Hz)."""
    times: NDArray[np.float64]
    """[n] time since the release (s)."""
    wrench: NDArray[np.float64]
    """[n, 6] base wrench during the ring-down; its last row is at rest."""

    @property
    def frequency_error(self) -> float:
        """Relative error of the frequency (signed)."""
        return self.frequency / self.reference_frequency - 1


def point_load(
    whisker: Whisker,
    force: float,
    at: float,
    *,
    backend: str = "mujoco",
    fidelity: Fidelity | str = "balanced",
) -> PointLoad:
    """Load a straight whisker with ``force`` (N, along +y) at arc length ``at`` (m) and wait until it is at rest.

    The closed form holds for small bending; the base moment of the reference uses the undeformed lever.

    Raises:
        UsageError: the whisker is curved, ``at`` lies beyond it, or the force is zero.
        DataError: the simulation was unstable.
    """
    if force == 0 or not math.isfinite(force):
        raise UsageError(f"force must be a finite number of newtons other than zero; received {force!r}.")
    expected = references.point_load_deflection(whisker, force, at)
    fidelity = _fidelity(fidelity)
    critical = replace(whisker, damping_ratio=1.0)
    duration = _settling_time(whisker)
    job = Job(critical, StillFollicle(), (), np.array([duration]), loads=(Load(at, (0.0, force, 0.0)),))
    trace = _run(backend, job, fidelity)
    assert trace.link_positions is not None
    links = trace.link_positions.shape[1] - 1
    place = at / whisker.arc_length * links
    deflection = float(np.interp(place, np.arange(links + 1), trace.link_positions[-1, :, 1]))
    return PointLoad(
        wrench=trace.wrench[-1],
        reference=np.array([0.0, force, 0.0, 0.0, 0.0, force * at]),
        contact_arc=at,
        trace=trace,
        deflection=deflection,
        reference_deflection=expected,
    )


def peg(
    whisker: Whisker,
    at: float,
    offset: float,
    *,
    peg_radius: float = 2.5e-4,
    backend: str = "mujoco",
    fidelity: Fidelity | str = "balanced",
) -> BenchTest:
    """Press a frictionless round peg against a straight whisker and compare with the elastica.

    The base stands still; the peg, a long rod along z, moves sideways from touching the undeformed
    whisker until the centre-line point at the contact is (``at``, ``offset``), and rests there. Its axis then
    lies one peg radius plus the local rod radius from that point, along the rod's normal. The end state is
    quasi-static, without gravity. ``offset`` > 0 pushes towards +y.

    Raises:
        UsageError: the whisker is curved, the offset is zero, or the whisker would slip off the peg.
        DataError: the simulation was unstable.
    """
    if whisker.curvature:
        raise UsageError(f"The peg test takes a straight whisker; this one has curvature {whisker.curvature:g} 1/m.")
    if offset == 0:
        raise UsageError("The peg test needs an offset other than zero.")
    if not peg_radius > 0:
        raise UsageError(f"peg_radius must be positive (m); received {peg_radius!r}.")
    contact = references.elastica(whisker, at, offset)
    fidelity = _fidelity(fidelity)
    end = np.array(references.peg_centre(whisker, contact, peg_radius))
    # Straight below the end point, touching the undeformed rod.
    start = np.array([end[0], -math.copysign(peg_radius + float(whisker.radius(end[0])), offset)])
    settling = _settling_time(whisker)
    duration = max(0.1, 4 * settling)

    def motion(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        u = np.clip(times / duration, 0.0, 1.0)
        position = np.zeros((len(times), 3))
        position[:, :2] = start + (u**3 * (10 - 15 * u + 6 * u**2))[:, None] * (end - start)
        return position, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    half = whisker.arc_length
    rod = Obstacle((Capsule((0.0, 0.0, -half), (0.0, 0.0, half), peg_radius),), motion, friction=0.0)
    # Critical damping changes only how soon the end state is reached.
    critical = replace(whisker, damping_ratio=1.0)
    trace = _run(backend, Job(critical, StillFollicle(), (rod,), np.array([duration + settling])), fidelity)
    return BenchTest(trace.wrench[-1], contact.wrench, float(trace.contact_arc[-1]), trace)


def ringdown(
    whisker: Whisker,
    *,
    deflection: float = 1e-3,
    backend: str = "mujoco",
    fidelity: Fidelity | str = "accurate",
) -> Ringdown:
    """Let a bent whisker go and fit its first mode.

    A tip load bends it by ``deflection`` (fraction of the arc length, small), settles, and vanishes; a
    decaying sinusoid is fitted to the base moment after the higher modes have died.

    Raises:
        UsageError: the whisker is curved or its damping ratio is not between 0 and 1, so nothing rings.
        DataError: the simulation was unstable, or nothing rang: the time step overdamps the whisker.
    """
    if not 0 < whisker.damping_ratio < 1:
        raise UsageError(
            f"A ring-down needs a damping ratio between 0 and 1; this whisker has {whisker.damping_ratio:g}."
        )
    fidelity = _fidelity(fidelity)
    expected = float(references.natural_frequencies(whisker, 1)[0])
    force = deflection * whisker.arc_length / references.point_load_deflection(whisker, 1.0, whisker.arc_length)
    release = 8 / (whisker.damping_ratio * 2 * math.pi * expected)
    step = fidelity.time_step
    release = math.ceil(release / step) * step
    times = release + np.arange(1.0, math.ceil(10 / (whisker.damping_ratio * 2 * math.pi * expected) / step)) * step
    job = Job(
        whisker,
        StillFollicle(),
        (),
        times,
        loads=(Load(whisker.arc_length, (0.0, force, 0.0), stop=release - step / 2),),
    )
    trace = _run(backend, job, fidelity)
    times = times - release
    frequency, ratio = _fit_decay(times, trace.wrench[:, 5], expected, whisker.damping_ratio)
    return Ringdown(frequency, ratio, expected, times, trace.wrench)


def _fit_decay(times: NDArray, signal: NDArray, frequency: float, ratio: float) -> tuple[float, float]:
    """Undamped frequency (Hz) and damping ratio of a decaying sinusoid."""
    from scipy.optimize import curve_fit

    # Stiffness-proportional damping kills the second mode much sooner: one period is enough.
    kept = times > 1 / frequency
    scale = float(np.abs(signal[kept]).max())

    def model(t: NDArray, omega: float, zeta: float, a: float, b: float) -> NDArray:
        ringing = omega * math.sqrt(max(1 - zeta**2, 1e-12)) * t
        return np.exp(-zeta * omega * t) * (a * np.cos(ringing) + b * np.sin(ringing))

    start = (2 * math.pi * frequency, ratio, 1.0, 0.0)
    try:
        found, _ = curve_fit(
            model, times[kept], signal[kept] / scale, p0=start, bounds=((0, 0, -1e6, -1e6), (np.inf, 1, 1e6, 1e6))
        )
    except (RuntimeError, ValueError) as error:
        raise DataError(
            f"No decaying oscillation could be fitted to the ring-down ({error}); choose a smaller time step."
        ) from error
    return float(found[0]) / (2 * math.pi), float(found[1])


def _settling_time(whisker: Whisker) -> float:
    """Time (s) in which the first mode decays far below 1e-6 at critical damping."""
    return 6.0 / float(references.natural_frequencies(whisker, 1)[0])


def _fidelity(fidelity: Fidelity | str) -> Fidelity:
    return Fidelity.preset(fidelity) if isinstance(fidelity, str) else fidelity


def _run(backend: str, job: Job, fidelity: Fidelity) -> Trace:
    trace = get_backend(backend).run([job], fidelity, workers=1, record_shape=True)[0]
    if trace.status != "ok":
        raise DataError(f"The simulation was unstable: {trace.reason}.")
    return trace
