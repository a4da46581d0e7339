"""Hierarchical bootstrap of a score: animals, then sessions and trials within each.

Sessions and trials were drawn when the animals' RDMs were made (``subject_rdm(..., draws=1000)``), once
for all models. Here animals are drawn, and every draw repeats the estimator: noise correction from the
draw's own split halves, and the choice of layer on the other animals (never on another copy of the
animal itself). The gate on reliability is not repeated; a draw in which an animal has no positive
reliability leaves that animal out.

Drawing trials adds their noise to what the animals' spread already holds, so the hierarchical
interval is wider than needed where trial noise dominates; measured coverage is in docs/statistics.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.core.records import Interval
from brainbench.metrics.animals import Animals, gather
from brainbench.metrics.inference.intervals import (
    LEVEL,
    bca_interval,
    caution,
    check_interval_method,
    percentile_interval,
    t_interval,
)
from brainbench.metrics.layers import held_out
from brainbench.metrics.rdms.comparison import check_comparison, compare_all, pooling
from brainbench.metrics.rdms.comparison import compare as compare_rdms
from brainbench.metrics.rdms.pairs import Floats, rdm_stack
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.subject_rdm import SubjectRDM

DRAWS = 1000
"""Bootstrap draws; `brainbench tradeoff score` measures what more would change."""

_BATCHES = 10

_NOTHING = 1e-12
"""A pool whose square is below this share of that of all animals holds none."""

Levels = Literal["animals", "all"]


@dataclass(frozen=True)
class Bootstrap:
    """Draws of a score."""

    estimate: float
    draws: Floats = field(repr=False)
    """[D] the score in each draw; NaN where no animal had a value."""
    values: Floats = field(repr=False)
    """[A] the animals' values."""
    jackknife: Floats = field(repr=False)
    """[A] the score without each animal."""
    levels: str = "animals"
    """The levels that were drawn, in words."""

    @property
    def standard_error(self) -> float:
        """Standard deviation of the draws."""
        finite = self.draws[np.isfinite(self.draws)]
        return float(finite.std(ddof=1)) if len(finite) > 1 else math.nan

    @property
    def undefined(self) -> int:
        """Draws without a value."""
        return int((~np.isfinite(self.draws)).sum())

    def interval(self, method: str = "bca", level: float = LEVEL) -> Interval | None:
        """Return the interval by ``t`` (animals only), ``percentile`` or ``bca``; None where it does not exist.

        Raises:
            UsageError: unknown method, or a level outside (0, 1).
        """
        check_interval_method(method)
        if method == "t":
            return t_interval(self.values, level)
        what = f"{method} bootstrap of {self.levels}, {len(self.draws):,} draws{caution(len(self.values))}"
        if method == "percentile":
            return percentile_interval(self.draws, level, what=what)
        return bca_interval(self.draws, self.estimate, self.jackknife, level, what=what)

    def monte_carlo_error(self, method: str = "percentile", level: float = LEVEL) -> float:
        """Return the standard error of the interval's ends from the number of draws, by batches; NaN for too few."""
        if method == "t":
            return 0.0
        size = len(self.draws) // _BATCHES
        if size < _BATCHES:
            return math.nan
        # Batch means: batches are independent, so the spread of their ends over √batches is the error of the whole.
        parts = [
            Bootstrap(self.estimate, part, self.values, self.jackknife, self.levels).interval(method, level)
            for part in np.split(self.draws[: size * _BATCHES], _BATCHES)
        ]
        ends = np.array([[part.low, part.high] for part in parts if part is not None])
        return float(ends.std(axis=0, ddof=1).mean() / math.sqrt(_BATCHES)) if len(ends) > 1 else math.nan


def bootstrap_score(
    layer_rdms: Mapping[str, ArrayLike] | ArrayLike,
    subjects: Sequence[SubjectRDM],
    *,
    compare: str = "pearson",
    draws: int = DRAWS,
    levels: Levels = "all",
    seed: int = 0,
) -> Bootstrap:
    """Bootstrap the ``default`` score of a model.

    Args:
        layer_rdms: RDM [P] of each layer, or [L, P].
        subjects: From :func:`subject_rdm`, with ``draws`` for ``levels="all"``.
        compare: Comparison of RDMs.
        draws: Number D; no more than the subjects hold for ``levels="all"``.
        levels: ``animals``, or ``all`` for animals, their sessions and trials.
        seed: Seed of the draws of animals.

    Raises:
        UsageError: no usable animal, RDMs that do not fit, draws that the subjects lack, unknown names.
    """
    check_comparison(compare)
    if levels not in ("animals", "all"):
        raise UsageError(f"Unknown levels {levels!r}; allowed: 'animals', 'all'.")
    given = list(layer_rdms.values()) if isinstance(layer_rdms, Mapping) else layer_rdms
    rdms = np.atleast_2d(rdm_stack(given, "layer_rdms"))
    animals = gather(subjects, estimator="default", comparison=compare, pairs=rdms.shape[1])
    if not animals.scored:
        raise UsageError(f"No animal can be scored, so there is nothing to bootstrap: {'; '.join(animals.reasons)}.")
    return bootstrap_animals(rdms, animals, compare, draws=draws, levels=levels, seed=seed)


