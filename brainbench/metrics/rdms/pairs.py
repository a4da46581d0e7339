"""Stimulus pairs: the order of an RDM's upper triangle, what permuting stimuli does to it, and an RDM with names.

Pair p of K stimuli is the p-th entry of the upper triangle read row by row:
(0, 1), (0, 2) … (0, K−1), (1, 2) … so P = K(K−1)/2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, check_each, check_once
from brainbench.metrics.arrays import is_tensor, library

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
LARGEST = 1e150  # largest dissimilarity, whose square is still a number


def stimulus_count(pairs: int) -> int:
    """Return K for P = K(K−1)/2 pairs."""
    # Positive root of K² − K − 2P = 0, in integers, so that rounding accepts no wrong P.
    count = (1 + math.isqrt(1 + 8 * pairs)) // 2
    if pairs < 1 or count * (count - 1) // 2 != pairs:
        raise UsageError(
            f"An RDM vector has K(K−1)/2 entries (1, 3, 6, 10, 15 …); this one has {pairs}; "
            f"give the upper triangle without the diagonal."
        )
    return count


def upper(matrix: Any) -> Any:
    """Return the upper triangle [..., P] of square matrices [..., K, K], numpy arrays or tensors."""
    return matrix[..., *_pair_indices(matrix.shape[-1], matrix)]


def _pair_indices(count: int, like: Any) -> Any:
    """Return the rows [P] and columns [P] of all pairs, where and what ``like`` is."""
    if is_tensor(like):
        return library(like).triu_indices(count, count, offset=1, device=like.device).unbind()
    return _pairs(count)


@lru_cache(maxsize=4)
def _pairs(count: int) -> tuple[Ints, Ints]:
    return np.triu_indices(count, k=1)


def square(rdm: ArrayLike) -> Floats:
    """Return symmetric matrices [..., K, K] with a zero diagonal from upper triangles [..., P]."""
    vector = np.asarray(rdm, dtype=np.float64)
    count = stimulus_count(vector.shape[-1])
    matrix = vector.take(_pair_places(count), axis=-1)
    matrix[..., np.arange(count), np.arange(count)] = 0.0
    return matrix


@lru_cache(maxsize=4)
def _pair_places(count: int) -> Ints:
    """Return the place [K, K] of the pair {i, j} in an upper triangle; 0 on the diagonal, which has none."""
    rows, cols = np.triu_indices(count, k=1)
    table = np.zeros((count, count), dtype=np.int64)
    table[rows, cols] = table[cols, rows] = np.arange(len(rows))
    table.flags.writeable = False
    return table


def permuted_pairs(orders: Any, count: int | None = None) -> Any:
    """Return indices [N, P] such that ``rdm[indices[n]]`` is the RDM of stimuli in ``orders[n]`` [N, K].

    Orders may name some of ``count`` stimuli only.
    """
    size = orders.shape[-1]
    table: Any = _pair_places(size if count is None else count)
    if is_tensor(orders):
        table = library(orders).tensor(table, device=orders.device)
    rows, cols = _pair_indices(size, orders)
    # Pair (i, j) of the permuted RDM is the pair (order[i], order[j]) of the given one, which is one look-up.
    return table[orders[..., rows], orders[..., cols]]


def rdm_stack(rdms: ArrayLike | Sequence[ArrayLike], what: str) -> Floats:
    """Return float64 RDM vectors [..., P], checked."""
    try:
        array = np.asarray(rdms)
        if array.dtype.kind in "cSU":
            raise TypeError("dissimilarities are real numbers")
        array = array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{what} must be RDM vectors of one length; received {type(rdms).__name__}.") from error
    if array.ndim == 0:
        raise UsageError(f"{what} must be an RDM vector [P]; received a single number.")
    stimulus_count(array.shape[-1])
    # Comparisons with NaN are false: a missing pair passes, an infinite one must not be taken for one.
    if (np.abs(array) > LARGEST).any():
        raise UsageError(f"{what} must hold dissimilarities up to {LARGEST:g}, NaN where one is missing; larger came.")
    return array


_LARGEST_LABELLED = 24  # stimuli up to which names are written; above, the cells alone are drawn
_LARGEST_DRAWN = 120
_SIDE, _WIDE = 300, 26  # side of the matrix, and of the smallest cell that holds a number, in pixels
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

    def between(self, first: str, second: str) -> float:
        """Return the dissimilarity of two stimuli."""
        check_each("stimulus of this RDM", (first, second), self.stimuli)
        return float(self.matrix[self.stimuli.index(first), self.stimuli.index(second)])

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
                _cell(float(value), low, high, f"{names[place]} – {name}", max(_SIDE // count, 3))
                for value, name in zip(values, names, strict=True)
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
