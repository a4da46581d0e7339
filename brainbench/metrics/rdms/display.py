"""An RDM with the names of its stimuli, that shows itself in notebooks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_each, check_once
from brainbench.metrics.rdms.pairs import Floats, rdm_stack, square, stimulus_count

_LARGEST_LABELLED = 24
"""Stimuli up to which names and values are written; above, the picture alone is drawn."""
_LARGEST_DRAWN = 120
_SIDE = 300.0
_DARK, _LIGHT, _MISSING = np.array([14, 77, 84]), np.array([240, 246, 245]), "#d6d0c4"


@dataclass(frozen=True, init=False, eq=False)
class RDM:
    """Dissimilarities [P] of named stimuli, upper triangle row by row.

    Takes the place of an array wherever numpy or :func:`brainbench.metrics.compare` wants one.

    >>> named = RDM([1.0, 2.0, 3.0], ["near", "medium", "far"])
    >>> named.between("far", "near"), np.asarray(named).tolist()
    (2.0, [1.0, 2.0, 3.0])
    """

    values: Floats
    stimuli: tuple[str, ...]
    title: str

    def __init__(self, values: ArrayLike, stimuli: Sequence[str] | None = None, *, title: str = "") -> None:
        """Name an RDM [P]; stimuli are numbered without names.

        Raises:
            UsageError: not one RDM vector, another number of names, or one of them twice.
        """
        array = rdm_stack(values, "values")
        if array.ndim != 1:
            raise UsageError(f"An RDM is one vector [P]; received shape {array.shape}; name each one by itself.")
        count = stimulus_count(len(array))
        names = tuple(map(str, range(count))) if stimuli is None else tuple(map(str, stimuli))
        if len(names) != count:
            raise UsageError(f"This RDM is of {count} stimuli; received {len(names)} names.")
        check_once("An RDM", names)
        for name, value in (("values", array), ("stimuli", names), ("title", title)):
            object.__setattr__(self, name, value)

    @property
    def matrix(self) -> Floats:
        """Symmetric matrix [K, K] with a zero diagonal."""
        return square(self.values)

    def between(self, one: str, other: str) -> float:
        """Return the dissimilarity of two stimuli.

        Raises:
            UsageError: a name is not among the stimuli.
        """
        check_each("stimulus of this RDM", (one, other), self.stimuli)
        return float(self.matrix[self.stimuli.index(one), self.stimuli.index(other)])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype, copy=copy)

    def __len__(self) -> int:
        return len(self.values)

    def _repr_html_(self) -> str:
        """Draw the matrix as an inline SVG: dark is unlike, grey is missing."""
        count = len(self.stimuli)
        if count > _LARGEST_DRAWN:
            return f"<p>{escape(self.title or 'RDM')}: {count} stimuli, {len(self):,} pairs</p>"
        named = count <= _LARGEST_LABELLED
        margin = 10 + 7.0 * max(map(len, self.stimuli)) if named else 4.0
        cell, top = _SIDE / count, 26.0 if self.title else 6.0
        finite = self.values[np.isfinite(self.values)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        parts = [
            f'<text x="{margin:.1f}" y="16" font-weight="600">{escape(self.title)}</text>' if self.title else "",
            *self._cells(margin, top, cell, low, high, named=named),
        ]
        width, height = margin + _SIDE + 110, top + _SIDE + (margin if named else 8)
        parts += _scale(margin + _SIDE + 18, top, low, high)
        label = f"{self.title or 'RDM'} of {count} stimuli, from {low:.3g} to {high:.3g}"
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="{escape(label)}" width="{width:.0f}" '
            f'height="{height:.0f}" viewBox="0 0 {width:.0f} {height:.0f}" font-family="system-ui, sans-serif" '
            f'font-size="11" fill="currentColor">{"".join(parts)}</svg>'
        )

    def _cells(self, left: float, top: float, cell: float, low: float, high: float, *, named: bool) -> list[str]:
        parts, matrix = [], self.matrix
        # Two figures of the largest difference tell values apart; more do not fit in a cell.
        digits = min(max(1 - math.floor(math.log10(high - low)), 0), 4) if high > low else 2
        for row, name in enumerate(map(escape, self.stimuli)):
            y = top + row * cell
            for column, other in enumerate(map(escape, self.stimuli)):
                if row == column:
                    continue
                value, x = float(matrix[row, column]), left + column * cell
                colour, ink = _colour(value, low, high)
                parts.append(
                    f'<rect x="{x:.1f}" y="{y:.1f}" width="{cell:.2f}" height="{cell:.2f}" fill="{colour}">'
                    f"<title>{name} – {other}: {value:.3g}</title></rect>"
                )
                if named and cell >= 26 and math.isfinite(value):
                    how = f'text-anchor="middle" fill="{ink}" pointer-events="none"'
                    parts.append(_text(x + cell / 2, y + cell / 2 + 4, f"{value:.{digits}f}", how))
            if named:
                middle = row * cell + cell / 2
                below = f"{left + middle + 4:.1f},{top + _SIDE + 6:.1f}"
                parts.append(_text(left - 6, top + middle + 4, name, 'text-anchor="end"'))
                parts.append(f'<text transform="translate({below}) rotate(-90)" text-anchor="end">{name}</text>')
        return parts


def _text(x: float, y: float, text: str, how: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}"{how and " " + how}>{text}</text>'


def _colour(value: float, low: float, high: float) -> tuple[str, str]:
    """Return the colour of a value and that of ink on it."""
    if not math.isfinite(value):
        return _MISSING, "#333"
    share = (value - low) / (high - low) if high > low else 0.5
    red, green, blue = (_LIGHT + share * (_DARK - _LIGHT)).round().astype(int).tolist()
    return f"rgb({red},{green},{blue})", "#fff" if share > 0.65 else "#123"


def _scale(x: float, top: float, low: float, high: float) -> list[str]:
    """Draw the colours beside their values."""
    steps, parts = 24, []
    for step in range(steps):
        colour, _ = _colour(step / (steps - 1), 0.0, 1.0)
        y = top + _SIDE * (1 - (step + 1) / steps)
        parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="12" height="{_SIDE / steps + 0.5:.2f}" fill="{colour}"/>')
    return [*parts, _text(x + 18, top + 10, f"{high:.3g}"), _text(x + 18, top + _SIDE, f"{low:.3g}")]
