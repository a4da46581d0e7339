"""How well animals agree with one another, by the estimator that scores models."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from brainbench.errors import UsageError
from brainbench.metrics._animals import ceiling_of, gather, interval_reasons, mean_rdm, mean_reliability, t_interval
from brainbench.metrics._pairs import Floats, permuted_pairs, stimulus_count
from brainbench.metrics.compare import check_comparison
from brainbench.metrics.compare import compare as compare_rdms
from brainbench.metrics.inference import RANDOM_PERMUTATIONS, SMALLEST_STIMULI, TIE, canonical_order
from brainbench.metrics.noise import RELIABILITY_GATE, Corrected, noise_corrected
from brainbench.metrics.score import metric_name
from brainbench.metrics.subject import SubjectRDM
from brainbench.types import Score, Status, SubjectScore

_CHUNK_ELEMENTS = 1 << 22


def score_animals(
    subjects: Sequence[SubjectRDM],
    *,
    name: str = "animal-to-animal",
    stimuli: Sequence[str] | None = None,
    estimator: str = "default",
    compare: str = "pearson",
    seed: int = 0,
) -> Score:
    """Score each reliable animal against the mean RDM of the others, both sides corrected for noise.

    The reliability of the others' mean RDM comes from the same split halves, averaged over them. The
    p-value relabels every animal's stimuli independently (10,000 times, (b+1)/(n+1)).

    Args:
        subjects: From :func:`subject_rdm`, for the same stimuli in the same order.
        name: Name of the score.
        stimuli: Names of the K stimuli; numbers by default.
        estimator: See :func:`noise_corrected`.
        compare: Comparison of RDMs.
        seed: Seed of the permutations.

    Returns:
        A score without layers; undefined for fewer than two usable animals.

    Raises:
        UsageError: no animals, RDMs that do not fit, unknown estimator or comparison.
    """
    check_comparison(compare)
    if not subjects:
        raise UsageError("There are no animals to compare; give at least two SubjectRDM.")
    count = stimulus_count(len(subjects[0].rdm))
    labels = tuple(map(str, range(count) if stimuli is None else stimuli))
    if len(labels) != count:
        raise UsageError(f"The animals' RDMs have {count} stimuli; received {len(labels)} names.")
    animals = gather(subjects, estimator=estimator, comparison=compare, pairs=len(subjects[0].rdm))
    scored = animals.scored if count > 2 and len(animals.scored) > 1 else ()
    pairs = [_against_others(index, scored, animals.subjects, estimator, compare) for index in scored]
    results = dict(zip(scored, pairs, strict=True))
    found = [result for result in pairs if result.status != "undefined"]
    values = np.array([result.value for result in found])
    reliability, reliability_interval = mean_reliability(animals)
    status: Status = "undefined"
    reasons: tuple[str, ...] = ("fewer than two animals have a usable RDM",) if count > 2 else ("RDMs need 3 stimuli",)
    p, smallest = math.nan, smallest_p_of_animals(count, max(2, len(scored)))
    if found:
        trusted = animals.reliable and count >= SMALLEST_STIMULI and all(result.status == "ok" for result in found)
        status = "ok" if trusted else "unreliable"
        reasons = tuple(f"{animals.subjects[i].subject}: {results[i].reason}" for i in scored if results[i].reason)
        reasons += interval_reasons(len(found))
        if count < SMALLEST_STIMULI:
            reasons += (f"{count} stimuli allow no p below {smallest:.3g}; at least {SMALLEST_STIMULI} are needed",)
        elif len(found) == len(scored):
            factors = np.array([_factor(result) for result in found])
            p = _permutation_p(animals.rdms(scored), factors, compare, seed)
    elif scored:
        reasons = tuple(f"{animals.subjects[i].subject}: {results[i].reason}" for i in scored)
    return Score(
        name=name,
        value=float(values.mean()) if found else math.nan,
        status=status,
        reasons=reasons + animals.reasons,
        r=float(np.mean([result.r for result in found])) if found else math.nan,
        reliability=reliability,
        reliability_interval=reliability_interval,
        interval=t_interval(values),
        p=p,
        p_method=f"one-sided, every animal's labels permuted {RANDOM_PERMUTATIONS:,} times, (b+1)/(n+1)",
        p_smallest=smallest,
        ceiling=ceiling_of(animals, compare),
        layer_rule="no layers: each animal against the mean RDM of the others",
        subjects=tuple(
            SubjectScore(
                subject=subject.subject,
                value=results[index].value if index in results else math.nan,
                r=results[index].r if index in results else math.nan,
                reliability=animals.corrections[index].reliability,
                status=results[index].status if index in results else animals.status(index),
                units=subject.units,
                trials=subject.trials,
            )
            for index, subject in enumerate(animals.subjects)
        ),
        estimator=estimator,
        metric=f"{metric_name(animals, compare)}; each animal against the mean of the others, both corrected",
        stimuli=labels,
        brain_rdm=mean_rdm(animals),
        provenance={"seed": seed, "reliability_gate": RELIABILITY_GATE},
    )


def _against_others(
    index: int, scored: Sequence[int], subjects: Sequence[SubjectRDM], estimator: str, comparison: str
) -> Corrected:
    others = [subjects[other] for other in scored if other != index]
    pooled = np.mean([other.rdm for other in others], axis=0)
    splits = min(len(subjects[other].halves) for other in scored)
    halves = np.mean([other.halves[:splits] for other in others], axis=0)
    return noise_corrected(
        float(compare_rdms(subjects[index].rdm, pooled, method=comparison)),
        subjects[index].split_half_by(comparison)[:splits],
        estimator=estimator,
        other_split_half_r=compare_rdms(halves[:, 0], halves[:, 1], method=comparison),
    )


def _factor(result: Corrected) -> float:
    return result.value / result.r if result.r else 0.0


def _permutation_p(rdms: Floats, factors: Floats, comparison: str, seed: int) -> float:
    """Return P(mean corrected agreement ≥ observed) when every animal's stimuli are relabelled alone."""
    animals, pairs = rdms.shape
    stimuli = stimulus_count(pairs)
    rdms = rdms[:, permuted_pairs(canonical_order(rdms)[None])[0]]
    generator = np.random.default_rng(seed)
    observed = _agreement(rdms[None], factors, comparison)[0]
    reached, done = 0, 0
    while done < RANDOM_PERMUTATIONS:
        rows = min(max(1, _CHUNK_ELEMENTS // rdms.size), RANDOM_PERMUTATIONS - done)
        orders = generator.permuted(np.tile(np.arange(stimuli), (rows, animals, 1)), axis=-1)
        relabelled = np.take_along_axis(rdms[None], permuted_pairs(orders), axis=-1)
        reached += int((_agreement(relabelled, factors, comparison) >= observed - TIE).sum())
        done += rows
    return (reached + 1) / (RANDOM_PERMUTATIONS + 1)


def _agreement(rdms: Floats, factors: Floats, comparison: str) -> Floats:
    """Return the mean corrected comparison [N] of each animal with the mean of the others, from [N, A, P]."""
    others = (rdms.sum(axis=1, keepdims=True) - rdms) / (rdms.shape[1] - 1)
    return compare_rdms(rdms, others, method=comparison) @ factors / len(factors)


def smallest_p_of_animals(stimuli: int, animals: int) -> float:
    """Return the smallest p that relabelling the animals can give."""
    if stimuli < 3:
        return 1.0
    orders = math.lgamma(stimuli + 1) * (animals - 1)
    return max(1 / (RANDOM_PERMUTATIONS + 1), math.exp(-min(orders, 700.0)))
