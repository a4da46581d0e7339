"""Agreement of animals with one another, by the estimator that scores models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.core.provenance import Provenance
from brainbench.core.records import Interval, Score, Status, SubjectScore
from brainbench.metrics.animals import (
    Animals,
    ceiling_of,
    gather,
    mean_rdm,
    mean_reliability,
)
from brainbench.metrics.inference.intervals import interval_reasons, t_interval
from brainbench.metrics.inference.permutation import RANDOM_PERMUTATIONS, SMALLEST_STIMULI, TIE, canonical_order
from brainbench.metrics.rdms.comparison import check_comparison
from brainbench.metrics.rdms.comparison import compare as compare_rdms
from brainbench.metrics.rdms.pairs import Floats, permuted_pairs, stimulus_count
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE, Corrected, noise_corrected
from brainbench.metrics.reliability.subject_rdm import SubjectRDM
from brainbench.metrics.score import metric_name

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
    p-value permutes every animal's stimuli independently (10,000 times, (b+1)/(n+1)).

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
    compared = animals.scored if count > 2 and len(animals.scored) > 1 else ()
    results = {index: _against_others(index, compared, animals.subjects, estimator, compare) for index in compared}
    found = [index for index in compared if results[index].status != "undefined"]
    values = np.array([results[index].value for index in found])
    p = math.nan
    if count >= SMALLEST_STIMULI and found and len(found) == len(compared):
        p = _permutation_p(animals.rdms(found), np.array([_factor(results[i]) for i in found]), compare, seed)
    smallest = smallest_p_of_animals(count, max(2, len(compared)))
    status, reasons = _verdict(animals, results, found, count, smallest)
    reliability, reliability_interval = mean_reliability(animals)
    return Score(
        name=name,
        value=float(values.mean()) if found else math.nan,
        status=status,
        reasons=reasons,
        r=float(np.mean([results[index].r for index in found])) if found else math.nan,
        reliability=reliability,
        reliability_interval=reliability_interval,
        interval=_interval(values),
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
                status=results[index].status if index in results else "undefined",
                units=subject.units,
                trials=subject.trials,
            )
            for index, subject in enumerate(animals.subjects)
        ),
        estimator=estimator,
        metric=f"{metric_name(animals, compare)}; each animal against the mean of the others, both corrected",
        stimuli=labels,
        brain_rdm=mean_rdm(animals),
        provenance=Provenance.of({"seed": seed, "reliability_gate": RELIABILITY_GATE}),
    )


def pairwise_consistency(
    subjects: Sequence[SubjectRDM], *, estimator: str = "default", compare: str = "pearson"
) -> tuple[tuple[str, ...], Floats]:
    """Return the names [A] and the noise-corrected comparison [A, A] of every two animals, both sides corrected.

    NaN on the diagonal and where either animal has no usable RDM or no positive reliability. Single pairs
    are noisier than :func:`score_animals`, which compares each animal with the mean of the others.

    Raises:
        UsageError: no animals, RDMs that do not fit, unknown estimator or comparison.
    """
    check_comparison(compare)
    if not subjects:
        raise UsageError("There are no animals to compare; give at least two SubjectRDM.")
    animals = gather(subjects, estimator=estimator, comparison=compare, pairs=len(subjects[0].rdm))
    found = np.full((len(animals.subjects), len(animals.subjects)), np.nan)
    for first in animals.usable:
        for second in animals.usable:
            if first < second:
                one, two = animals.subjects[first], animals.subjects[second]
                sides = [subject.split_half_by(compare) for subject in (one, two)]
                count = min(map(len, sides))
                result = noise_corrected(
                    float(compare_rdms(one.rdm, two.rdm, method=compare)),
                    sides[0][:count],
                    estimator=estimator,
                    other_split_half_r=sides[1][:count],
                )
                found[first, second] = found[second, first] = result.value
    return tuple(subject.subject for subject in animals.subjects), found


def _verdict(
    animals: Animals, results: dict[int, Corrected], found: list[int], count: int, smallest: float
) -> tuple[Status, tuple[str, ...]]:
    """Return the status of the agreement and its reasons, the gravest first."""
    told = tuple(f"{animals.subjects[i].subject}: {results[i].reason}" for i in results if results[i].reason)
    if not found:
        if count < 3:
            told = (f"{count} stimuli have one pair, and RDMs of one pair cannot be compared; at least 3 are needed",)
        elif not results:
            told = ("fewer than two animals have a usable RDM",)
        return "undefined", told + animals.reasons
    if count < SMALLEST_STIMULI:
        told = (f"{count} stimuli allow no p below {smallest:.3g}; at least {SMALLEST_STIMULI} are needed", *told)
    elif len(found) < len(results):
        told = ("no p: the agreement of some animals is undefined", *told)
    if len(found) == 2:
        told += ("two animals make one comparison: no confidence interval",)
    else:
        told += interval_reasons(len(found))
    trusted = animals.reliable and count >= SMALLEST_STIMULI and all(results[i].status == "ok" for i in results)
    return "ok" if trusted else "unreliable", told + animals.reasons


def _interval(values: Floats) -> Interval | None:
    """Return the t interval over animals; the two values of two animals are one and the same."""
    found = t_interval(values) if len(values) > 2 else None
    return found and replace(found, method=f"{found.method}; approximate, since animals meet one another")


def _against_others(
    index: int, scored: Sequence[int], subjects: Sequence[SubjectRDM], estimator: str, comparison: str
) -> Corrected:
    others = [subjects[other] for other in scored if other != index]
    pooled = np.mean([other.rdm for other in others], axis=0)
    # Halves are averaged split by split, so every animal must have them.
    splits = min(len(subjects[other].halves) for other in scored)
    halves = np.mean([other.halves[:splits] for other in others], axis=0)
    # Both reliabilities enter the correction (thesis, equation 3.4), since the others' mean RDM is noisy too.
    return noise_corrected(
        float(compare_rdms(subjects[index].rdm, pooled, method=comparison)),
        subjects[index].split_half_by(comparison)[:splits],
        estimator=estimator,
        other_split_half_r=compare_rdms(halves[:, 0], halves[:, 1], method=comparison),
    )


def _factor(result: Corrected) -> float:
    return result.value / result.r if result.r else 0.0


def _permutation_p(rdms: Floats, factors: Floats, comparison: str, seed: int) -> float:
    """Return P(mean corrected agreement ≥ observed) when every animal's stimuli are permuted independently."""
    animals, pairs = rdms.shape
    stimuli = stimulus_count(pairs)
    # A canonical order of the stimuli, so that random permutations do not depend on how they were listed.
    rdms = rdms[:, permuted_pairs(canonical_order(rdms)[None])[0]]
    # Each animal has its own order: one order for all would leave their agreement as it is.
    generator = np.random.default_rng(seed)
    observed = _agreement(rdms[None], factors, comparison)[0]
    reached, done = 0, 0
    while done < RANDOM_PERMUTATIONS:
        rows = min(max(1, _CHUNK_ELEMENTS // rdms.size), RANDOM_PERMUTATIONS - done)
        orders = generator.permuted(np.tile(np.arange(stimuli), (rows, animals, 1)), axis=-1)
        permuted = np.take_along_axis(rdms[None], permuted_pairs(orders), axis=-1)
        reached += int((_agreement(permuted, factors, comparison) >= observed - TIE).sum())
        done += rows
    # (b + 1)/(n + 1): the given order counts among the random ones.
    return (reached + 1) / (RANDOM_PERMUTATIONS + 1)


def _agreement(rdms: Floats, factors: Floats, comparison: str) -> Floats:
    """Return the mean corrected comparison [N] of each animal with the mean of the others, from [N, A, P]."""
    # All leave-one-out means from one sum over animals.
    others = (rdms.sum(axis=1, keepdims=True) - rdms) / (rdms.shape[1] - 1)
    return compare_rdms(rdms, others, method=comparison) @ factors / len(factors)


def smallest_p_of_animals(stimuli: int, animals: int) -> float:
    """Return the smallest p that permuting the animals' stimuli can give."""
    if stimuli < 3:
        return 1.0
    # K!^(A − 1) orders relative to the first animal, as a logarithm, since the number overflows.
    orders = math.lgamma(stimuli + 1) * (animals - 1)
    return max(1 / (RANDOM_PERMUTATIONS + 1), math.exp(-min(orders, 700.0)))
