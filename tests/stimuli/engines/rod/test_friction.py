"""Friction of ``rod`` beside a differential equation with penalty contact and viscous creep, solved by SciPy's BDF."""

import numpy as np
import pytest

from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.friction_reference import Passing, Penalty, misses, solve

LINKS = 6


@pytest.mark.parametrize(("shape", "duration"), [("peg", 0.2), ("ball", 0.15)])
def test_a_whisker_dragged_over_something_rough_feels_what_the_differential_equation_says(shape, duration):
    passing = Passing.of(WhiskerArray.mouse()["C2"].whisker, shape, 0.48)
    times, truth = solve(Penalty(passing, LINKS), duration)
    trace = get_engine("rod").run([passing.job(duration)], Fidelity(links=LINKS, time_step=1e-4))[0]
    assert len(times) > 100
    assert np.linalg.norm(truth[-1, :3]) > 1e-5
    # Per cent of the peak: difference of the peaks, median reading, root mean square; force, then moment.
    assert np.all(np.array(misses(trace.wrench[: len(truth)], truth)) < 1.0)
