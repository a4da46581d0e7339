"""RDMs with names, their stimulus pairs, and comparisons over layers, permutations and animals at once.

Pair p of K stimuli is the p-th entry of the upper triangle read row by row: (0, 1), (0, 2) … (0, K−1), (1, 2) … so
P = K(K−1)/2.

Every method is an inner product of two transformed vectors, so many comparisons are one matrix
product. Definitions equal scipy's and rsatoolbox 0.3.2's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_each, check_name, check_once
from brainbench.metrics.arrays import Floats, Ints, fetch, is_tensor, library, place

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
        for row, values in enumerate(self.matrix):
            cells = [
                _cell(float(value), low, high, f"{names[row]} – {name}", max(_SIDE // count, 3))
                for value, name in zip(values, names, strict=True)
            ]
            cells[row] = "<td></td>"
            rows.append(f"<tr><th>{heads[row]}</th>{''.join(cells)}</tr>")
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


Transform = Callable[[Floats], Floats]

_CONSTANT = 64 * np.finfo(np.float64).eps
"""An RDM whose spread is below this share of its size is constant up to rounding."""

_OF_PAIRS = ("pearson", "spearman", "rho-a", "cosine")
"""Comparisons of vectors of pairs; those of whitened vectors compare whole matrices."""
_OF_MATRICES = ("whitened-cosine", "whitened-pearson")

_FEW_STIMULI, _BLOCK_ELEMENTS = 64, 1 << 24
"""Up to so many stimuli all orders of a chunk are compared at once; numbers of layers' matrices that are held."""
_ORDERS, _ROWS = 64, 4  # orders, and rows of matrices, that are moved at once

_SIGN_LIMIT = 128  # above this many pairs Kendall's tau sorts (P log P) instead of comparing all pairs of pairs (P²)


def compare(a: ArrayLike, b: ArrayLike, *, method: str = "pearson") -> Floats:
    """Compare RDMs ``a`` [..., P] with ``b`` [..., P]; leading axes broadcast as in numpy.

    Pairs that are NaN in either RDM are left out of that comparison. A comparison without a value (an RDM constant over
    the pairs that are left, fewer than 2 pairs) is NaN, except that ``rho-a`` and ``tau-a`` of a constant RDM are 0 by
    definition and the cosines need only a non-zero RDM. Nothing is clipped: rounding may give 1 + 2e-16.

    Args:
        a: RDMs, upper triangles.
        b: RDMs of the same stimuli in the same order.
        method: ``pearson``; ``spearman``; ``rho-a`` (Spearman, expected over random breaking of ties);
            ``tau-a``, ``tau-b`` (Kendall); ``cosine``; ``whitened-cosine``, ``whitened-pearson``
            (Diedrichsen 2021: weighted by the covariance of distances that share a stimulus).

    Returns:
        [...], float64; a scalar array for two vectors.

    >>> round(float(compare([1, 2, 4], [2, 4, 8])), 6)
    1.0
    >>> layers, animals = [[1, 2, 3], [3, 2, 1]], [[1, 3, 4], [2, 3, 5], [4, 2, 1]]
    >>> compare([[layer] for layer in layers], animals, method="spearman").round(6).tolist()
    [[1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]
    """
    check_comparison(method)
    left, right = rdm_stack(a, "a"), rdm_stack(b, "b")
    if left.shape[-1] != right.shape[-1]:
        raise UsageError(
            f"RDMs of {stimulus_count(left.shape[-1])} and {stimulus_count(right.shape[-1])} stimuli cannot be "
            "compared; give both for the same stimuli."
        )
    try:
        shape = np.broadcast_shapes(left.shape, right.shape)
    except ValueError as error:
        raise UsageError(f"RDMs of shapes {left.shape} and {right.shape} do not broadcast.") from error
    if not (np.isfinite(left).all() and np.isfinite(right).all()):
        return _compare_present(np.broadcast_to(left, shape), np.broadcast_to(right, shape), method)
    return _compare_complete(left, right, method)


def compare_all(a: Floats, b: Floats, *, method: str = "pearson") -> Floats:
    """Compare every ``a`` [..., N, P] with every ``b`` [..., A, P] by one matrix product each: [..., N, A]."""
    sorts = a.shape[-1] > _SIGN_LIMIT and method in _BY_SORTING
    if sorts or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return compare(a[..., :, None, :], b[..., None, :, :], method=method)
    return features(a, method) @ features(b, method).swapaxes(-1, -2)


