"""Bench tests of bending and twist together: a curved whisker is loaded out of its plane, by a force or by a peg."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.motion.jobs import Load
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle
from brainbench.stimuli.validation.bench_tests import BenchTest, PointLoad, job_at_rest, run_one, settling_time
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.factories.kirchhoff import KirchhoffRod, RodEquilibrium, load_rod, press_rod

PEG = 2.5e-4  # radius of the peg, m


def load_aside(
    whisker: Whisker, at: float, force: float, *, backend: str = DEFAULT_ENGINE, fidelity: Fidelity | str = "balanced"
) -> PointLoad:
    """Load a whisker with ``force`` (N) across its plane at arc length ``at`` (m); compare with the Kirchhoff rod.

    The deflection is that of the loaded point along the force; its relative error is that of the stiffness.
    """
    expected = load_rod(KirchhoffRod.of(whisker), at, (0.0, 0.0, force))
    job = replace(job_at_rest(whisker, np.array([settling_time(whisker)])), loads=(Load(at, (0.0, 0.0, force)),))
    trace = run_one(backend, job, fidelity)
    assert trace.link_positions is not None
    nodes = np.linspace(0, whisker.arc_length, trace.link_positions.shape[1])
    deflection = float(np.interp(at, nodes, trace.link_positions[-1, :, 2]))
    return PointLoad(trace.wrench[-1], expected.wrench, at, trace, deflection, float(expected.point[2]))


def push_aside(
    whisker: Whisker,
    at: float,
    offset: float,
    *,
    backend: str = DEFAULT_ENGINE,
    fidelity: Fidelity | str = "balanced",
) -> BenchTest:
    """Push a whisker out of its plane and compare with the Kirchhoff rod (:mod:`tests.factories.kirchhoff`).

    The base stands still. A long frictionless round peg lies in parallel to the whisker's plane and normal to the
    whisker at arc length ``at`` (m). It moves along the plane's normal by ``offset`` (m, positive) from touching the
    unbent whisker, and rests there. The end state is quasi-static, without gravity.
    """
    expected, axis, way = _expected(whisker, at, offset), _axis(whisker, at), np.array([0.0, 0.0, 1.0])
    touch = np.append(whisker.centre_line(at), -PEG - float(whisker.radius(at)))
    # The peg is slow against the first mode.
    settling = settling_time(whisker)
    duration = max(0.1, 4 * settling)

    def motion(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return touch + np.outer(smooth_step(times, duration) * offset, way), np.tile([1.0, 0, 0, 0], (len(times), 1))

    x, y, z = (whisker.arc_length * axis).tolist()
    rod = Obstacle((Capsule((-x, -y, -z), (x, y, z), PEG),), motion, friction=0.0)
    trace = run_one(backend, job_at_rest(whisker, np.array([duration + settling]), rod), fidelity)
    return BenchTest(trace.wrench[-1], expected.wrench, float(trace.contact_arc[-1]), trace)


def _axis(whisker: Whisker, at: float) -> NDArray[np.float64]:
    """Return the direction [3] in the whisker's plane that is normal to it at ``at`` (m)."""
    angle = float(whisker.tangent_angle(at))
    return np.array([-math.sin(angle), math.cos(angle), 0.0])


@lru_cache(maxsize=256)
def _expected(whisker: Whisker, at: float, offset: float) -> RodEquilibrium:
    return press_rod(KirchhoffRod.of(whisker), at, _axis(whisker, at), (0.0, 0.0, 1.0), offset, PEG)
