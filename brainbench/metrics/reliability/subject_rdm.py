"""One animal's RDM with what is needed to correct scores for its noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brainbench.core.records import Interval
from brainbench.core.trials import Trials
from brainbench.metrics.rdms.comparison import compare
from brainbench.metrics.rdms.pairs import Floats
from brainbench.metrics.reliability.split_half import DRAW_SPLITS, SPLITS, split_half


@dataclass(frozen=True)
class SubjectRDM:
    """An animal's RDM, ready to be compared with any number of models."""

    subject: str
    rdm: Floats = field(repr=False)
    """[P] RDM of all trials; NaN pairs when ``problem`` says why."""
    split_half_r: Floats = field(repr=False)
    """[S] raw comparisons (by ``comparison``) of the RDMs of random split halves."""
    halves: Floats = field(repr=False)
    """[S′, 2, P] RDMs of the halves."""
    units: int = 0
    """Neurons that entered."""
    trials: int = 0
    """Trials that entered."""
    method: str = "correlation"
    """Dissimilarity of two stimuli."""
    comparison: str = "pearson"
    """Comparison of two RDMs."""
    reliability: float = math.nan
    """Spearman-Brown reliability of the mean of ``split_half_r``."""
    spread: Interval | None = None
    """Percentiles over random splits; not a confidence interval."""
    seed: int = 0
    """Of splits and draws."""
    problem: str | None = None
    """Why the animal has no usable RDM, in words."""
    notes: tuple[str, ...] = ()
    """Sessions and units that were left out, in words."""
    draws: Floats = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    """[D, P] RDMs of bootstrap draws of the animal's sessions and trials; empty without any."""
    draws_r: Floats = field(default_factory=lambda: np.empty(0), repr=False)
    """[D] mean split-half comparison (by ``comparison``) within each draw."""

    def split_half_by(self, comparison: str) -> Floats:
        """Return the split-half comparisons [S] by any comparison (from the stored halves if need be)."""
        if comparison == self.comparison or self.problem is not None:
            return self.split_half_r
        return compare(self.halves[:, 0], self.halves[:, 1], method=comparison)


def subject_rdm(
    subject: str,
    blocks: Sequence[Trials],
    n_stimuli: int,
    *,
    stimuli: Sequence[str] | None = None,
    method: str = "correlation",
    comparison: str = "pearson",
    splits: int = SPLITS,
    seed: int = 0,
    noise: str = "diag",
    draws: int = 0,
    draw_splits: int = DRAW_SPLITS,
) -> SubjectRDM:
    """Build an animal's RDM and its split halves from the trials of its sessions.

    An animal whose data cannot be used comes back with ``problem`` (for example ``no trials of
    'convex-far'``) instead of an error, so the others can still be scored.

    Args:
        subject: Name of the animal.
        blocks: Its sessions; see :class:`Trials` and the rules of :mod:`brainbench.metrics.reliability.split_half`.
        n_stimuli: K.
        stimuli: Names of the stimuli, for messages.
        method: RDM method: ``correlation``, ``sqeuclidean``, ``mahalanobis``, ``crossnobis`` or ``poisson``.
        comparison: Comparison of RDMs, see :func:`brainbench.metrics.rdms.comparison`.
        splits: Number of random split halves.
        seed: Seed of the splits and draws.
        noise: Noise covariance for ``mahalanobis`` and ``crossnobis``.
        draws: Bootstrap draws of sessions and trials, for intervals; see :mod:`brainbench.metrics.inference.bootstrap`.
        draw_splits: Split halves within each draw.

    Raises:
        UsageError: unknown method, bad shapes or labels, repeated trial keys.
        DataError: infinite responses, or negative ones for ``poisson``.
    """
    found = split_half(
        blocks,
        n_stimuli,
        stimuli=stimuli,
        method=method,
        comparison=comparison,
        splits=splits,
        seed=seed,
        noise=noise,
        draws=draws,
        draw_splits=draw_splits,
    )
    return SubjectRDM(
        subject=subject,
        rdm=found.rdm,
        split_half_r=found.r,
        halves=found.halves,
        units=found.units,
        trials=found.trials,
        method=method,
        comparison=comparison,
        reliability=found.reliability,
        spread=found.spread,
        seed=seed,
        problem=found.problem,
        notes=found.notes,
        draws=found.draws,
        draws_r=found.draws_r,
    )


def is_flat(rdms: Floats) -> NDArray[np.bool_]:
    """Whether RDMs [..., P] have missing pairs or no differences between pairs: nothing compares with them."""
    return np.isnan(compare(rdms, rdms, method="pearson")) | ~np.isfinite(rdms).all(axis=-1)