def bootstrap_animals(
    rdms: Floats, animals: Animals, comparison: str, *, draws: int, levels: Levels, seed: int
) -> Bootstrap:
    """Bootstrap the score of layers [L, P] against the scored animals; see :func:`bootstrap_score`.

    Raises:
        UsageError: there is no draw, or levels ``all`` without draws of every animal by this comparison.
    """
    if draws < 1:
        raise UsageError(f"A bootstrap needs at least 1 draw; received {draws}.")
    scored = [animals.subjects[index] for index in animals.scored]
    number = len(scored)
    r = compare_all(rdms, animals.rdms(animals.scored), method=comparison)[:, None]
    factors = animals.factors(animals.scored)[None]
    # Counts of animals stand for the data (ones), for the jackknife (one zero each) and for draws alike.
    estimate = float(drawn_scores(r, factors, np.ones((1, number)))[0])
    jackknife = drawn_scores(r, factors, 1.0 - np.eye(number)) if number > 1 else np.empty(0)
    values = _animal_values(r, factors)
    if levels == "all":
        held = min(len(subject.draws) for subject in scored)
        if held < draws or any(subject.comparison != comparison for subject in scored):
            raise UsageError(
                f"Levels 'all' need {draws} draws of every animal by the comparison {comparison!r}; there are {held} "
                f"(subject_rdm(..., draws={draws}, comparison={comparison!r}) makes them)."
            )
        drawn = np.stack([subject.draws[:draws] for subject in scored], axis=1)
        r = compare_all(rdms, drawn.reshape(-1, drawn.shape[-1]), method=comparison).reshape(-1, draws, number)
        factors = np.stack([noise_factors(subject.draws_r[:draws]) for subject in scored], axis=1)
    generator = np.random.default_rng(seed)
    counts = animal_counts(generator, number, draws)
    what = (
        "animals" if levels == "animals" else "sessions and trials" if number == 1 else "animals, sessions and trials"
    )
    return Bootstrap(estimate, drawn_scores(r, factors, counts), values, jackknife, what)


def animal_counts(generator: np.random.Generator, animals: int, draws: int) -> Floats:
    """Return how often each animal [D, A] was drawn with replacement."""
    # Only how often an animal was drawn matters, and that is multinomial.
    return generator.multinomial(animals, np.full(animals, 1 / animals), size=draws).astype(np.float64)


def bootstrap_comparisons(
    model_rdms: ArrayLike, brain_rdms: ArrayLike, *, method: str = "pearson", draws: int = DRAWS, seed: int = 0
) -> Floats:
    """Return the mean raw comparison [D, M] of models [M, P] with animals [A, P] drawn with replacement.

    All models meet the same draws (rsatoolbox's ``eval_bootstrap_rdm``).

    Raises:
        UsageError: unknown method, or RDMs of different numbers of stimuli.
    """
    check_comparison(method)
    models, brain = (
        np.atleast_2d(rdm_stack(rdms, what)) for rdms, what in ((model_rdms, "model_rdms"), (brain_rdms, "brain_rdms"))
    )
    r = compare_rdms(models[:, None], brain[None], method=method)
    return animal_counts(np.random.default_rng(seed), len(brain), draws) @ r.T / len(brain)


