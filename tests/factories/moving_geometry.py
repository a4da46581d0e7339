"""Layers and animals whose geometry changes over time, with a known lag between them."""

from __future__ import annotations

import numpy as np

from brainbench.core.contracts import Trials
from brainbench.metrics import rdm
from brainbench.scoring.over_time import AnimalMovie

BIN = 0.05
DIMENSIONS = 4


def make_path(rng, stimuli, bins, *, memory=0.7):
    """Latent patterns [T, K, D] that change from bin to bin, correlated by ``memory`` with the bin before."""
    path = rng.normal(size=(bins + 20, stimuli, DIMENSIONS))
    for step in range(1, len(path)):
        path[step] = memory * path[step - 1] + np.sqrt(1 - memory**2) * path[step]
    return path[20:]


def lagged(path, lag, onset=0):
    """Return a path that follows ``lag`` bins behind; zero before ``onset`` and before the path begins."""
    moved = np.zeros_like(path)
    moved[lag:] = path[: len(path) - lag]
    moved[:onset] = 0
    return moved


def make_movie(rng, path, name="animal", *, units=30, noise=0.5, reliability=0.9):
    """An animal that follows a path, as RDMs with noise in every bin; where the path is zero there is only noise."""
    means = path @ rng.normal(size=(DIMENSIONS, units)) + noise * rng.normal(size=(*path.shape[:2], units))
    known = np.where(path.any(axis=(1, 2)), reliability, 0.1)
    return AnimalMovie(name, np.stack([rdm(mean, method="sqeuclidean") for mean in means]), known)


def make_layer(rng, path, features=40):
    """RDMs [T, P] of a layer that follows a path."""
    values = path @ rng.normal(size=(DIMENSIONS, features))
    return np.stack([rdm(value, method="sqeuclidean") for value in values])


def make_moving_session(rng, path, *, units=25, repeats=8, noise=2.0):
    """One session of trials [R, T, U] that follow a path."""
    labels = np.repeat(np.arange(path.shape[1]), repeats)
    means = (path @ rng.normal(size=(DIMENSIONS, units))).swapaxes(0, 1)
    responses = means[labels] + noise * rng.normal(size=(len(labels), len(path), units))
    return Trials(responses, labels, [str(row) for row in range(len(labels))])
