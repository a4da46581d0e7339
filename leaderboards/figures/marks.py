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
from typing import Any

from brainbench.core.records import Interval, LayerScore, ResultRecord, Score
from brainbench.core.statistics import is_finite

MARGIN = 4.0
"""Percent of the cell kept free on each side, so that marks at the ends are not cut."""

LIMITS = (-1.0, 1.5)
"""Farthest an axis reaches; an arrow at its end tells that something lies beyond."""

# Nine equidistant colours of viridis (van der Walt & Smith 2015), perceptually uniform and safe for
# colour-blind readers.
_VIRIDIS = ("440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725")
_LEVELS = 254
_MOST_PAIRS = 100
"""An RDM with more pairs than this is shown as a picture only; its numbers are in the record."""


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
        span = interval_ends(interval)
        seen = [item for item in (value, *span, *points) if math.isfinite(item)]
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
    scores = list(scores)
    ends = [end for score in scores if score.status == "ok" for end in interval_ends(score.interval)]
    return axis_of([score.value for score in scores] + ends)


def interval_ends(interval: Interval | None) -> tuple[float, ...]:
    """Return both ends of an interval, nothing where it has none."""
    return (interval.low, interval.high) if interval and is_finite(interval) else ()


@dataclass(frozen=True)
class ScoreRow:
    """The score of the model or of a baseline, placed on the axes of noise-corrected and raw scores."""

    label: str
    kind: str
    """``model``, ``animals`` (animal-to-animal) or ``baseline``."""
    shape: str
    score: Score
    mark: Mark
    raw_mark: Mark


@dataclass(frozen=True)
class LayerRow:
    """The score of a layer, placed on the axis."""

    layer: LayerScore
    mark: Mark
    kind: str
    note: str
    shape: str
    p: float | None
    """Corrected for the number of layers; None when the record states none."""


def record_charts(record: ResultRecord) -> dict[str, Any]:
    """Return the charts of a record as the templates draw them: axes, rows, layers, animals and RDMs."""
    score = record.score
    named = [(score.name, "model", "dot", score)]
    named += [("animal-to-animal", "animals", "square", record.animal_to_animal)] if record.animal_to_animal else []
    named += [(name, "baseline", "diamond", item) for name, item in record.baselines.items()]
    axis = score_axis(item for *_, item in named)
    singles = [subject.value for subject in score.subjects] + [layer.value for layer in score.layers]
    axis = axis_of([axis.low, axis.high, *singles])
    ceiling = (score.ceiling.lower, score.ceiling.upper) if score.ceiling else ()
    ceiling = ceiling if all(map(math.isfinite, ceiling)) else ()
    raw_axis = axis_of([*(item.r for *_, item in named), *ceiling])
    rows = []
    for label, kind, shape, item in named:
        mark = axis.mark(item.value, item.interval, [subject.value for subject in item.subjects])
        raw_mark = raw_axis.mark(item.r, None, [subject.r for subject in item.subjects])
        rows.append(ScoreRow(label, kind, shape, item, mark, raw_mark))
    layers, tests = [], score.provenance.layer_p
    for layer in score.layers:
        chosen, best = layer.layer == score.layer, layer.layer == score.best_layer
        notes = ["chosen on held-out data"] * chosen + ["optimistic maximum, not a result"] * best
        kind, shape = "chosen" if chosen else "best" if best else "layer", "diamond" if best else "dot"
        mark = axis.mark(layer.value, layer.interval)
        layers.append(LayerRow(layer, mark, kind, "; ".join(notes), shape, tests.get(layer.layer)))
    animals = record.animal_to_animal
    pairs: list[tuple[str, str, float, float]] = []
    if 0 < len(score.model_rdm) == len(score.brain_rdm) <= _MOST_PAIRS:
        values = zip(combinations(score.stimuli, 2), score.model_rdm, score.brain_rdm, strict=True)
        pairs = [(first, second, model, brain) for (first, second), model, brain in values]
    return {
        "axis": axis,
        "raw_axis": raw_axis,
        "band": interval_ends(animals.interval) if animals and animals.status == "ok" else (),
        "ceiling": ceiling,
        "rows": rows,
        "layers": layers,
        "layer_reference": score.value if score.status != "undefined" and score.layers else None,
        "animals": [(subject, axis.mark(subject.value)) for subject in score.subjects],
        "model_rdm": rdm_picture(score.model_rdm, score.stimuli),
        "brain_rdm": rdm_picture(score.brain_rdm, score.stimuli),
        "pairs": pairs,
    }


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
