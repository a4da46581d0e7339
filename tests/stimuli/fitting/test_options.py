"""Options of fits: what does not go together."""

from __future__ import annotations

import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.fitting import FitOptions


def test_profiles_follow_squares_alone():
    with pytest.raises(UsageError, match=r"'huber'.*intervals = 'laplace'"):
        FitOptions(intervals="profile", loss="huber")
