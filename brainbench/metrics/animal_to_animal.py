"""Agreement of animals with one another, by the metric and estimator that score models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.core.provenance import Provenance
from brainbench.core.records import Score, Status, SubjectScore
from brainbench.core.statistics import two_factor_interval
from brainbench.metrics.animals import Animals, ceiling_of, gather, mean_rdm, mean_reliability
from brainbench.metrics.comparisons import LayerComparisons
from brainbench.metrics.hooks import MetricHooks
from brainbench.metrics.inference.intervals import held_to_scale, interval_reasons
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, TIE, label_orders
from brainbench.metrics.rdms.pairs import Floats
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE, Corrected
from brainbench.metrics.reliability.subject_rdm import SubjectRDM


def score_agreement(
    metric: MetricHooks,
    subjects: Sequence[SubjectRDM],
    *,
    stimuli: Sequence[str],
    estimator: str = "default",
    seed: int = 0,
) -> Score:
    """Score each reliable animal against the others together, by a metric.

    The p-value permutes every animal's stimuli independently, (b+1)/(n+1). ``subjects`` are what :meth:`Metric.animal`
    made of each animal, ``stimuli`` the names of the K stimuli. Returns a score without layers; undefined for fewer
    than two usable animals.
    """
    if not subjects:
        raise UsageError("There are no animals to compare; give at least two SubjectRDM.")
    count = len(stimuli)
    animals = gather(metric, subjects, count, estimator=estimator)
    compared = animals.scored if count >= metric.fewest and len(animals.scored) > 1 else ()
    others = {i: [animals.subjects[j] for j in compared if j != i] for i in compared}
    factors = {i: metric.agreement(animals.subjects[i], others[i], estimator) for i in compared}
    pairs = []
    for i in compared:
        animal, partner = animals.subjects[i], metric.partner(animals.subjects[i], others[i])
        pairs.append(LayerComparisons(metric, [metric.take(partner, animals.order)], [animal.take(animals.order)]))
    raw = {i: float(pair.given()[0, 0]) for i, pair in zip(compared, pairs, strict=True)}
    values = {i: raw[i] * factors[i].value for i in compared}
    found = [i for i in compared if math.isfinite(values[i])]
    parts = np.array([values[i] for i in found])
    null, without, chance = np.empty(0), np.empty(0), math.nan
    if found and len(found) == len(compared):
        weights = np.array([factors[i].value for i in found])
        without = np.stack([pair.without_each()[:, 0, 0] for pair in pairs], axis=1) @ weights / len(weights)
        if count >= SMALLEST_STIMULI:
            null = _null(metric, animals, weights, seed)
            # The others' stimuli are permuted together, as those of a model are.
            orders = list(label_orders(count, seed, exact=0, draws=metric.orders_between))[1:]
            chance = float(np.mean([np.mean(next(pair.under(lambda: orders))) for pair in pairs] * weights))
    smallest = smallest_p_of_animals(count, max(2, len(compared)), metric.orders_between)
    status, reasons = _verdict(metric, animals, factors, found, count, smallest)
    reliability, reliability_interval = mean_reliability(animals)
    value = float(parts.mean()) if found else math.nan
    scored = [animals.subjects[i] for i in found]
    attainable = float(np.mean(metric.attainable(scored, seed) * animals.factors(found))) if found else math.nan
    # The two values of two animals are one and the same.
    span = two_factor_interval(value, parts, without) if len(parts) > 2 and without.size else None
    made = Score(
        name="animal-to-animal",
        value=value,
        status=status,
        reasons=reasons,
        r=float(np.mean([raw[i] for i in found])) if found else math.nan,
        reliability=reliability,
        reliability_interval=reliability_interval,
        interval=span and replace(span, method=f"{span.method}; approximate, since animals meet one another"),
        p=float((null >= null[0] - TIE).mean()) if null.size else math.nan,
        p_method=f"one-sided, every animal's labels permuted {metric.orders_between:,} times, (b+1)/(n+1)",
        p_smallest=smallest,
        ceiling=ceiling_of(animals, metric.comparison) if metric.of_rdms else None,
        layer_rule="no layers: each animal against the others together",
        subjects=tuple(
            SubjectScore(
                subject=subject.subject,
                value=values.get(index, math.nan),
                r=raw.get(index, math.nan),
                reliability=animals.corrections[index].reliability,
                status=factors[index].status if index in found else "undefined",
                units=subject.units,
                trials=subject.trials,
            )
            for index, subject in enumerate(animals.subjects)
        ),
        estimator=estimator,
        metric=f"{metric.describe(animals.subjects)}; each animal against the others",
        stimuli=tuple(map(str, stimuli)),
        brain_rdm=mean_rdm(animals) if metric.of_rdms else (),
        chance=chance,
        attainable=attainable,
        without_stimulus=tuple(without[np.argsort(animals.order)].tolist()) if without.size else (),
        provenance=Provenance.of({"seed": seed, "reliability_gate": RELIABILITY_GATE}),
    )
    return held_to_scale(made)


def _null(metric: MetricHooks, animals: Animals, factors: Floats, seed: int) -> Floats:
    """Return the mean agreement [N] under orders of every animal's stimuli, the given ones first."""
    # Each animal has its own order: one order for all would leave their agreement as it is.
    orders = np.tile(animals.order, (metric.orders_between + 1, len(animals.scored), 1))
    orders[1:] = np.random.default_rng(seed).permuted(orders[1:], axis=-1)
    null = metric.agreement_null([animals.subjects[i] for i in animals.scored], factors, orders)
    return null[np.isfinite(null)] if np.isfinite(null[0]) else np.empty(0)


def _verdict(
    metric: MetricHooks, animals: Animals, factors: dict[int, Corrected], found: list[int], count: int, smallest: float
) -> tuple[Status, tuple[str, ...]]:
    """Return the status of the agreement and its reasons, the gravest first."""
    told = tuple(f"{animals.subjects[i].subject}: {factors[i].reason}" for i in factors if factors[i].reason)
    if not found:
        if count < metric.fewest:
            told = (f"{count} stimuli are too few; at least {metric.fewest} are needed",)
        elif not factors:
            told = ("fewer than two animals can be used",)
        return "undefined", told + animals.reasons
    if count < SMALLEST_STIMULI:
        told = (f"{count} stimuli allow no p below {smallest:.3g}; at least {SMALLEST_STIMULI} are needed", *told)
    elif len(found) < len(factors):
        told = ("no p: the agreement of some animals is undefined", *told)
    if len(found) == 2:
        told += ("two animals make one comparison: no confidence interval",)
    else:
        told += interval_reasons(len(found), count)
    trusted = animals.reliable and count >= SMALLEST_STIMULI and all(factors[i].status == "ok" for i in factors)
    return "ok" if trusted else "unreliable", told + animals.reasons + metric.reasons


def smallest_p_of_animals(stimuli: int, animals: int, draws: int) -> float:
    """Return the smallest p that permuting the animals' stimuli can give."""
    if stimuli < 3:
        return 1.0
    # K!^(A − 1) orders relative to the first animal, as a logarithm, since the number overflows.
    orders = math.lgamma(stimuli + 1) * (animals - 1)
    return max(1 / (draws + 1), math.exp(-min(orders, 700.0)))