def permuted_comparisons(
    layers: Floats, brain: Floats, chunks: Iterator[Ints], method: str, *, device: Any = None
) -> Iterator[Floats]:
    """Yield comparisons [N, L, A] of layers [L, P], with their stimuli in each order of a chunk [N, K], with animals.

    Ranks, means and lengths of an RDM do not feel the order of its stimuli, so what most comparisons multiply is made
    once and every order only moves it: one gather and one matrix product, on the processor or on a torch device.
    Kendall's tau, whose vectors are of pairs of pairs, is compared order by order by numpy. Animals are RDMs [A, P];
    without a device numpy computes, many stimuli order by order and in blocks of layers.
    """
    complete = bool(np.isfinite(layers).all() and np.isfinite(brain).all())
    if not complete or method not in (*_OF_PAIRS, *_OF_MATRICES):
        for orders in chunks:
            permuted = layers[:, permuted_pairs(orders)].swapaxes(0, 1).reshape(-1, layers.shape[-1])
            yield compare_all(permuted, brain, method=method).reshape(len(orders), len(layers), len(brain))
        return
    count = stimulus_count(layers.shape[-1])
    if device is None and count > _FEW_STIMULI:
        yield from _permuted_squares(layers, brain, chunks, method)
        return
    left, right = place(features(layers, method), device), place(features(brain, method), device).T
    for orders in chunks:
        moved = library(left).from_numpy(np.array(orders)).to(left.device) if is_tensor(left) else orders
        if method in _OF_PAIRS:
            places = permuted_pairs(moved)
        else:
            # A square matrix read row by row: the entry (i, j) comes from (order[i], order[j]).
            places = (moved[:, :, None] * count + moved[:, None, :]).reshape(len(moved), -1)
        # Plain indexing leaves the pairs in a slow axis, where the product cannot use BLAS: 10 times slower.
        permuted = left[:, places] if is_tensor(left) else left.take(places, axis=1)
        yield fetch((permuted @ right).swapaxes(0, 1))


