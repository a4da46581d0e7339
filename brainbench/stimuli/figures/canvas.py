"""Common parts of pictures of whiskers: colours of the rows, round ends of scales and round lengths of scale bars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from brainbench.core.limits import Limit, Positive, Share, limited

ROW_COLORS = ("#3466ac", "#1b9aa0", "#d1495b", "#7b4fa3", "#e08e1b")
"""Colours of the whisker rows A to E."""
UNSTABLE_COLOR = "#111111"
"""Colour of whiskers whose simulation cannot be trusted."""
MOMENT_MAP = "plasma"
"""Colour map of bending moments, by its name in matplotlib."""

_Pixels = Annotated[int, Limit(least=64, most=8192)]


@dataclass(frozen=True)
@limited(of="{} of a picture")
class Style:
    """Colours, size and quality of a picture of a scene; what is out of range is a :class:`UsageError`."""

    color: Literal["row", "moment"] = "row"
    """Whiskers by row, or by their local elastic bending moment."""
    moment_limit: Positive | None = None
    """Moment at the upper end of the colours [N·m]; None takes the largest that is shown."""
    thickness: Positive = 2.0
    """Whiskers are drawn so many times as thick as they are, and never thinner than a pixel."""
    opacity: Share = 1.0
    """Opacity of the objects, from 0 to 1; whiskers behind them shine through."""
    size: tuple[_Pixels, _Pixels] = (1280, 960)
    """Width and height in pixels."""
    supersampling: Annotated[int, Limit(least=1, most=4)] = 2
    """Samples per pixel and direction; smooths edges at its square of the cost."""
    frames_per_second: Annotated[float, Limit(above=0, most=120)] = 25.0
    """Frames per second of a film."""


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
