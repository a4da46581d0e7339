"""Options of tracks and fits: what must be said, and what cannot be."""

from __future__ import annotations

import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.fitting import TrackOptions

SCALE, RATE = 5e-5, 500.0


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"metres_per_pixel": None}, "metres_per_pixel"),
        ({"frame_rate": None}, "frame_rate"),
        ({"metres_per_pixel": 50.0}, "between 1e-8 and 1e-2"),
        ({"frame_rate": 0.002}, "frames per second"),
        ({"layout": "whiskermann"}, "whiskerman"),
    ],
)
def test_scale_and_rate_are_required_and_checked(changes, word):
    with pytest.raises(UsageError, match=word):
        TrackOptions(**{"metres_per_pixel": SCALE, "frame_rate": RATE, **changes})
