"""Correction of an RDM comparison for noise in the brain's RDM.

A noisy RDM can correlate with the best model by no more than the square root of its reliability
(Spearman 1904), so r is divided by that. Unbiased distances d + noise have the mean product ‖d‖² over
halves without common trials, whatever the law by which their noise falls with the trials, so their
reliability is that product over ‖d + noise‖² of all trials (:attr:`SubjectRDM.signal`). Other distances
have the same bias in both halves; theirs is the halves' correlation, lengthened by Spearman and Brown's
formula, which assumes that the noise variance halves as the trials double.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_name
from brainbench.core.records import Status
from brainbench.metrics.arrays import Floats, finite_mean
from brainbench.metrics.rdms.comparison import check_comparison, compare, pooling, rdm_stack

RELIABILITY_GATE = 0.5
"""Smallest mean reliability of a study's animals whose corrected score is trusted: from there on intervals hold the
value without noise (docs/calibration.md, table ``noise``)."""

ANIMAL_GATE = 0.3
"""Smallest reliability of an animal that is scored with the others. It lies well below the gate of the study: animals
kept just above a gate are those whose reliability came out too high, and their scores too low."""

THESIS_FILTER = 0.5  # the published estimator drops split halves whose raw correlation is below this


_Estimator = Callable[[Floats, Floats, Floats | None, list[float]], tuple[float, int, str]]
"""Makes value, number of splits and reason of r_xy, the halves of both sides and their reliabilities."""


@dataclass(frozen=True)
class Corrected:
    """A noise-corrected comparison."""

    value: float
    """NaN exactly when ``status`` is ``undefined``."""
    status: Status
    reason: str = ""
    r: float = math.nan
    """Mean raw comparison."""
    reliability: float = math.nan
    """Spearman-Brown reliability of the mean split-half correlation (the product's square root when
    two sides are corrected)."""
    splits: int = 0
    """Split halves that entered the value."""


def spearman_brown(r: ArrayLike) -> Floats:
    """Return the reliability 2r/(1 + r) of all trials from the correlation of their halves; r = −1 is NaN."""
    # Spearman and Brown's formula for a test of twice the length (thesis, section 3.3.4).
    half = np.asarray(r, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(half == -1.0, np.nan, 2 * half / (1 + half))


def corrected_splits(r_xy: ArrayLike, split_half_r: ArrayLike, other_split_half_r: ArrayLike | None = None) -> Floats:
    """Return each split's ratio r_xy/√(SB(r_xx) SB(r_yy)), as published; NaN where it is imaginary.

    As published, two negative reliabilities have a positive product and pass.
    """
    model_side = 1.0 if other_split_half_r is None else spearman_brown(other_split_half_r)
    # Thesis, equation 3.4, split by split; a negative product has no real root.
    product = spearman_brown(split_half_r) * model_side
    return np.asarray(r_xy, dtype=np.float64) / np.sqrt(np.where(product > 0, product, np.nan))


def noise_corrected(
    r_xy: ArrayLike, split_half_r: ArrayLike, *, estimator: str = "default", other_split_half_r: ArrayLike | None = None
) -> Corrected:
    """Correct the comparison of a model with a brain for the brain's noise.

    Args:
        r_xy: Comparison of the two RDMs: a number, or one per split half [S].
        split_half_r: Raw correlations [S] between the brain's split-half RDMs, one per random split.
        estimator: ``default`` mean(r_xy)/√SB(mean split_half_r), ``unreliable`` below
            :data:`RELIABILITY_GATE`, ``undefined`` without positive reliability. ``thesis``: ratio per
            split, splits with raw r below :data:`THESIS_FILTER` dropped, mean of the rest (published for
            models). ``thesis-input``: ratio per split, no filter, median (published for the raw input).
        other_split_half_r: The same for the other side when it is a noisy brain too (animal to animal);
            None for models, which have no trial noise.

    >>> round(noise_corrected(0.6, [0.7, 0.8, 0.6]).value, 3)
    0.661
    >>> noise_corrected(0.6, [0.1, 0.2]).reason
    'reliability 0.26 is below 0.5, where no noise correction is trustworthy'
    """
    check_name("estimator", estimator, _ESTIMATORS)
    comparison = np.asarray(r_xy, dtype=np.float64).ravel()
    halves = np.asarray(split_half_r, dtype=np.float64).ravel()
    others = None if other_split_half_r is None else np.asarray(other_split_half_r, dtype=np.float64).ravel()
    sizes = {len(part) for part in (comparison, halves, others) if part is not None and len(part) != 1}
    if len(sizes) > 1 or 0 in sizes:
        raise UsageError(
            f"r_xy and the split-half correlations are single numbers or one per split; received {len(comparison)}, "
            f"{len(halves)}{'' if others is None else f', {len(others)}'}."
        )
    if any((np.abs(part) > 1 + 1e-6).any() for part in (comparison, halves, others) if part is not None):
        raise UsageError("Comparisons and split halves are correlations, from -1 to 1; others came.")
    r = float(finite_mean(comparison))
    sides = [float(spearman_brown(finite_mean(side))) for side in (halves, others) if side is not None]
    reliability = sides[0] if len(sides) == 1 else math.sqrt(math.prod(sides)) if min(sides) > 0 else min(sides)
    value, splits, reason = _ESTIMATORS[estimator](comparison, halves, others, sides)
    if math.isnan(r):
        value, reason = math.nan, "the comparison of the RDMs is undefined (a constant or missing RDM)"
    if math.isnan(value):
        return Corrected(math.nan, "undefined", reason, r, reliability, splits)
    # The noisier side decides: one good side does not make up for a bad one.
    lowest = min(sides)
    if not lowest >= RELIABILITY_GATE:
        text = f"reliability {lowest:.2f} is below {RELIABILITY_GATE}, where no noise correction is trustworthy"
        return Corrected(value, "unreliable", text, r, reliability, splits)
    return Corrected(value, "ok", "", r, reliability, splits)


def _default(r_xy: Floats, halves: Floats, others: Floats | None, sides: list[float]) -> tuple[float, int, str]:
    # Correlations are averaged before the ratio is formed, so that no split with a denominator near zero dominates.
    lowest = min(sides) if not any(map(math.isnan, sides)) else math.nan
    if not lowest > 0:
        return math.nan, 0, _no_reliability(lowest)
    return float(finite_mean(r_xy)) / math.sqrt(math.prod(sides)), int(np.isfinite(halves).sum()), ""


def _by_split(average: Callable[[Floats], Any], least: float, lacking: str) -> _Estimator:
    """Return a published estimator: the average ratio of splits whose raw correlation is at least ``least``."""

    def corrected(r_xy: Floats, halves: Floats, others: Floats | None, sides: list[float]) -> tuple[float, int, str]:
        """Return the average ratio, the splits that entered, and why there is none."""
        ratio = corrected_splits(np.where(halves >= least, r_xy, np.nan), halves, others)
        # Imaginary ratios vanish, as published.
        real = ratio[np.isfinite(ratio)]
        return (float(average(real)), real.size, "") if real.size else (math.nan, 0, lacking)

    return corrected


_ESTIMATORS: dict[str, _Estimator] = {
    "default": _default,
    # For models: splits below the filter are dropped, which keeps the lucky ones.
    "thesis": _by_split(np.mean, THESIS_FILTER, f"no split half has a raw correlation of at least {THESIS_FILTER}"),
    # For the raw input.
    "thesis-input": _by_split(np.median, -math.inf, "no split half has a positive reliability"),
}

ESTIMATORS = tuple(_ESTIMATORS)


def gated(factor: float, reliability: float) -> Corrected:
    """Return a factor with the status that the animal's reliability gives it."""
    if not reliability >= ANIMAL_GATE:
        text = f"reliability {reliability:.2f} is below {ANIMAL_GATE}"
        return Corrected(factor, "unreliable", text, 1.0, reliability)
    return Corrected(factor, "ok", "", 1.0, reliability)


def correction_by(*reliabilities: float) -> Corrected:
    """Return the factor 1/√(r₁ r₂ …) of a comparison of RDMs with some reliabilities; the lowest one gives its status.

    >>> round(correction_by(0.64).value, 3)
    1.25
    """
    lowest = min(reliabilities) if not any(map(math.isnan, reliabilities)) else math.nan
    if not lowest > 0:
        return Corrected(math.nan, "undefined", _no_reliability(lowest), 1.0, lowest)
    return gated(1 / math.sqrt(math.prod(reliabilities)), lowest)


def _no_reliability(lowest: float) -> str:
    if math.isnan(lowest):
        return "the split-half reliability is undefined"
    return f"the reliability is {lowest:.2f}, not positive: the split halves share no geometry"


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
