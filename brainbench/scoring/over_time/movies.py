"""RDMs of layers and of animals in every bin of time.

Letters: K stimulus, T time bin, F feature, U unit, P = K(K−1)/2 RDM pair.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.rdms.pairs import Floats
from brainbench.metrics.reliability.subject_rdm import subject_rdm

SPLITS = 100  # random split halves of an animal in each bin
_METHOD: dict[str, Any] = {
    "method": "crossnobis", "comparison": "whitened-cosine", "noise": "none", "splits": SPLITS,
}  # fmt: skip
_PARTLY = 0.5  # a last bin of which less than this share lies inside the stimulus is left out


@dataclass(frozen=True)
class AnimalMovie:
    """An animal's RDM in every bin of time, with its reliability there."""

    subject: str
    rdms: Floats = field(repr=False)
    """[T, P]; NaN in bins that have no RDM."""
    reliability: Floats
    """[T] Spearman-Brown reliability of the bin's RDM; NaN where it has none."""
    problems: tuple[str | None, ...] = ()
    """[T] reason for having no RDM in a bin; None elsewhere."""


def animal_movie(subject: str, blocks: Sequence[Trials], n_stimuli: int, **options: Any) -> AnimalMovie:
    """Return an animal's RDM and reliability in every bin, from responses [R, T, U] of its sessions.

    All bins split the same trials into the same halves, so differences between bins are not those of the splits.
    ``options`` are those of :func:`~brainbench.metrics.reliability.subject_rdm.subject_rdm`. The default method is the
    squared Euclidean distance without the share of trial noise, which would look like geometry before any response.
    """
    shapes = [np.shape(block.responses) for block in blocks]
    if not shapes or any(len(shape) != 3 for shape in shapes) or len({shape[1] for shape in shapes}) > 1:
        raise UsageError(
            f"Scores over time need responses [trials, time, units] of equal time in all sessions; {subject!r} has "
            f"shapes {shapes}."
        )
    how = {**_METHOD, **options}
    subjects = []
    for bin in range(shapes[0][1]):
        parts = [replace(block, responses=np.asarray(block.responses)[:, bin]) for block in blocks]
        subjects.append(subject_rdm(subject, parts, n_stimuli, **how))
    usable = np.array([item.problem is None for item in subjects])
    rdms = np.where(usable[:, None], np.stack([item.rdm for item in subjects]), np.nan)
    reliability = np.where(usable, [item.reliability for item in subjects], np.nan)
    return AnimalMovie(subject, rdms, reliability, tuple(item.problem for item in subjects))


def layer_movie(values: ArrayLike, step: float, width: float, *, method: str = "sqeuclidean") -> Floats:
    """Return a layer's RDMs [T, P] in bins of ``width`` seconds, from activations [K, T, F] every ``step`` seconds.

    A layer without time ([K, 1, F]) gives one RDM, which stands for all times.
    """
    array = np.asarray(values)
    bins = array if array.ndim == 3 and array.shape[1] == 1 else in_bins(array, step, width)
    return np.stack([rdm(bins[:, index], method=method) for index in range(bins.shape[1])])


def in_bins(values: ArrayLike, step: float, width: float) -> Floats:
    """Average activations [K, T, F], each lasting ``step`` seconds, over bins [K, T', F] of ``width`` seconds.

    An activation counts in a bin for as long as it lasts there.

    >>> in_bins([[[0.0], [1.0], [2.0], [3.0]]], 0.5, 1.0).ravel().tolist()
    [0.5, 2.5]
    """
    array = np.asarray(values)
    if array.ndim != 3 or not (step > 0 and width > 0):
        raise UsageError(
            "Bins of time need activations [stimuli, time, features] and positive times; received shape "
            f"{array.shape}, a step of {step} s and bins of {width} s."
        )
    steps = array.shape[1]
    count = max(1, math.floor(steps * step / width + 1 - _PARTLY))
    begins, starts = np.arange(count)[:, None] * width, np.arange(steps) * step
    shared = np.minimum(begins + width, starts + step) - np.maximum(begins, starts)
    # Rounding leaves steps that only touch a bin a tiny share of it.
    weights = np.where(shared > 1e-9 * width, shared, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.einsum("bt,ktf->kbf", weights, array.astype(np.float64))
