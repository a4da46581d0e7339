"""The geometry that synthetic neurons share: one direction per stimulus, from features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, UsageError


@dataclass(frozen=True)
class ResponseGeometry:
    """Directions of K stimuli in tuning space; the distances between them are the truth of synthetic recordings."""

    directions: NDArray[np.float64]
    """[K, D] on their principal axes, D < K or so; the mean of their squared lengths is one."""
    labels: tuple[str, ...]
    """[K] names of the stimuli."""

    @classmethod
    def from_features(cls, features: ArrayLike, labels: Sequence[str] | None = None) -> ResponseGeometry:
        """Take the correlations between the rows of features [K, F], such as a model's activations.

        The truth is then 1 − Pearson between rows, the model's own correlation-distance RDM.
        """
        values = _checked(features, 2)
        # Inner products of centred rows of length one are Pearson correlations (r), so the RDM below is 1 − r.
        centred = values - values.mean(axis=1, keepdims=True)
        norms = np.linalg.norm(centred, axis=1)
        if np.any(norms <= 1e-12 * np.maximum(np.abs(values).max(axis=1), 1e-300)):
            raise DataError(f"The features of stimulus {int(np.argmin(norms))} are constant, so it has no direction.")
        return cls(principal_axes(centred / norms[:, None]), _labels(labels, len(values)))

    @classmethod
    def from_activations(cls, features: ArrayLike, labels: Sequence[str] | None = None) -> ResponseGeometry:
        """Take the Euclidean distances between stimuli over features [K, F], each standardised over the stimuli.

        Constant features are left out. Unlike :meth:`from_features`, stimuli may be near to the mean response. Raises
        UsageError: the features are not [K, F] with K ≥ 2, or labels do not fit; DataError: a value is not finite, or
        every feature is constant.
        """
        values = _checked(features, 1)
        spread = values.std(axis=0)
        varied = spread > 1e-9 * np.maximum(np.abs(values).max(axis=0), 1e-300)
        if not varied.any():
            raise DataError("Every feature is the same for all stimuli, so there is nothing for neurons to encode.")
        standard = (values[:, varied] - values[:, varied].mean(axis=0)) / spread[varied]
        # Each standardised feature has a mean square of one over stimuli, so /√F makes the mean squared length one.
        return cls(principal_axes(standard / np.sqrt(standard.shape[1])), _labels(labels, len(values)))

    @property
    def rdm(self) -> NDArray[np.float64]:
        """The truth [P]: half the squared distance between directions, for unit vectors one minus their cosine."""
        rows, columns = np.triu_indices(len(self.directions), 1)
        return 0.5 * np.sum((self.directions[rows] - self.directions[columns]) ** 2, axis=1)


def _checked(features: ArrayLike, width: int) -> NDArray[np.float64]:
    """Return features [K, F] as finite numbers, K ≥ 2 and F ≥ width."""
    given = np.asarray(features)
    if given.dtype.kind not in "biuf":
        raise UsageError(f"Features are real numbers; received {given.dtype}.")
    values = given.astype(np.float64)
    if values.ndim != 2 or len(values) < 2 or values.shape[1] < width:
        raise UsageError(f"Features are [stimulus, feature], at least 2 × {width}; received shape {values.shape}.")
    if not np.isfinite(values).all():
        raise DataError(f"{int((~np.isfinite(values)).sum())} feature values are not finite.")
    return values


def principal_axes(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate K vectors [K, F] into the at most K axes that they span; every angle and length stays."""
    # X = U S Vᵀ: the rows of U S have the same inner products as those of X, and no more axes than its rank.
    left, values, _ = np.linalg.svd(vectors, full_matrices=False)
    kept = values > 1e-9 * values[0]
    # A singular vector's sign is the machine's choice; the largest entry is made positive.
    signs = np.sign(left[np.abs(left).argmax(axis=0), np.arange(left.shape[1])])
    return (left * signs * values)[:, kept]


def _labels(labels: Sequence[str] | None, stimuli: int) -> tuple[str, ...]:
    if labels is None:
        return tuple(f"s{index + 1}" for index in range(stimuli))
    if len(labels) != stimuli or len(set(labels)) != stimuli:
        raise UsageError(f"{stimuli} stimuli need as many different labels; received {len(set(labels))}.")
    return tuple(str(label) for label in labels)
