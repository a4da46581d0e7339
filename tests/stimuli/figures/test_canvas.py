import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.figures.canvas import Style


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"color": "rows"}, "did you mean 'row'"),
        ({"opacity": 1.5}, "opacity .*at most 1;"),
        ({"size": (10, 10)}, "64 to 8192"),
        ({"thickness": 0.0}, "thickness .*above 0"),
        ({"supersampling": 9}, "1, 2, 3 or 4"),
        ({"frames_per_second": 0.0}, "frames_per_second .*at most 120"),
        ({"moment_limit": -1.0}, r"moment_limit .*received -1"),
    ],
)
def test_impossible_styles_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        Style(**options)
