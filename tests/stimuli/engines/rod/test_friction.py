"""Friction of ``rod`` beside a differential equation with penalty contact and viscous creep, solved by SciPy's BDF."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.validation.bench_tests import contact_jobs, difference
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.friction_reference import Passing, Penalty, misses, solve

LINKS = 6


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "duration"), [("peg", 0.2), ("ball", 0.15)])
def test_a_whisker_dragged_over_something_rough_feels_what_the_differential_equation_says(shape, duration):
    passing = Passing.of(WhiskerArray.mouse()["C2"].whisker, shape, 0.48)
    times, truth = solve(Penalty(passing, LINKS), duration)
    trace = get_engine("rod").run([passing.job(duration)], Fidelity(links=LINKS, time_step=1e-4))[0]
    assert len(times) > 100
    assert np.linalg.norm(truth[-1, :3]) > 1e-5
    # Per cent of the peak: difference of the peaks, median reading, root mean square; force, then moment.
    assert np.all(np.array(misses(trace.wrench[: len(truth)], truth)) < 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("backend", "left"), [("rod", 1e-4), ("mujoco", 1e-3)])
def test_contact_forces_are_as_exact_as_is_asked_for(backend, left):
    engine = get_engine(backend)
    jobs = [job for job in contact_jobs(5, each=1) if job.obstacles[0].friction == 0.8 and len(job.times) < 200]
    jobs = jobs[:: 4 if backend == "rod" else 2]
    if backend == "mujoco":  # loses more friction, and says so
        jobs = [replace(job, obstacles=tuple(replace(item, friction=0.2) for item in job.obstacles)) for job in jobs]
    fidelity = Fidelity(links=12, time_step=1e-4, precision="double")
    runs = [engine.run(jobs, replace(fidelity, contact_tolerance=tolerance)) for tolerance in (None, 1e-6, 1e-10)]
    # Soft contacts throw one of the whiskers about, which the engine says.
    trusted = [row for row in zip(*runs, strict=True) if {trace.status for trace in row} == {"ok"}]
    assert len(trusted) >= 3
    few, asked, solved = zip(*trusted, strict=True)
    assert max(map(difference, few, solved)) > 0.01
    assert max(map(difference, asked, solved)) < left


def test_steps_whose_contact_forces_were_not_solved_are_counted():
    jobs = [job for job in contact_jobs(5, each=1) if len(job.times) < 200][::4]
    runs = [get_engine("rod").run(jobs, Fidelity(links=12, contact_tolerance=tolerance)) for tolerance in (None, 1e-5)]
    rough = np.array([job.obstacles[0].friction > 0 for job in jobs])
    few, solved = (np.array([trace.unsolved / max(1, trace.steps) for trace in traces]) for traces in runs)
    assert few[~rough].max() < 1e-3 < few[rough].mean()
    assert solved.max() < 0.1 * few[rough].mean()
