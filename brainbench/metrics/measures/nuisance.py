"""Rival explanations of the animals' geometry: nuisance RDMs, partial correlation, shared variance, partial RSA.

Stimuli also differ in how often they were touched, licked for or chosen. An animal's mean of each over a stimulus
makes an RDM, which is a rival model. :func:`variance_partition` says how much of each animal's RDM the model explains
that the nuisances do not; the metric :class:`PartialRSA` correlates the model's RDM with the animal's, both without
what the nuisances explain linearly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, canonical_order, label_orders, tail_p
from brainbench.metrics.measures.patterns import PatternMetric
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.rdms.pairs import Floats, Ints, permuted_pairs, rdm_stack, stimulus_count, upper
from brainbench.metrics.reliability.subject_rdm import SubjectRDM
from brainbench.metrics.stimulus_labels import stimulus_codes, stimulus_means


@dataclass(frozen=True)
class VariancePartition:
    """Shares of the variance of animals' RDMs, averaged over animals; they add up to ``total``."""

    total: float
    """R² of model and nuisances together."""
    unique_model: float
    """R² that is lost without the model, never negative in a fit to the same pairs."""
    unique_nuisance: float
    """R² that is lost without the nuisances."""
    shared: float
    """R² that either explains; negative where one hides the other (suppression)."""
    partial_r: float
    """Mean correlation of model and animals, both without what the nuisances explain linearly."""
    p: float
    """P(partial r under permuted stimuli of the model ≥ observed); NaN below 4 stimuli."""
    chance: float
    """Mean unique share of the model under permutation: what fitting few pairs gives for nothing."""
    nuisances: tuple[str, ...]
    reason: str = ""
    """Reason for an undefined p; empty otherwise."""