def bootstrap_ceiling(rdms: ArrayLike, *, method: str = "pearson", draws: int = DRAWS, seed: int = 0) -> Floats:
    """Return noise ceilings (lower, upper) [D, 2] of animals drawn with replacement from RDMs [A, P].

    Copies of an animal are left out together for the lower bound (rsatoolbox's ``boot_noise_ceiling``).
    A draw that holds one animal only has no lower bound: NaN.

    Raises:
        UsageError: unknown method, not a stack [A, P], fewer than two animals, or missing pairs.
    """
    check_comparison(method)
    stack = rdm_stack(rdms, "rdms")
    if stack.ndim != 2 or len(stack) < 2 or not np.isfinite(stack).all():
        raise UsageError(
            f"A ceiling's bootstrap takes the complete RDMs of at least 2 animals [A, P]; received {stack.shape}"
            f"{'' if np.isfinite(stack).all() else ' with missing pairs'}."
        )
    return ceilings(stack, animal_counts(np.random.default_rng(seed), len(stack), draws), method)


def ceilings(rdms: Floats, counts: Floats, method: str) -> Floats:
    """Return noise ceilings [D, 2] of animals [A, P] drawn counts [D, A] times.

    Copies weigh in the pool; the mean over animals takes each drawn one once (as rsatoolbox does).
    """
    drawn = counts > 0
    parts = pooling(method)(rdms)
    with np.errstate(invalid="ignore", divide="ignore"):
        if method in _LINEAR:
            # Pools enter by inner products alone, so draws never form one.
            gram = _LINEAR[method](parts)
            own = np.diag(gram)
            pooled = counts @ gram
            size = np.einsum("da,da->d", pooled, counts)[:, None]
            # ‖Σ n p − n_a p_a‖² and the product of p_a with it, from the inner products of the animals.
            others = size - 2 * counts * pooled + counts**2 * own
            length = np.sqrt(own * np.where(others > _NOTHING * size, others, np.nan))
            lower, upper = (pooled - counts * own) / length, pooled / np.sqrt(own * size)
        else:
            total, number = counts @ parts, counts.sum(axis=1, keepdims=True)
            left = (total[:, None] - counts[..., None] * parts) / (number - counts)[..., None]
            lower = compare_rdms(rdms, left, method=method)
            upper = compare_rdms(rdms, (total / number)[:, None], method=method)
    each = drawn.sum(axis=1)
    return np.stack([np.where(drawn, side, 0.0).sum(axis=1) / each for side in (lower, upper)], axis=1)


def _centred_gram(parts: Floats) -> Floats:
    centred = parts - parts.mean(axis=1, keepdims=True)
    return centred @ centred.T


def _gram(parts: Floats) -> Floats:
    return parts @ parts.T


_LINEAR = {"pearson": _centred_gram, "cosine": _gram}
"""Comparisons that are the cosine of pooled vectors."""


def noise_factors(split_half_r: Floats) -> Floats:
    """Return noise corrections [D]; NaN without positive reliability."""
    # Spearman's (1904) correction of one side for attenuation: 1/√reliability.
    reliability = spearman_brown(split_half_r)
    return 1 / np.sqrt(np.where(reliability > 0, reliability, np.nan))


def drawn_scores(r: Floats, factors: Floats, counts: Floats) -> Floats:
    """Return scores [D] from comparisons [L, D or 1, A], corrections [D or 1, A] and counts [D, A]."""
    known = np.isfinite(factors) & np.isfinite(r).all(axis=0)
    counts = np.where(known, counts, 0.0)
    filled, scale = np.where(known, r, 0.0), np.where(known, factors, 0.0)
    layers, number = len(r), counts.shape[1]
    total = counts.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        if layers == 1:
            return (filled[0] * scale * counts).sum(axis=1) / total
        if number == 1:
            # One animal has no others to choose on; its layer is the one of all its trials.
            best = int(np.argmax(filled[:, 0, 0]))
            return np.where(total > 0, filled[best, :, 0] * scale[:, 0], np.nan)
        # Mean over the other animals drawn, all copies of one left out: (Σ n r − n_a r_a)/(Σ n − n_a).
        weighted = filled * counts
        left = total[:, None] - counts
        others = (weighted.sum(axis=-1, keepdims=True) - weighted) / left
        chosen = np.argmax(np.where(np.isfinite(others), others, -np.inf), axis=0)
        held = np.take_along_axis(np.broadcast_to(filled, others.shape), chosen[None], axis=0)[0]
        # A draw of copies of one animal has no others either.
        usable = np.where(left > 0, counts, 0.0)
        return (held * scale * usable).sum(axis=1) / np.where((left > 0).all(axis=1), usable.sum(axis=1), np.nan)


def _animal_values(r: Floats, factors: Floats) -> Floats:
    raw = r[:, 0]
    if len(raw) > 1 and raw.shape[1] > 1:
        return held_out(raw) * factors[0]
    return raw[int(np.argmax(raw.mean(axis=1)))] * factors[0]