def _permuted_squares(layers: Floats, brain: Floats, chunks: Iterator[Ints], method: str) -> Iterator[Floats]:
    """Do what :func:`permuted_comparisons` does without more than a block of layers in memory."""
    count = stimulus_count(layers.shape[-1])
    size = max(1, _BLOCK_ELEMENTS // count**2)
    animals = squares(features(brain, method), method)
    blocks = [layers[start : start + size] for start in range(0, len(layers), size)]
    # What would not fit is made anew for each chunk of orders.
    first = squares(features(blocks[0], method), method)
    for orders in chunks:
        parts = []
        for index, block in enumerate(blocks):
            left = first if index == 0 else squares(features(block, method), method)
            # ⟨PMPᵀ, B⟩ = ⟨M, PᵀBP⟩: the side of fewer matrices is moved.
            if len(left) <= len(animals):
                parts.append(_moved_products(left, animals, orders).swapaxes(1, 2))
            else:
                parts.append(_moved_products(animals, left, np.argsort(orders, axis=1)))
        yield np.concatenate(parts, axis=1)


def _moved_products(matrices: Floats, fixed: Floats, orders: Ints) -> Floats:
    """Return the inner products [N, F, M] of symmetric matrices [M, K, K], whose rows and columns move to each order
    [N, K], with fixed ones [F, K, K]."""
    count, result = matrices.shape[-1], np.empty((len(orders), len(fixed), len(matrices)))
    rows, cols = np.triu_indices(count)
    # Of one triangle; what stands in both counts twice.
    triangles = fixed[:, rows, cols] * np.where(rows == cols, 1.0, 2.0)
    source = np.ascontiguousarray(matrices.reshape(len(matrices), -1).T)
    for start in range(0, len(orders), _ORDERS):
        columns = np.ascontiguousarray(orders[start : start + _ORDERS].T)
        size, place = columns.shape[1] * len(matrices), 0
        total = np.zeros((len(fixed), size))
        # Numbers of few rows are multiplied while they lie in the nearest memory.
        for first in range(0, count, _ROWS):
            some = range(first, min(first + _ROWS, count))
            index = np.concatenate([columns[row] * count + columns[row:] for row in some])
            total += triangles[:, place : place + len(index)] @ source.take(index, axis=0).reshape(-1, size)
            place += len(index)
        result[start : start + _ORDERS] = total.reshape(len(fixed), -1, len(matrices)).swapaxes(0, 1)
    return result


def squares(vectors: Floats, method: str) -> Floats:
    """Return matrices [..., K, K] with the inner products of a comparison's vectors, of pairs or of whole matrices."""
    if method in _OF_MATRICES:
        count = math.isqrt(vectors.shape[-1])
        return vectors.reshape(*vectors.shape[:-1], count, count)
    # Every pair stands in a matrix twice.
    return square(vectors) * math.sqrt(0.5)


def products(a: Floats, b: Floats, method: str) -> Floats:
    """Return the inner products [...] of RDMs [..., P] that a comparison divides by both lengths; of all but ranks."""
    return np.einsum("...p,...p->...", LINEAR[method](a), LINEAR[method](b))


def products_without(a: Floats, b: Floats, method: str) -> Floats:
    """Return the inner products [..., N, A, K] of every ``a`` [..., N, P] with every ``b`` [..., A, P] by one of
    :data:`WITHOUT`, without each stimulus in turn."""
    if method == "cosine":
        rows = _row_products(square(a), square(b))
        return rows.sum(axis=-1, keepdims=True) / 2 - rows
    left = squares(_second_moment(a), method)
    right = left if b is a else squares(_second_moment(b), method)
    rows = _row_products(left, right)
    diagonals = np.einsum("...nkk,...akk->...nak", left, right)
    # Rows of a centred matrix add up to 0, so those of what is left add up to −M_ik, and all of it to M_kk: centring
    # the rest anew takes no second pass.
    rest = rows.shape[-1] - 1
    total = rows.sum(axis=-1, keepdims=True)
    return total - 2 * rows + diagonals - 2 * (rows - diagonals) / rest + diagonals / rest**2


def _row_products(left: Floats, right: Floats) -> Floats:
    """Return the inner products [..., N, A, K] of the rows of symmetric matrices [..., N, K, K] and [..., A, K, K]."""
    if left.shape[-1] <= _FEW_STIMULI:
        return np.einsum("...nik,...aik->...nak", left, right)
    # Row by row one matrix product, which BLAS computes.
    return np.moveaxis(np.moveaxis(left, -2, -3) @ np.moveaxis(right, -2, -3).swapaxes(-1, -2), -3, -1)


def features(rdms: Floats, method: str) -> Floats:
    """Return vectors whose inner product is the comparison; NaN where it has no value."""
    return _METHODS[method][0](rdms)


def check_comparison(method: str) -> None:
    """Raise UsageError with the nearest name unless ``method`` is a comparison."""
    check_name("RDM comparison", method, _METHODS)


def pooling(method: str) -> Transform:
    """Return the transform [..., P] → [..., P] of RDMs before they are averaged to predict one another.

    Nili 2014: unit vectors for the cosines, standardised ones for the correlations (the whitened ones
    too, as in rsatoolbox), ranks for the rank correlations (approximate for Kendall's tau).
    """
    return _METHODS[method][1]


def _unit(vectors: Floats, size: Floats | None = None) -> Floats:
    length = np.sqrt(np.einsum("...p,...p->...", vectors, vectors))[..., None]
    floor = 0.0 if size is None else _CONSTANT * np.sqrt(np.einsum("...p,...p->...", size, size))[..., None]
    return vectors / np.where(length > floor, length, np.nan)


def _centred(vectors: Floats) -> Floats:
    return vectors - vectors.mean(axis=-1, keepdims=True)


def _ranks(vectors: Floats) -> Floats:
    from scipy.stats import rankdata

    return rankdata(vectors, axis=-1)


def _pearson(rdms: Floats) -> Floats:
    return _unit(_centred(rdms), rdms)


def _rho_a(rdms: Floats) -> Floats:
    count = rdms.shape[-1]
    if count < 2:
        return np.full(rdms.shape, np.nan)
    # Squared centred ranks without ties add up to (P³ − P)/12; with it ties count as their mean over random breaking.
    return _centred(_ranks(rdms)) * np.sqrt(12.0 / (count**3 - count))


def _signs(rdms: Floats) -> Floats:
    if rdms.shape[-1] < 2:
        return np.full((*rdms.shape[:-1], 1), np.nan)
    rows, cols = np.triu_indices(rdms.shape[-1], k=1)
    return np.sign(rdms[..., rows] - rdms[..., cols])


def _tau_a(rdms: Floats) -> Floats:
    count = rdms.shape[-1]
    # Kendall's τ-a: mean product of the signs of all differences between pairs; tied ones are zero.
    return _signs(rdms) / np.sqrt(count * (count - 1) / 2)


def _second_moment(rdms: Floats) -> Floats:
    """Return the doubly centred −½D, flattened: its inner product is dᵀV⁻¹d up to a constant."""
    # G = −½ H D H with the centring matrix H; so the covariance V [P, P] of distances is never formed.
    matrix = -0.5 * square(rdms)
    matrix -= matrix.mean(axis=-1, keepdims=True)
    matrix -= matrix.mean(axis=-2, keepdims=True)
    return matrix.reshape(*rdms.shape[:-1], -1)


LINEAR: dict[str, Transform] = {
    "pearson": _centred,
    "cosine": lambda rdms: rdms,
    "whitened-cosine": _second_moment,
    "whitened-pearson": lambda rdms: _second_moment(_centred(rdms)),
}
"""Comparisons that are products of linear functions of both RDMs, divided by their lengths."""

WITHOUT = ("cosine", "whitened-cosine")  # comparisons whose products without a stimulus follow from those of all

_METHODS: dict[str, tuple[Transform, Transform]] = {
    "pearson": (_pearson, _pearson),
    "spearman": (lambda rdms: _pearson(_ranks(rdms)), _ranks),
    "rho-a": (_rho_a, _ranks),
    "tau-a": (_tau_a, _ranks),
    # τ-b divides by the root of each side's untied differences, which is the length of its vector of signs.
    "tau-b": (lambda rdms: _unit(_signs(rdms)), _ranks),
    "cosine": (_unit, _unit),
    "whitened-cosine": (lambda rdms: _unit(_second_moment(rdms)), _unit),
    "whitened-pearson": (lambda rdms: _unit(_second_moment(_centred(rdms)), rdms), _pearson),
}
"""Comparison → what makes its vectors, and what RDMs pass through before they are averaged."""

COMPARISONS = tuple(_METHODS)  # names that `method` of compare takes


def _compare_complete(left: Floats, right: Floats, method: str) -> Floats:
    """Compare RDMs [..., P] that broadcast and lack no pair."""
    if method in _BY_SORTING and left.shape[-1] > _SIGN_LIMIT:
        shape = np.broadcast_shapes(left.shape, right.shape)
        a, b = (np.broadcast_to(rdms, shape).reshape(-1, shape[-1]) for rdms in (left, right))
        return np.array(list(map(_BY_SORTING[method], a, b))).reshape(shape[:-1])
    # The broadcast product of all comparisons and all pairs is never formed.
    return np.einsum("...p,...p->...", features(left, method), features(right, method))


def _compare_present(left: Floats, right: Floats, method: str) -> Floats:
    """Compare over the pairs present in both RDMs, together for all comparisons that lack the same pairs."""
    shape = left.shape[:-1]
    left, right = left.reshape(-1, left.shape[-1]), right.reshape(-1, right.shape[-1])
    present = np.isfinite(left) & np.isfinite(right)
    result = np.full(len(left), np.nan)
    patterns, member = np.unique(present, axis=0, return_inverse=True)
    for index, keep in enumerate(patterns):
        if not keep.any():
            continue
        rows = np.flatnonzero(member.ravel() == index)
        a, b = left[np.ix_(rows, np.flatnonzero(keep))], right[np.ix_(rows, np.flatnonzero(keep))]
        if method.startswith("whitened") and not keep.all():
            result[rows] = _whitened_present(a, b, keep, centre=method == "whitened-pearson")
        else:
            result[rows] = _compare_complete(a, b, method)
    return result.reshape(shape)


def _whitened_present(a: Floats, b: Floats, keep: np.ndarray, *, centre: bool) -> Floats:
    """Whiten with the covariance V of the pairs that are left (Diedrichsen 2021, eq. for Σ_K = I)."""
    from scipy.linalg import cho_factor, cho_solve

    rows, cols = np.triu_indices(stimulus_count(len(keep)), k=1)
    # A row has +1 and −1 at its pair's stimuli; V = C Cᵀ squared entry by entry, since noise of two distances is
    # correlated where they share a stimulus.
    contrast = np.zeros((int(keep.sum()), stimulus_count(len(keep))))
    contrast[np.arange(len(contrast)), rows[keep]] = 1.0
    contrast[np.arange(len(contrast)), cols[keep]] = -1.0
    factor = cho_factor((contrast @ contrast.T) ** 2)
    x, y = (_centred(a), _centred(b)) if centre else (a, b)
    solved_x, solved_y = cho_solve(factor, x.T).T, cho_solve(factor, y.T).T
    size = np.einsum("np,np->n", x, solved_x) * np.einsum("np,np->n", y, solved_y)
    floor = (_CONSTANT**2 * (a * a).sum(axis=1)) * (_CONSTANT**2 * (b * b).sum(axis=1))
    product = np.einsum("np,np->n", x, solved_y)
    return np.divide(product, np.sqrt(size), out=np.full(len(x), np.nan), where=size > floor)


def _sorted_tau_b(x: Floats, y: Floats) -> float:
    from scipy.stats import kendalltau

    return float(np.asarray(kendalltau(x, y))[0])


def _sorted_tau_a(x: Floats, y: Floats) -> float:
    # scipy's τ-b in P log P, times what it divides by: the root of each side's share of untied differences.
    pairs = len(x) * (len(x) - 1) // 2
    untied = [pairs - sum(n * (n - 1) // 2 for n in np.unique(v, return_counts=True)[1].tolist()) for v in (x, y)]
    return _sorted_tau_b(x, y) * float(np.sqrt(untied[0] / pairs) * np.sqrt(untied[1] / pairs)) if all(untied) else 0.0


_BY_SORTING: dict[str, Callable[[Floats, Floats], float]] = {"tau-a": _sorted_tau_a, "tau-b": _sorted_tau_b}
