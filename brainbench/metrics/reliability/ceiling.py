"""Noise ceiling: how well the best possible model could compare with these animals (Nili 2014)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.metrics.rdms.comparison import check_comparison, compare, pooling
from brainbench.metrics.rdms.pairs import rdm_stack


class NoiseCeiling(NamedTuple):
    """Bounds on the mean raw comparison of a perfect model; unpacks as ``lower, upper``."""

    lower: float
    """Mean comparison of each animal with the pool of the others."""
    upper: float
    """Mean comparison of each animal with the pool of all, itself included."""

    @property
    def reason(self) -> str:
        """Reason for bounds that are NaN; empty when they are not."""
        if math.isfinite(self.lower) and math.isfinite(self.upper):
            return ""
        return "a noise ceiling needs at least two animals whose RDMs share pairs that differ"


def noise_ceiling(rdms: ArrayLike, *, method: str = "pearson") -> NoiseCeiling:
    """Return the leave-one-out lower and all-mean upper noise ceiling of animals' RDMs [A, P].

    RDMs are pooled as suits the comparison (standardised, unit length or ranks). Pairs that are NaN in
    any animal are left out for all. One animal has no ceiling: both bounds are NaN.
    """
    check_comparison(method)
    animals = rdm_stack(rdms, "rdms")
    if animals.ndim != 2:
        raise UsageError(f"A noise ceiling takes the RDMs of all animals [A, P]; received shape {animals.shape}.")
    shared = np.isfinite(animals).all(axis=0)
    if len(animals) < 2 or not shared.any():
        return NoiseCeiling(math.nan, math.nan)
    parts = np.full(animals.shape, np.nan)
    parts[:, shared] = pooling(method)(animals[:, shared])
    # Nili et al. 2014: each animal against the mean of the others (lower bound), and of all with itself (upper bound).
    # The mean of unit vectors has the largest mean cosine with them; for rank correlations this is approximate.
    total = parts.sum(axis=0)
    others = (total - parts) / (len(animals) - 1)
    comparable = np.where(shared, animals, np.nan)
    lower = compare(comparable, others, method=method).mean()
    upper = compare(comparable, total / len(animals), method=method).mean()
    return NoiseCeiling(float(lower), float(upper))
