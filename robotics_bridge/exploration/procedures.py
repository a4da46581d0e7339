"""Exploratory procedures of the hand (Lederman & Klatzky 1987, Cognitive Psychology 19:342) as movements.

The palm is up and fixed; the object moves over it, or the fingers close around it. z = 0 is where the object just
touches the palm, x points along the fingers as near as the hand's frame allows. Metres, seconds, radians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from brainbench.core.reading.ranges import check_number


@dataclass(frozen=True)
class Pose:
    """A place of the object, and how far the fingers are closed."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    """Above the palm; negative presses."""
    yaw: float = 0.0
    """Turn about the vertical."""
    closing: float = 0.3
    """Share of their range to which the fingers are flexed."""


_ABOVE, _PRESSED, _LIGHT = 0.008, -0.002, -0.001
STEP = 1e-3
"""Seconds past the end of a procedure at which its pose is known, for forward differences there."""


def _ramp(time: float, start: float, end: float) -> float:
    check_number("time in an exploratory procedure (s)", time, least=0, most=1 + STEP)
    # 3 s² − 2 s³: starts and ends at rest, so that prescribed objects do not jerk.
    share = min(max((time - start) / (end - start), 0.0), 1.0)
    return share * share * (3 - 2 * share)


def _lateral(time: float) -> Pose:
    """Rub to and fro across the fingers, pressed: texture."""
    z = _ABOVE + (_PRESSED - _ABOVE) * _ramp(time, 0.0, 0.25)
    return Pose(y=0.012 * math.sin(4 * math.pi * max(time - 0.25, 0.0)), z=z)


def _static(time: float) -> Pose:
    """Press and hold: hardness."""
    return Pose(z=_ABOVE + (1.5 * _PRESSED - _ABOVE) * _ramp(time, 0.0, 0.5))


def _enclosure(time: float) -> Pose:
    """Close the fingers around it: global shape."""
    z = _ABOVE + (_LIGHT - _ABOVE) * _ramp(time, 0.0, 0.2)
    return Pose(z=z, closing=0.15 + 0.55 * _ramp(time, 0.2, 0.85))


def _contour(time: float) -> Pose:
    """Turn its outline along the fingers: exact shape."""
    z = _ABOVE + (_LIGHT - _ABOVE) * _ramp(time, 0.0, 0.2)
    # The object turns about itself while its middle goes once around a circle: the outline passes along the fingers.
    turn = 2 * math.pi * _ramp(time, 0.2, 1.0)
    return Pose(x=0.008 * math.sin(turn), y=0.008 * (1 - math.cos(turn)), z=z, yaw=turn, closing=0.45)


PROCEDURES: Mapping[str, Callable[[float], Pose]] = {
    "lateral_motion": _lateral,
    "static_pressure": _static,
    "enclosure": _enclosure,
    "contour_following": _contour,
}
"""Name → movement over one second: time from 0 to 1 s → pose; UsageError for another time."""