def variance_partition(
    model_rdm: ArrayLike, nuisance_rdms: Mapping[str, ArrayLike], brain_rdms: ArrayLike, *, seed: int = 0
) -> VariancePartition:
    """Partition the variance of animals' RDMs [A, P] between a model's RDM [P] and nuisance RDMs.

    Ordinary least squares per animal, with an intercept; the R² are averaged over animals. The p-value permutes the
    model's stimuli, as in :func:`permutation_test`, and tests the partial correlation.
    """
    if not nuisance_rdms:
        raise UsageError("There are no nuisances; give the RDM of at least one, or use permutation_test.")
    model = rdm_stack(model_rdm, "model_rdm")
    brain = np.atleast_2d(rdm_stack(brain_rdms, "brain_rdms"))
    rivals = np.stack([rdm_stack(given, f"The nuisance {name!r}") for name, given in nuisance_rdms.items()])
    pairs = brain.shape[1]
    if model.shape != (pairs,) or rivals.shape[1:] != (pairs,):
        raise UsageError(f"RDMs have different numbers of stimuli: {model.shape}, {rivals.shape[1:]} and {(pairs,)}.")
    if not all(np.isfinite(part).all() for part in (model, brain, rivals)):
        raise DataError("An RDM has missing pairs; variance can be partitioned over complete RDMs only.")
    if pairs < len(rivals) + 3:
        raise DataError(f"{pairs} pairs are too few to fit {len(rivals)} nuisances and a model; use fewer nuisances.")
    stimuli = stimulus_count(pairs)
    # In an order of the stimuli that the data fix, random permutations do not depend on how stimuli were listed.
    order = permuted_pairs(canonical_order(brain)[None])[0]
    model, brain, rivals = model[order], brain[:, order], rivals[:, order]
    rest = _without(rivals)
    residual = brain @ rest
    scale = ((brain - brain.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        # R² of each model from sums of squares: residual after the nuisances, and the projection on the model alone.
        by_nuisance = 1 - (residual**2).sum(axis=1) / scale
        partial, unique = _partial(model[None], rest, residual, scale)
        centred = model - model.mean()
        by_model = (brain @ centred) ** 2 / (centred @ centred) / scale
    # R² of both = R² of the nuisances + unique share of the model; the other shares are differences.
    total = by_nuisance + unique[0]
    reason, p, chance = "", math.nan, math.nan
    if stimuli < SMALLEST_STIMULI:
        reason = f"{stimuli} stimuli are too few to permute; at least {SMALLEST_STIMULI} are needed"
    elif not np.isfinite(partial).all():
        reason = "the model or an animal varies no more than the nuisances explain"
    else:
        chunks = [
            _partial(model[permuted_pairs(orders)], rest, residual, scale)
            for orders in label_orders(stimuli, seed, step=4096)
        ]
        null = np.concatenate([item[0] for item in chunks]).mean(axis=1)
        p = float(tail_p(null))
        chance = float(np.concatenate([item[1] for item in chunks]).mean())
    return VariancePartition(
        total=float(total.mean()),
        unique_model=float(unique[0].mean()),
        unique_nuisance=float((total - by_model).mean()),
        shared=float((by_model - unique[0]).mean()),
        partial_r=float(partial[0].mean()),
        p=p,
        chance=chance,
        nuisances=tuple(nuisance_rdms),
        reason=reason,
    )


def partial_correlations(models: Floats, nuisances: Floats, brain: Floats) -> Floats:
    """Return correlations [N] of models [N, P] with an animal [P], both without what nuisances [J, P] explain linearly.

    NaN where nothing is left of either, or where the pairs are too few for so many nuisances.
    """
    # Intercept, nuisances and model must leave one degree of freedom.
    if len(brain) < len(nuisances) + 3:
        return np.full(len(models), np.nan)
    rest = _without(nuisances)
    residual = (brain @ rest)[None]
    centred = brain - brain.mean()
    if not (residual**2).sum() > 1e-20 * (centred**2).sum():
        return np.full(len(models), np.nan)
    return _partial(models, rest, residual, np.array([(centred**2).sum()]))[0][:, 0]


def _without(rivals: Floats) -> Floats:
    """Return the symmetric projection [P, P] that takes away an intercept and the nuisances."""
    pairs = rivals.shape[1]
    basis = np.concatenate([np.ones((1, pairs)), rivals - rivals.mean(axis=1, keepdims=True)])
    basis /= np.maximum(np.linalg.norm(basis, axis=1, keepdims=True), np.finfo(float).tiny)
    # 1 − UUᵀ with an orthonormal basis U of intercept and nuisances; the SVD drops collinear ones.
    left, values, _ = np.linalg.svd(basis.T, full_matrices=False)
    left = left[:, values > values[0] * 1e-10]
    return np.eye(pairs) - left @ left.T


def _partial(models: Floats, rest: Floats, residual: Floats, scale: Floats) -> tuple[Floats, Floats]:
    """Return partial correlations and unique shares [N, A] of models [N, P] with animals' residuals [A, P]."""
    # With residuals a, b: r = a·b/(|a||b|), and R² grows by (a·b)²/(|a|² Σ(y − ȳ)²) when the model is added.
    left = models @ rest
    size = (left**2).sum(axis=1)[:, None]
    size = np.where(size > 1e-20 * (models**2).sum(axis=1)[:, None], size, np.nan)
    product = left @ residual.T
    return product / np.sqrt(size * (residual**2).sum(axis=1)), product**2 / size / scale


class PartialRSA(PatternMetric):
    """Partial correlation between RDMs of correlation distances, given nuisance RDMs."""

    name = "rsa-partial"
    title = "correlation between RDMs without what contacts, licks and choices explain"

    brain_method = "correlation"
    comparison = "pearson"
    of_covariates = True

    def animal(self, subject: str, blocks: Sequence[Trials], n_stimuli: int, **options: Any) -> SubjectRDM:
        """Return the animal with its nuisance RDMs; without any it cannot be used."""
        animal = super().animal(subject, blocks, n_stimuli, **options)
        nuisances, lacking = _nuisances(blocks, n_stimuli)
        if animal.problem is None and not nuisances:
            absent = f" ({', '.join(lacking)} do not)" if lacking else ""
            return replace(animal, problem=f"no contacts, licks or choices that differ between stimuli{absent}")
        return replace(animal, nuisances=nuisances)

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        permuted = rdm(model)[permuted_pairs(orders)]
        values = np.full((len(orders), len(animals)), np.nan)
        for column, animal in enumerate(animals):
            brain = rdm(animal.patterns)
            # Nothing is known of what else animals felt whose units were joined.
            if animal.nuisances and np.isfinite(brain).all():
                values[:, column] = partial_correlations(permuted, np.stack(list(animal.nuisances.values())), brain)
        return values

    def statistics(self, layer: Floats, animals: Sequence[SubjectRDM], seed: int) -> dict[str, Any]:
        """Return the shares of variance of the chosen layer, averaged over animals."""
        if not np.isfinite(layer).all():
            return {}
        parts = [variance_partition(rdm(layer), one.nuisances, rdm(one.patterns), seed=seed) for one in animals]
        names = ("total", "unique_model", "unique_nuisance", "shared", "chance")
        nuisances = sorted({name for part in parts for name in part.nuisances})
        shares = {name: float(np.mean([getattr(part, name) for part in parts])) for name in names}
        return {"variance_partition": {**shares, "nuisances": nuisances}}


def _nuisances(blocks: Sequence[Trials], count: int) -> tuple[dict[str, Floats], list[str]]:
    """Return the RDM of every covariate with a value for all stimuli and a difference between some, and the others."""
    # Sessions without two trials of each stimulus are no part of the animal's RDM either.
    blocks = [block for block in blocks if np.bincount(block.labels, minlength=count).min() > 1]
    labels = [stimulus_codes(block.labels, count)[0] for block in blocks]
    rdms, lacking = {}, []
    for name in dict.fromkeys(name for block in blocks for name in block.covariates):
        values = [
            np.asarray(block.covariates.get(name, np.full(len(codes), math.nan)), dtype=np.float64)
            for block, codes in zip(blocks, labels, strict=True)
        ]
        means = stimulus_means(np.concatenate(values)[:, None], np.concatenate(labels), count)[:, 0]
        if np.isfinite(means).all() and np.ptp(means) > 0:
            rdms[name] = upper(np.abs(means[:, None] - means))
        else:
            lacking.append(name)
    return rdms, lacking
