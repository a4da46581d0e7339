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

from brainbench.core.errors import DataError, UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle, Trace
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.objects.obstacle import Capsule, Cylinder, Obstacle, RigidMotion
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.whisker import Whisker

_CLEARANCE = 1.2
"""Half width of a pulley's groove in base radii of the whisker."""


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
    motion = _sliding(lambda times: start + smooth_step(times, duration)[:, None] * (end - start))
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

    def depth(times: NDArray[np.float64]) -> NDArray[np.float64]:
        return expected * np.interp(times, [0.0, approach, duration], [0.0, 0.94, 1.12])

    times = np.linspace(0, duration, 2001)[1:]
    rod = _pulley(whisker, peg_radius, _sliding(lambda t: np.column_stack([np.full(len(t), at), touch + depth(t)])))
    trace = run_one(backend, job_at_rest(whisker, times, rod), fidelity)
    held = np.flatnonzero(trace.contact)
    if not len(held) or held[-1] == len(times) - 1:
        raise DataError(
            f"The whisker did not slip off the peg at {at:g} m within 1.12 times the depth of the elastica "
            f"({expected:.4g} m)."
        )
    return SlipOff(float(depth(times[held[-1] + 1])), float(expected), trace)


def _relative(measured: NDArray, reference: NDArray) -> float:
    return float(np.linalg.norm(measured - reference) / np.linalg.norm(reference))


def job_at_rest(whisker: Whisker, times: NDArray[np.float64], *obstacles: Obstacle) -> Job:
    """Return the job of a static test: critical damping changes only how soon the end state is reached."""
    return Job(replace(whisker, damping_ratio=1.0), StillFollicle(), obstacles, times)


def _sliding(place: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> RigidMotion:
    """Return the motion of a body that does not turn through points [n, 2] (m) of the plane of bending."""

    def motion(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.pad(place(times), ((0, 0), (0, 1))), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    return motion


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
