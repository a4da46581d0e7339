"""Jobs: what their numbers must be beside one another."""

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from tests.factories.engine_scenes import C2


def test_no_frame_lies_before_the_start():
    with pytest.raises(UsageError, match=r"first frame \(0.1 s\) lies before .*0.2 s"):
        Job(C2, StillFollicle(), (), np.array([0.1]), start=0.2)


def test_a_load_acts_on_the_whisker():
    with pytest.raises(UsageError, match=r"arc of a load .*at most 0\.0\d+; received 1"):
        Job(C2, StillFollicle(), (), np.array([0.1]), loads=(Load(1.0, (0.0, 0.0, 0.0)),))
