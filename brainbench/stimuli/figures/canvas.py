"""Common parts of pictures of whiskers: colours of the rows, round ends of scales and round lengths of scale bars."""

from __future__ import annotations

import math

ROW_COLORS = ("#3466ac", "#1b9aa0", "#d1495b", "#7b4fa3", "#e08e1b")
"""Colours of the whisker rows A to E."""
UNSTABLE_COLOR = "#111111"
"""Colour of whiskers whose simulation cannot be trusted."""
MOMENT_MAP = "plasma"
"""Colour map of bending moments, by its name in matplotlib."""


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
