"""Jobs and bases that stand still: numbers that cannot be are refused."""

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from tests.factories.whiskers import C2


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: StillFollicle(position=(np.nan, 0.0, 0.0)), "position"),
        (lambda: StillFollicle(euler=(0.0, np.inf, 0.0)), "euler"),
        (lambda: Job(C2, StillFollicle(), (), np.array([0.1]), start=np.nan), "start"),
        (lambda: Job(C2, StillFollicle(), (), np.array([0.1]), gravity=(0.0, 0.0, np.nan)), "gravity"),
        (lambda: Job(C2, StillFollicle(), (), np.array([0.1]), loads=(Load(0.01, (0.0, np.nan, 0.0)),)), "force"),
        (lambda: Job(C2, StillFollicle(), (), np.array([0.1]), loads=(Load(0.01, (0, 0, 0), stop=np.nan),)), "stop"),
    ],
)
def test_jobs_of_numbers_that_are_not_finite_are_refused(make, said):
    with pytest.raises(UsageError, match=f"{said} .*nan|{said} .*inf"):
        make()
