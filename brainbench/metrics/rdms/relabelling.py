"""Comparisons of relabelled RDMs.

Ranks, means and lengths of an RDM do not feel the order of its stimuli, so what most comparisons multiply
is made once and every order only moves it: one gather and one matrix product, on the processor or on a
torch device. Kendall's tau, whose vectors are of pairs of pairs, is compared order by order by numpy.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from brainbench.metrics.arrays import Array, fetch, is_tensor, library, place
from brainbench.metrics.rdms.comparison import compare_all, features
from brainbench.metrics.rdms.pairs import Floats, Ints, permuted_pairs, stimulus_count

_OF_PAIRS = ("pearson", "spearman", "rho-a", "cosine")
_OF_MATRICES = ("whitened-cosine", "whitened-pearson")


def relabelled_comparisons(
    layers: Floats, brain: Floats, chunks: Iterator[Ints], method: str, *, device: Any = None
) -> Iterator[Floats]:
    """Yield comparisons [N, L, A] of layers [L, P], with their stimuli in each order of a chunk [N, K], with animals.

    Args:
        layers: RDMs that are relabelled.
        brain: RDMs [A, P].
        chunks: Orders of the stimuli.
        method: Comparison.
        device: Torch device for the products, None for numpy.
    """
    complete = bool(np.isfinite(layers).all() and np.isfinite(brain).all())
    if not complete or method not in (*_OF_PAIRS, *_OF_MATRICES):
        for orders in chunks:
            relabelled = layers[:, permuted_pairs(orders)].swapaxes(0, 1).reshape(-1, layers.shape[-1])
            yield compare_all(relabelled, brain, method=method).reshape(len(orders), len(layers), len(brain))
        return
    count = stimulus_count(layers.shape[-1])
    left, right = place(features(layers, method), device), place(features(brain, method), device).T
    move = _Places(count, left) if method in _OF_PAIRS else _MatrixPlaces(count, left)
    for orders in chunks:
        yield fetch((left[:, move(orders)] @ right).swapaxes(0, 1))


class _Places:
    """Where the entries of an RDM vector come from under orders [N, K]: indices [N, P]."""

    def __init__(self, count: int, like: Array) -> None:
        rows, cols = np.triu_indices(count, k=1)
        table = np.zeros((count, count), dtype=np.int64)
        table[rows, cols] = table[cols, rows] = np.arange(len(rows))
        self.like = like
        self.rows, self.cols, self.table = (_beside(part, like) for part in (rows, cols, table))

    def __call__(self, orders: Ints) -> Array:
        found = _beside(orders, self.like)
        return self.table[found[:, self.rows], found[:, self.cols]]


class _MatrixPlaces:
    """The same for the entries of a square matrix read row by row: indices [N, K²]."""

    def __init__(self, count: int, like: Array) -> None:
        self.count, self.like = count, like

    def __call__(self, orders: Ints) -> Array:
        found = _beside(orders, self.like)
        return (found[:, :, None] * self.count + found[:, None, :]).reshape(len(found), -1)


def _beside(indices: Ints, like: Array) -> Array:
    """Return indices as what ``like`` is and where it lies."""
    return library(like).from_numpy(np.array(indices)).to(like.device) if is_tensor(like) else indices
