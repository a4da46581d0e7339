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
"""Stimuli up to which names are written; above, the cells alone are drawn."""
_LARGEST_DRAWN = 120
_SIDE, _WIDE = 300, 26
"""Side of the matrix, and of the smallest cell that holds a number, in pixels."""
_DARK, _LIGHT, _MISSING = np.array([14, 77, 84]), np.array([240, 246, 245]), np.array([214, 208, 196])


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
        """Name an RDM [P]; stimuli are numbered without names."""
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
        """Return the dissimilarity of two stimuli."""
        check_each("stimulus of this RDM", (one, other), self.stimuli)
        return float(self.matrix[self.stimuli.index(one), self.stimuli.index(other)])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype, copy=copy)

    def __len__(self) -> int:
        return len(self.values)

    def _repr_html_(self) -> str:
        """Show the matrix as a table: dark is unlike, grey is missing; small cells show their value under the mouse."""
        title, count = escape(self.title or "RDM"), len(self.stimuli)
        if count > _LARGEST_DRAWN:
            return f"<p>{title}: {count} stimuli, {len(self):,} pairs</p>"
        finite = self.values[np.isfinite(self.values)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        names = [escape(name) for name in self.stimuli]
        # Names of many stimuli do not fit beside cells of a few pixels.
        heads = names if count <= _LARGEST_LABELLED else [""] * count
        rows = []
        for place, values in enumerate(self.matrix):
            cells = [
                _cell(float(value), low, high, f"{names[place]} – {other}", max(_SIDE // count, 3))
                for value, other in zip(values, names, strict=True)
            ]
            cells[place] = "<td></td>"
            rows.append(f"<tr><th>{heads[place]}</th>{''.join(cells)}</tr>")
        top = "".join(f'<th style="writing-mode: vertical-rl">{head}</th>' for head in heads)
        caption = f"{title} of {count} stimuli, from {low:.3g} to {high:.3g}"
        return f"<table><caption>{caption}</caption><tr><th></th>{top}</tr>{''.join(rows)}</table>"


def _cell(value: float, low: float, high: float, pair: str, side: int) -> str:
    """Return the cell of a pair, coloured by where its value lies between the lowest and the highest."""
    share = (value - low) / (high - low) if high > low else 0.5
    number = f"{value:.2g}" if side >= _WIDE and math.isfinite(value) else ""
    ink = "white" if share > 0.65 else "black"
    red, green, blue = _LIGHT + share * (_DARK - _LIGHT) if math.isfinite(value) else _MISSING
    size = f"padding: 0; text-align: center; min-width: {side}px; height: {side}px"
    style = f"background: rgb({red:.0f},{green:.0f},{blue:.0f}); color: {ink}; {size}"
    return f'<td style="{style}" title="{pair}: {value:.3g}">{number}</td>'
