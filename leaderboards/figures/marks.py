"""The marks of the pages: positions of dots and intervals on an axis, and RDM pictures.

Charts are rows of an HTML table with one small SVG per row. Positions are percentages of the cell,
so a chart fits any width without script, follows the page's colours and can be sorted with its rows.
"""

from __future__ import annotations

import base64
import math
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

from brainbench.core.records import Interval, Score
from brainbench.core.statistics import is_finite

MARGIN = 4.0
"""Percent of the cell kept free on each side, so that marks at the ends are not cut."""

LIMITS = (-1.0, 1.5)
"""Farthest an axis reaches; an arrow at its end tells that something lies beyond."""

# Nine equidistant colours of viridis (van der Walt & Smith 2015), perceptually uniform and safe for
# colour-blind readers.
_VIRIDIS = ("440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725")
_LEVELS = 254


@dataclass(frozen=True)
class Mark:
    """One row of a chart; positions in percent of the cell's width, None where there is nothing to draw."""

    x: float | None
    low: float | None
    high: float | None
    points: tuple[float, ...]
    more_left: bool
    """True when the value, the interval or a point lies beyond the left end of the axis."""
    more_right: bool


@dataclass(frozen=True)
class Axis:
    """A linear axis with round ticks."""

    low: float
    high: float
    ticks: tuple[float, ...]

    def at(self, value: float) -> float:
        """Return the position of ``value`` in percent, held inside the axis."""
        inside = min(max(value, self.low), self.high)
        return round(MARGIN + (100 - 2 * MARGIN) * (inside - self.low) / (self.high - self.low), 2)

    def mark(self, value: float, interval: Interval | None = None, points: Sequence[float] = ()) -> Mark:
        """Place a value with its interval and the single observations behind it; NaN is not drawn."""
        span = (interval.low, interval.high) if interval and is_finite(interval) else None
        seen = [item for item in (value, *(span or ()), *points) if math.isfinite(item)]
        return Mark(
            x=self.at(value) if self.low <= value <= self.high else None,
            low=self.at(span[0]) if span else None,
            high=self.at(span[1]) if span else None,
            points=tuple(self.at(point) for point in points if self.low <= point <= self.high),
            more_left=any(item < self.low for item in seen),
            more_right=any(item > self.high for item in seen),
        )


def axis_of(values: Iterable[float]) -> Axis:
    """Return an axis from 0 to 1 or wider, as far as the finite values need and :data:`LIMITS` allow."""
    finite = [value for value in values if math.isfinite(value)]
    low = max(min([0.0, *finite]), LIMITS[0])
    high = min(max([1.0, *finite]), LIMITS[1])
    step = 0.5 if high - low > 1.6 else 0.25
    first, last = math.floor(low / step), math.ceil(high / step)
    return Axis(first * step, last * step, tuple(step * i for i in range(first, last + 1)))


def score_axis(scores: Iterable[Score]) -> Axis:
    """Return the axis that shows these scores; only trustworthy ones may widen it by their intervals."""
    values: list[float] = []
    for score in scores:
        values.append(score.value)
        if score.status == "ok" and score.interval and is_finite(score.interval):
            values += [score.interval.low, score.interval.high]
    return axis_of(values)


@dataclass(frozen=True)
class RdmPicture:
    """An RDM as a PNG of one pixel per cell, with what a reader needs beside it."""

    source: str
    """``data:`` address of the image; the diagonal is transparent, pairs without a value are grey."""
    labels: tuple[str, ...]
    low: float
    high: float
    description: str
    """The picture in words, for readers who do not see it."""


def rdm_picture(pairs: Sequence[float], labels: Sequence[str]) -> RdmPicture | None:
    """Draw an RDM given as its upper triangle [P], row by row; None when there are no pairs to draw.

    The colours span this RDM's own range, because comparisons by correlation ignore scale.
    """
    size = len(labels)
    if size < 2 or len(pairs) != size * (size - 1) // 2:
        return None
    places = list(combinations(range(size), 2))
    finite = [(value, place) for value, place in zip(pairs, places, strict=True) if math.isfinite(value)]
    if not finite:
        return None
    (low, alike), (high, apart) = min(finite), max(finite)
    scale = (_LEVELS - 1) / (high - low) if high > low else 0.0
    cells: list[list[int | None]] = [[None] * size for _ in range(size)]
    for value, (i, j) in zip(pairs, places, strict=True):
        cells[i][j] = cells[j][i] = round((value - low) * scale) if math.isfinite(value) else _LEVELS
    description = (
        f"{size} by {size} matrix of dissimilarities from {low:.3g} to {high:.3g}; most alike are "
        f"{labels[alike[0]]} and {labels[alike[1]]}, most different {labels[apart[0]]} and {labels[apart[1]]}."
    )
    if len(finite) < len(pairs):
        description += f" Undefined pairs: {len(pairs) - len(finite)}."
    return RdmPicture(_png(cells), tuple(labels), low, high, description)


def colour_stops() -> tuple[tuple[float, str], ...]:
    """Return (offset in percent, colour) for the legend's gradient."""
    return tuple((100 * i / (len(_VIRIDIS) - 1), f"#{colour}") for i, colour in enumerate(_VIRIDIS))


def colour_at(share: float) -> str:
    """Return the colour of a value that lies a share (0 to 1) along the colour scale, as ``#rrggbb``."""
    return f"#{_colour(round(min(max(share, 0.0), 1.0) * (_LEVELS - 1))).hex()}"


def _png(cells: list[list[int | None]]) -> str:
    """Encode colour levels (None: transparent) as an indexed PNG (W3C recommendation, third edition).

    The palette holds only the colours in use: most RDMs are small, and a page holds hundreds.
    """
    used = sorted({level for row in cells for level in row if level is not None})
    index = {None: 0} | {level: i for i, level in enumerate(used, start=1)}
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in (
        (b"IHDR", struct.pack(">IIBBBBB", len(cells), len(cells), 8, 3, 0, 0, 0)),
        (b"PLTE", bytes(3) + b"".join(map(_colour, used))),
        (b"tRNS", b"\x00"),
        (b"IDAT", zlib.compress(b"".join(b"\x00" + bytes(index[level] for level in row) for row in cells), 9)),
        (b"IEND", b""),
    ):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return "data:image/png;base64," + base64.b64encode(data).decode()


def _colour(level: int) -> bytes:
    if level >= _LEVELS:
        return b"\x80\x80\x80"
    place = level / (_LEVELS - 1) * (len(_VIRIDIS) - 1)
    index = min(int(place), len(_VIRIDIS) - 2)
    first, second = bytes.fromhex(_VIRIDIS[index]), bytes.fromhex(_VIRIDIS[index + 1])
    return bytes(round(a + (b - a) * (place - index)) for a, b in zip(first, second, strict=True))
