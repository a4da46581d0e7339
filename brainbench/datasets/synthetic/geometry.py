"""The geometry that synthetic neurons share: one direction per stimulus, from features or from an RDM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, UsageError


@dataclass(frozen=True)
class ResponseGeometry:
    """Directions of K stimuli in tuning space; their angles are the truth of synthetic recordings."""

    directions: NDArray[np.float64]
    """[K, D] unit vectors."""
    labels: tuple[str, ...]
    """[K] names of the stimuli."""
    distortion: float = 0.0
    """Largest difference between the RDM asked for and the one that unit vectors can have."""

    @classmethod
    def from_features(cls, features: ArrayLike, labels: Sequence[str] | None = None) -> ResponseGeometry:
        """Take the correlations between the rows of features [K, F], such as a model's activations.

        The truth is then 1 − Pearson between rows, the model's own correlation-distance RDM.

        Raises:
            UsageError: the features are not [K, F] with K ≥ 2 and F ≥ 2, or labels do not fit.
            DataError: a value is not finite or a row is constant and has no direction.
        """
        values = np.asarray(features, dtype=np.float64)
        if values.ndim != 2 or len(values) < 2 or values.shape[1] < 2:
            raise UsageError(f"Features are [stimulus, feature], at least 2 × 2; received shape {values.shape}.")
        if not np.isfinite(values).all():
            raise DataError(f"{int((~np.isfinite(values)).sum())} feature values are not finite.")
        centred = values - values.mean(axis=1, keepdims=True)
        norms = np.linalg.norm(centred, axis=1)
        if np.any(norms <= 1e-12 * np.maximum(np.abs(values).max(axis=1), 1e-300)):
            raise DataError(f"The features of stimulus {int(np.argmin(norms))} are constant, so it has no direction.")
        directions = centred / norms[:, None]
        if directions.shape[1] > len(directions):
            # K vectors span at most K dimensions; a rotation into them keeps every angle.
            directions = np.asarray(np.linalg.qr(directions.T, mode="r")).T
        return cls(directions, _labels(labels, len(directions)))

    @classmethod
    def from_rdm(cls, rdm: ArrayLike, labels: Sequence[str] | None = None) -> ResponseGeometry:
        """Embed a correlation-distance RDM, an upper triangle [P] with values from 0 to 2.

        Distances that no set of unit vectors has are replaced by the nearest ones in the sense of
        dropped negative eigenvalues; ``distortion`` says by how much.

        Raises:
            UsageError: the length is no number of pairs, or a distance is outside 0 to 2.
        """
        distances = np.asarray(rdm, dtype=np.float64)
        stimuli = round((1 + np.sqrt(1 + 8 * distances.size)) / 2)
        if distances.ndim != 1 or stimuli < 2 or stimuli * (stimuli - 1) // 2 != distances.size:
            raise UsageError(f"An RDM is an upper triangle [K(K-1)/2]; received shape {distances.shape}.")
        if not (np.isfinite(distances).all() and distances.min() >= 0 and distances.max() <= 2):
            raise UsageError(
                f"Correlation distances lie between 0 and 2; received {distances.min():g} to {distances.max():g}. "
                f"Rescale other distances, or pass features."
            )
        pairs = np.triu_indices(stimuli, 1)
        products = np.eye(stimuli)
        products[pairs] = products.T[pairs] = 1.0 - distances
        # Unit vectors with inner products 1 − d, from the eigenvectors of that matrix; negative eigenvalues belong to
        # no vectors and are dropped, after which lengths are made one again.
        values, vectors = np.linalg.eigh(products)
        kept = values > 1e-12 * values[-1]
        directions = vectors[:, kept] * np.sqrt(values[kept])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        made = cls(directions, _labels(labels, stimuli))
        return cls(directions, made.labels, float(np.abs(made.rdm - distances).max()))

    @property
    def rdm(self) -> NDArray[np.float64]:
        """The truth [P]: one minus the cosine between directions."""
        pairs = np.triu_indices(len(self.directions), 1)
        return 1.0 - (self.directions @ self.directions.T)[pairs]


def _labels(labels: Sequence[str] | None, stimuli: int) -> tuple[str, ...]:
    if labels is None:
        return tuple(f"s{index + 1}" for index in range(stimuli))
    if len(labels) != stimuli or len(set(labels)) != stimuli:
        raise UsageError(f"{stimuli} stimuli need as many different labels; received {len(set(labels))}.")
    return tuple(str(label) for label in labels)
