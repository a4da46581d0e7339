"""An animal's responses without their noise, and animals simulated from them: how a perfect model would score.

The products of the mean responses hold the noise of the means on their diagonal, which trials tell. Without it, what
is left is the geometry of the noiseless responses, of which eigenvalues below zero are chance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brainbench.metrics.rdms.pairs import Floats
from brainbench.metrics.reliability.subject_rdm import SubjectRDM

SIMULATIONS = 20
"""Noisy copies of an animal over which what a perfect model attains is averaged."""


def denoised(patterns: Floats, noise: Floats) -> Floats:
    """Return patterns [K, U] whose products are those of the given ones without their noise.

    ``patterns`` [K, U] are mean responses, ``noise`` [K, U] the variance of these means.
    """
    mean = patterns.mean(axis=0)
    centred = patterns - mean
    own = np.diag(noise.sum(axis=1))
    # Both sides centred over stimuli: E[C Cᵀ] = G + H diag(n) H, with the centring matrix H.
    own = own - own.mean(axis=0)
    gram = centred @ centred.T - (own - own.mean(axis=1, keepdims=True))
    values, vectors = np.linalg.eigh(gram)
    kept = np.flatnonzero(values > 0)[::-1][: patterns.shape[1]]
    total = float(np.trace(gram))
    if not len(kept) or total <= 0:
        return np.broadcast_to(mean, patterns.shape)
    # Dropping what is negative leaves too much in all; the trace is unbiased.
    values = values[kept] * total / values[kept].sum()
    directions = centred.T @ vectors[:, kept] * np.sqrt(values)
    # The nearest orthonormal directions of units keep each unit's part as close to the data as the products allow.
    left, _, right = np.linalg.svd(directions, full_matrices=False)
    return mean + (vectors[:, kept] * np.sqrt(values)) @ (left @ right).T


def simulated_animals(animal: SubjectRDM, seed: int) -> tuple[Floats, list[SubjectRDM]]:
    """Return an animal's responses without noise [K, U], and copies of the animal with new noise on them."""
    # Sorted by their responses, units draw the same noise in whatever order they were listed; rounding makes no order.
    scale = np.abs(animal.patterns).max(initial=0.0) or 1.0
    units = np.lexsort(np.round(np.concatenate([animal.noise / scale**2, animal.patterns / scale]), 9))
    animal = replace(animal, patterns=animal.patterns[:, units], noise=animal.noise[:, units])
    truth = denoised(animal.patterns, animal.noise)
    generator = np.random.default_rng(seed)
    spread = np.sqrt(np.maximum(animal.noise, 0.0))
    drawn = (truth + spread * generator.standard_normal(truth.shape) for _ in range(SIMULATIONS))
    return truth, [replace(animal, patterns=patterns) for patterns in drawn]
