"""Decoding of a property of stimuli (shape, distance) from responses to stimuli never seen in training.

Logistic regression with an L2 penalty, trained with one stimulus left out and tested on it (table 3.6 of
the work this grew from). With two stimuli per class left, chance is not the share of the largest class:
leaving a stimulus out makes its class rarer in training, so accuracies well *below* chance are what a
decoder without information gives. The permutation of classes over stimuli accounts for that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.metrics.inference.permutation import label_orders, most_exact, tail_p
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.stimulus_labels import response_matrix

ORDERS = 199
"""Random orders of the classes over stimuli that the test takes, where all are more than five times as many."""


@dataclass(frozen=True)
class Decoding:
    """Accuracy of decoding a property of stimuli left out."""

    accuracy: float
    """Mean over left-out stimuli of the share of rows decoded rightly."""
    chance: float
    """One over the number of classes, as published."""
    p: float
    """P(accuracy with the classes in another order over stimuli ≥ observed)."""
    expected: float
    """Mean accuracy over those orders: what no information gives."""
    correct: tuple[float, ...]
    """Share of each stimulus' rows decoded rightly, in order of the stimuli."""
    count: int
    """Orders that were tried, the given one included."""


def decode(
    responses: ArrayLike, stimuli: ArrayLike, classes: Sequence[str], *, penalty: float = 1.0, seed: int = 0
) -> Decoding:
    """Decode a property from activations or trials, leaving one stimulus out.

    Args:
        responses: [R, U] one row per trial, or [K, F] one per stimulus.
        stimuli: [R] stimulus of each row, 0 … K−1.
        classes: [K] class of each stimulus, such as ``["convex", "convex", "concave", …]``.
        penalty: Inverse strength C of the penalty, on features scaled to unit mean square.
        seed: Seed of random orders of the classes, above 6 stimuli.

    >>> decode([[0.], [1], [2], [10], [11], [12]], range(6), list("aaabbb")).accuracy
    1.0
    """
    matrix = response_matrix(responses, "trials").astype(np.float64)
    rows = np.asarray(stimuli, dtype=np.int64)
    names, codes = np.unique(np.asarray(classes, dtype=str), return_inverse=True)
    if rows.shape != (len(matrix),) or sorted(set(rows.tolist())) != list(range(len(codes))):
        raise UsageError(
            f"decode() takes one stimulus 0 … {len(codes) - 1} per row, each at least once; received {len(rows)} for "
            f"{len(matrix)} rows."
        )
    if len(names) < 2 or np.bincount(codes).min() < 2:
        raise UsageError(f"Each of at least 2 classes needs 2 stimuli or more: leaving one out loses it: {classes}.")
    if not np.isfinite(matrix).all():
        raise UsageError("Responses to be decoded must be finite; leave out units or trials with missing values.")
    check_number("The penalty of decoding", penalty, above=0)
    decoder = Decoder(matrix, rows, penalty=penalty)
    orders = np.concatenate(list(label_orders(len(codes), seed, exact=most_exact(ORDERS), draws=ORDERS)))
    accuracy = np.array([decoder(codes[order]) for order in orders])
    means = accuracy.mean(axis=1)
    return Decoding(
        accuracy=float(means[0]),
        chance=1 / len(names),
        p=float(tail_p(means)),
        expected=float(means.mean()),
        correct=tuple(accuracy[0].tolist()),
        count=len(orders),
    )


class Decoder:
    """Decodes any assignment of classes to the stimuli of the same rows.

    Names of classes do not matter, so each partition of the stimuli is decoded once. ``matrix`` has one row of finite
    responses each, ``rows`` their stimuli, numbered from 0, each at least once.
    """

    def __init__(self, matrix: Floats, rows: Ints, *, penalty: float = 1.0) -> None:
        self._rows, self._penalty = rows, penalty
        self._folds = [_fold(matrix, rows, stimulus) for stimulus in range(int(rows.max()) + 1)]
        self._known: dict[tuple[int, ...], list[float]] = {}

    def __call__(self, codes: Ints) -> list[float]:
        """Return the share of each stimulus' rows decoded rightly [K], with classes ``codes`` [K]."""
        seen: dict[int, int] = {}
        partition = tuple(seen.setdefault(code, len(seen)) for code in codes.tolist())
        if partition not in self._known:
            self._known[partition] = [_correct(fold, codes, self._rows, self._penalty) for fold in self._folds]
        return self._known[partition]


@dataclass(frozen=True)
class _Fold:
    stimulus: int
    train: Floats
    """[R′, D] rows in the span of the training rows, which is all that a penalised fit can use."""
    test: Floats


def _fold(matrix: Floats, rows: Ints, stimulus: int) -> _Fold:
    inside = rows != stimulus
    train, test = matrix[inside], matrix[~inside]
    mean = train.mean(axis=0)
    # The left-out stimulus takes no part in mean and scale, or the test would leak into the training.
    train, test = train - mean, test - mean
    # One scale for all features makes the penalty independent of units and keeps the features' proportions.
    scale = math.sqrt(float((train**2).mean())) or 1.0
    if train.shape[1] > len(train):
        # Coordinates in the span of the training rows: a penalised fit gives no weight to what is orthogonal to them.
        basis = np.linalg.svd(train, full_matrices=False)[2]
        train, test = train @ basis.T, test @ basis.T
    return _Fold(stimulus, train / scale, test / scale)


def _correct(fold: _Fold, codes: Ints, rows: Ints, penalty: float) -> float:
    target = codes[rows[rows != fold.stimulus]]
    weight, bias = fit_softmax(fold.train, target, int(codes.max()) + 1, penalty)
    return float((np.argmax(fold.test @ weight + bias, axis=1) == codes[fold.stimulus]).mean())


def fit_softmax(features: Floats, target: Ints, classes: int, penalty: float) -> tuple[Floats, Floats]:
    """Return weights [D, C] and biases [C] of multinomial logistic regression, Σ loss + ‖w‖²/2C, bias free."""
    from scipy.optimize import minimize
    from scipy.special import log_softmax

    width = features.shape[1]
    wanted = np.eye(classes, dtype=bool)[target]

    def loss(flat: Floats) -> tuple[float, Floats]:
        both = flat.reshape(width + 1, classes)
        weight, bias = both[:-1], both[-1]
        log_p = log_softmax(features @ weight + bias, axis=1)
        # Gradient Xᵀ(softmax − wanted) + w/C; the logarithm of the softmax stays finite for large scores.
        rest = np.exp(log_p) - wanted
        value = float(-log_p[wanted].sum() + (weight**2).sum() / (2 * penalty))
        gradient = np.concatenate([features.T @ rest + weight / penalty, rest.sum(axis=0, keepdims=True)])
        return value, gradient.ravel()

    found = minimize(loss, np.zeros((width + 1) * classes), jac=True, method="L-BFGS-B").x.reshape(width + 1, classes)
    return found[:-1], found[-1]
