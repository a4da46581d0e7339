"""Random scenes of contact: reproducible, of every kind, and touched."""

import math

import numpy as np
import pytest

from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Trace
from brainbench.stimuli.validation.contact_scenes import CELLS, contact_jobs, difference


def _trace(wrench, status="ok"):
    contact = np.ones(len(wrench), dtype=bool)
    return Trace(np.asarray(wrench, dtype=float), contact, np.zeros(len(wrench)), status=status)


def test_a_seed_gives_the_same_scenes_and_another_one_others():
    first, again, other = contact_jobs(1, each=1), contact_jobs(1, each=1), contact_jobs(2, each=1)
    assert len(first) == CELLS
    where = [np.concatenate([job.obstacles[0].bounds.ravel() for job in jobs]) for jobs in (first, again, other)]
    np.testing.assert_array_equal(where[0], where[1])
    assert not np.isclose(where[0], where[2]).any()


def test_nearly_every_whisker_starts_free_and_then_touches():
    jobs = contact_jobs(3, each=1)
    traces = get_engine("rod").run(jobs, Fidelity.preset("fast"))
    assert sum(trace.status == "ok" for trace in traces) >= 0.95 * CELLS
    assert sum(trace.contact.any() and not trace.contact[0] for trace in traces) >= 0.95 * CELLS


def test_the_difference_is_that_of_force_or_moment_whichever_is_larger():
    wrench = np.tile([3.0, 0, 4.0, 0.1, 0, 0], (5, 1))
    assert difference(_trace(wrench * [1.1, 1, 1.1, 1, 1, 1]), _trace(wrench)) == pytest.approx(0.1)
    assert difference(_trace(wrench * [1, 1, 1, 1.2, 1, 1]), _trace(wrench)) == pytest.approx(0.2)
    assert difference(_trace(wrench, "unstable"), _trace(wrench)) == math.inf
