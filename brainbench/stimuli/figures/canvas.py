"""Common parts of pictures of whiskers: colours of the rows, round ends of scales and round lengths of scale bars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from brainbench.core.errors import UsageError, check_name
from brainbench.core.reading.ranges import check_fields

ROW_COLORS = ("#3466ac", "#1b9aa0", "#d1495b", "#7b4fa3", "#e08e1b")
"""Colours of the whisker rows A to E."""
UNSTABLE_COLOR = "#111111"
"""Colour of whiskers whose simulation cannot be trusted."""
MOMENT_MAP = "plasma"
"""Colour map of bending moments, by its name in matplotlib."""
COLORINGS = ("row", "moment")


@dataclass(frozen=True)
class Style:
    """Colours, size and quality of a picture of a scene; what is out of range is a :class:`UsageError`."""

    color: Literal["row", "moment"] = "row"
    """Whiskers by row, or by their local elastic bending moment."""
    moment_limit: float | None = None
    """Moment at the upper end of the colours [N·m]; None takes the largest that is shown."""
    thickness: float = 2.0
    """Whiskers are drawn so many times as thick as they are, and never thinner than a pixel."""
    opacity: float = 1.0
    """Opacity of the objects, from 0 to 1; whiskers behind them shine through."""
    size: tuple[int, int] = (1280, 960)
    """Width and height in pixels."""
    supersampling: int = 2
    """Samples per pixel and direction; smooths edges at its square of the cost."""
    frames_per_second: float = 25.0
    """Frames per second of a film."""

    def __post_init__(self) -> None:
        check_name("colouring", self.color, COLORINGS)
        check_fields(self, "moment_limit", "thickness", above=0)
        check_fields(self, "opacity", least=0, most=1)
        if len(self.size) != 2 or not all(64 <= value <= 8192 for value in self.size):
            raise UsageError(f"The size of a picture is 64 to 8192 pixels each way; received {self.size!r}.")
        if self.supersampling not in (1, 2, 3, 4):
            raise UsageError(f"supersampling is 1, 2, 3 or 4; received {self.supersampling!r}.")
        check_fields(self, "frames_per_second", above=0, most=120)


def round_up(value: float) -> float:
    """Return the least of a few round numbers that is not below ``value``, for the end of a scale.

    >>> round_up(0.308)
    0.4
    """
    power = 10.0 ** math.floor(math.log10(value))
    steps = (1, 1.2, 1.6, 2, 2.4, 3, 4, 5, 6, 8, 10)
    return float(f"{next(step for step in steps if step * power >= value * (1 - 1e-9)) * power:.3g}")


def round_length(length: float) -> float:
    """Return the longest of 1, 2, 5 times a power of ten that is not above ``length``.

    >>> round_length(0.0073)
    0.005
    """
    power = 10.0 ** math.floor(math.log10(length) + 1e-9)
    return max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9))
