"""The engine of all metrics: from layers and animals to a :class:`brainbench.core.records.Score`.

A metric compares all layers with all animals; what is done with the comparisons is the same for each: the choice of
layer, the permutation test that repeats it, chance, what is attainable, the interval over animals and stimuli, and a
verdict in words. :func:`score_agreement` scores the animals against one another in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from brainbench.core.errors import check_name, check_once
from brainbench.core.provenance import Provenance, UniquePart
from brainbench.core.records import LayerScore, Score, Status, SubjectScore
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, t_interval, two_factor_interval
from brainbench.metrics import evaluation
from brainbench.metrics.arrays import Floats, finite_mean
from brainbench.metrics.hooks import MetricHooks
from brainbench.metrics.inference import permutation
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE, Corrected
from brainbench.metrics.reliability.subject_rdm import SubjectRDM

BEYOND = 1.1
"""Scaled score that no interval should lie above: a tenth of the scale more than all that is reliable."""


def interval_reasons(animals: int, stimuli: int) -> tuple[str, ...]:
    """Say what the numbers of animals and stimuli mean for the interval and for comparisons of models."""
    if animals == 1:
        return ("one animal: no confidence interval, since nothing is known about other animals",)
    lacking = []
    if animals < FEWEST_ANIMALS:
        lacking.append(f"{animals} animals, at least {FEWEST_ANIMALS} are needed")
    if stimuli < FEWEST_STIMULI:
        lacking.append(f"{stimuli} stimuli, at least {FEWEST_STIMULI} are needed")
    return (f"too few to tell models apart: {'; '.join(lacking)}",) if lacking else ()


def held_to_scale(score: Score) -> Score:
    """Return the score, unreliable where it lies above what is attainable: nothing can explain more than that."""
    span = score.scaled_interval
    if score.status != "ok" or span is None or not span.low > BEYOND:
        return score
    reason = f"above all that is reliable (at least {span.low:.2f} of it): the scale of this metric does not hold here"
    return replace(score, status="unreliable", reasons=(reason, *score.reasons))


def score_layers(
    metric: MetricHooks,
    layers: Mapping[str, Floats],
    subjects: Sequence[Any],
    *,
    name: str,
    stimuli: Sequence[str],
    estimator: str = "default",
    seed: int = 0,
    device: Any = None,
    committed: str | None = None,
    each: bool = False,
    controls: Mapping[str, Floats] | None = None,
) -> tuple[Score, permutation.PermutationTest | None]:
    """Score the layers of a model against animals; also return the permutation test with all statistics.

    ``layers`` are what :meth:`Metric.layer` made of each layer, in network order, ``subjects`` what
    :meth:`Metric.animal` made of each animal. ``committed`` is a layer that was chosen before anything was scored;
    without a torch ``device`` numpy computes the permutations. With ``each``, layers are those of the animals, by name.
    What layers explain beyond ``controls`` is stated by the default estimator, where the metric says.
    """
    check_once("A score", map(str, stimuli))
    if committed is not None:
        check_name("layer", committed, layers)
    animals = evaluation.gather(metric, subjects, len(stimuli), estimator=estimator)
    if each:
        layers = {animals.subjects[i].subject: layers[animals.subjects[i].subject] for i in animals.scored}
    names, result, notes = list(layers), None, ()
    usable = defined = evaluation.defined_layers(metric, layers)
    if animals.scored and defined and len(stimuli) >= metric.fewest:
        ordered = [metric.take(layers[label], animals.order) for label in defined]
        compared = evaluation.LayerComparisons(metric, ordered, animals.sorted, device)
        result, defined, notes = evaluation.evaluate(compared, defined, animals, estimator, committed, seed, each=each)
    lacking = {
        "constant or not finite": [name for name in names if name not in usable],
        "not comparable with every animal": [name for name in usable if name not in defined],
    }
    status, reasons = _verdict(metric, animals, lacking, defined, len(stimuli), estimator, result, committed)
    reliability, reliability_interval = evaluation.mean_reliability(animals)
    about = {
        "name": name,
        "status": status,
        "reasons": (*reasons[:1], *notes, *reasons[1:]) if result is None else (*notes, *reasons),
        "reliability": reliability,
        "reliability_interval": reliability_interval,
        "p_smallest": permutation.smallest_p(len(stimuli), metric.orders),
        "ceiling": evaluation.ceiling_of(animals, metric.comparison) if metric.of_rdms else None,
        "estimator": estimator,
        "metric": metric.describe(animals.subjects),
        "stimuli": tuple(map(str, stimuli)),
        "brain_rdm": evaluation.mean_rdm(animals) if metric.of_rdms else (),
    }
    beyond = controls if estimator == "default" else None
    splits = max(len(subject.split_half_r) for subject in animals.subjects)
    stated: dict[str, Any] = {"seed": seed, "splits": splits, "reliability_gate": RELIABILITY_GATE}
    if result is None:
        empty = tuple(LayerScore(label, math.nan, math.nan, "undefined") for label in names)
        parts = tuple(_subject(animals, index, math.nan, math.nan, None) for index in range(len(animals.subjects)))
        if beyond and metric.of_unique_parts:
            part = UniquePart("undefined", ("the score is undefined",))
            stated["statistics"] = {"unique": part.stated}
        return Score(value=math.nan, layers=empty, subjects=parts, provenance=Provenance.of(stated), **about), None
    means = result.layer_values.mean(axis=1)
    best = int(result.competing[evaluation.first_best(means[result.competing, None]).item()])
    chosen = evaluation.most_chosen(result.chosen)
    layer, scored = layers[defined[chosen]], [animals.subjects[i] for i in animals.scored]
    hopeless = evaluation.without_scale(result)
    attainable = math.nan if hopeless else result.attainable
    null = result.test.null[np.isfinite(result.test.null)]
    if hopeless:
        earlier = about["reasons"]
        about |= {"status": "unreliable", "reasons": (hopeless, *earlier) if status == "ok" else (*earlier, hopeless)}
    statistics = {
        "monte_carlo_error": {
            "value": _splits_error(result.values, scored, metric.comparison) if metric.of_rdms else metric.value_error,
            "p": result.test.monte_carlo_error,
            "chance": 0.0 if result.test.exact else float(null[1:].std(ddof=1) / math.sqrt(len(null))),
            "attainable": result.attainable_error,
        },
        **metric.statistics(metric.take(layer, animals.order), animals.sorted, seed),
    }
    if result.layer_null.size:
        tests = zip(
            defined, *(p.tolist() for p in permutation.layer_p(result.layer_null, result.competing)), strict=True
        )
        statistics["layer_tests"] = [{"layer": name, "p": p, "p_corrected": corrected} for name, p, corrected in tests]
    if beyond:
        how = {"attainable": attainable, "committed": committed, "seed": seed}
        if part := metric.unique(layers, beyond, scored, animals.factors(animals.scored), **how):
            statistics["unique"] = part.stated
    rows = {label: row for row, label in enumerate(defined)}
    repeated = f"{'layer chosen' if estimator == 'default' else 'maximum over layers taken'} anew in each"
    value = float(result.values.mean())
    score = Score(
        value=value,
        r=float(result.r.mean()),
        interval=two_factor_interval(value, result.values, result.without),
        p=result.test.p,
        p_method=result.test.summary(1 if result.rule.kind in ("fixed", "each") else len(result.competing), repeated),
        layer=defined[chosen],
        layer_rule=result.rule.words,
        best_layer=defined[best],
        best_layer_value=float(means[best]),
        layers=tuple(_layer_score(label, rows.get(label), result, status) for label in names),
        subjects=_subjects(metric, layers, animals, result, defined),
        model_rdm=evaluation.recorded_rdm(layer) if metric.of_rdms else (),
        chance=float(finite_mean(null)),
        attainable=attainable,
        without_stimulus=tuple(result.without[np.argsort(animals.order)].tolist()),
        provenance=Provenance.of({"statistics": statistics, **stated}),
        **about,
    )
    return held_to_scale(score), result.test


def _verdict(
    metric: MetricHooks,
    animals: evaluation.Animals,
    lacking: Mapping[str, Sequence[str]],
    defined: Sequence[str],
    stimuli: int,
    estimator: str,
    result: evaluation.LayerEvaluation | None,
    committed: str | None,
) -> tuple[Status, tuple[str, ...]]:
    """Return the status of the score and its reasons, the gravest first; ``lacking`` are layers without a value."""
    if result is None:
        if stimuli < metric.fewest:
            reason = f"{stimuli} stimuli are too few for the metric {metric.name!r}, which needs {metric.fewest}"
        elif committed is not None and committed not in defined and animals.scored:
            why = next(words for words, layers in lacking.items() if committed in layers)
            reason = f"activations of the layer committed to, {committed!r}, are {why}"
        elif not defined:
            why = ", ".join(words for words, layers in lacking.items() if layers)
            reason = f"activations of every layer are {why}"
        elif not animals.scored:
            reason = "no animal can be used"
        else:
            reason = "the only animal's halves have no RDM, so no layer can be chosen"
        return "undefined", (reason, *animals.reasons)
    reasons = list(result.test.reason and [result.test.reason])
    if not animals.reliable:
        reasons.append("no animal is reliable" if estimator == "default" else "the published estimator has no gate")
    reasons += animals.reasons
    if result.rule.kind == "maximum":
        reasons.append("optimistic: the layer was chosen as the maximum on the data that are scored")
    without_value = {why: ", ".join(found) for why, found in lacking.items() if found}
    reasons += [f"layers without a value ({why}), never chosen: {names}" for why, names in without_value.items()]
    reasons += [*metric.reasons, *interval_reasons(len(animals.scored), stimuli)]
    unreliable = not animals.reliable or stimuli < permutation.SMALLEST_STIMULI
    return "unreliable" if unreliable else "ok", tuple(reasons)


def _layer_score(label: str, row: int | None, result: evaluation.LayerEvaluation, status: Status) -> LayerScore:
    if row is None:
        return LayerScore(label, math.nan, math.nan, "undefined")
    values, r = result.layer_values[row], result.layer_r[row]
    return LayerScore(label, float(values.mean()), float(r.mean()), status, t_interval(values, over="animals"))


def _subjects(
    metric: MetricHooks,
    layers: Mapping[str, Any],
    animals: evaluation.Animals,
    result: evaluation.LayerEvaluation,
    names: Sequence[str],
) -> tuple[SubjectScore, ...]:
    """Return every animal's part; one that did not vote meets the layer that the others chose."""
    overall = names[evaluation.most_chosen(result.chosen)]
    parts = []
    for index, subject in enumerate(animals.subjects):
        if index in animals.scored:
            row = animals.scored.index(index)
            part = float(result.values[row]), float(result.r[row]), names[int(result.chosen[row])]
        elif index in animals.usable:
            r = evaluation.LayerComparisons(metric, [layers[overall]], [subject]).given()
            value = float(result.scale(r, [names.index(overall)])[0, 0]) * animals.corrections[index].value
            part = value, float(r[0, 0]), overall
        else:
            part = math.nan, math.nan, None
        parts.append(_subject(animals, index, *part))
    return tuple(parts)


def _subject(animals: evaluation.Animals, index: int, value: float, r: float, layer: str | None) -> SubjectScore:
    subject, correction = animals.subjects[index], animals.corrections[index]
    status = "undefined" if math.isnan(value) else correction.status
    return SubjectScore(subject.subject, value, r, correction.reliability, status, subject.units, subject.trials, layer)


def _splits_error(values: Floats, subjects: Sequence[Any], comparison: str) -> float:
    """Return the standard error of the mean score over animals from the finite number of random splits.

    Splits are independent draws given the trials, so their mean h has the standard error s/√S. Values are over √h
    where h is the reliability itself, as of unbiased distances, and over √(2h/(1 + h)) where h is a correlation of
    halves; the delta method makes value · se / 2h of the one and value · se / (2h(1 + h)) of the other.
    """
    errors = []
    for value, subject in zip(values, subjects, strict=True):
        signal = subject.signal_by(comparison)
        splits = signal if signal.size else subject.split_half_by(comparison)
        finite = splits[np.isfinite(splits)]
        h = float(finite.mean()) if finite.size else math.nan
        spread = float(finite.std(ddof=1)) / math.sqrt(finite.size) if finite.size > 1 else math.nan
        # A reliability is held at 1, where nothing is divided.
        slope = (0.0 if h >= 1 else 1 / (2 * h)) if signal.size else 1 / (2 * h * (1 + h))
        errors.append(float(value) * spread * slope)
    # Splits of different animals are independent, so squared errors add up in the mean over animals.
    return math.sqrt(sum(error**2 for error in errors)) / len(errors)


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
    count = len(stimuli)
    animals = evaluation.gather(metric, subjects, count, estimator=estimator)
    compared = animals.scored if count >= metric.fewest and len(animals.scored) > 1 else ()
    others = {i: [animals.subjects[j] for j in compared if j != i] for i in compared}
    factors = {i: metric.agreement(animals.subjects[i], others[i], estimator) for i in compared}
    pairs = []
    for i in compared:
        animal, partner = animals.subjects[i], metric.partner(animals.subjects[i], others[i])
        sides = [metric.take(partner, animals.order)], [animal.take(animals.order)]
        pairs.append(evaluation.LayerComparisons(metric, *sides))
    raw = {i: float(pair.given()[0, 0]) for i, pair in zip(compared, pairs, strict=True)}
    values = {i: raw[i] * factors[i].value for i in compared}
    valid = [i for i in compared if math.isfinite(values[i])]
    parts = np.array([values[i] for i in valid])
    null, without, chance = np.empty(0), np.empty(0), math.nan
    if valid and len(valid) == len(compared):
        weights = np.array([factors[i].value for i in valid])
        without = np.stack([pair.without_each()[:, 0, 0] for pair in pairs], axis=1) @ weights / len(weights)
        if count >= permutation.SMALLEST_STIMULI:
            null = _agreement_null(metric, animals, weights, seed)
            # The others' stimuli are permuted together, as those of a model are.
            orders = list(permutation.label_orders(count, seed, exact=0, draws=metric.orders_between))[1:]
            chance = float(np.mean([np.mean(next(pair.under(lambda: orders))) for pair in pairs] * weights))
    smallest = smallest_p_of_animals(count, max(2, len(compared)), metric.orders_between)
    status, reasons = _agreement_verdict(metric, animals, factors, valid, count, smallest)
    reliability, reliability_interval = evaluation.mean_reliability(animals)
    value = float(parts.mean()) if valid else math.nan
    scored = [animals.subjects[i] for i in valid]
    attained = finite_mean(metric.attainable(scored, seed)) * animals.factors(valid) if valid else np.full(1, math.nan)
    # The two values of two animals are one and the same.
    span = two_factor_interval(value, parts, without) if len(parts) > 2 and without.size else None
    score = Score(
        name="animal-to-animal",
        value=value,
        status=status,
        reasons=reasons,
        r=float(np.mean([raw[i] for i in valid])) if valid else math.nan,
        reliability=reliability,
        reliability_interval=reliability_interval,
        interval=span and replace(span, method=f"{span.method}; approximate, since animals meet one another"),
        p=float((null >= null[0] - permutation.TIE).mean()) if null.size else math.nan,
        p_method=f"one-sided, every animal's labels permuted {metric.orders_between:,} times, (b+1)/(n+1)",
        p_smallest=smallest,
        ceiling=evaluation.ceiling_of(animals, metric.comparison) if metric.of_rdms else None,
        layer_rule="no layers: each animal against the others together",
        subjects=tuple(
            SubjectScore(
                subject=subject.subject,
                value=values.get(index, math.nan),
                r=raw.get(index, math.nan),
                reliability=animals.corrections[index].reliability,
                status=factors[index].status if index in valid else "undefined",
                units=subject.units,
                trials=subject.trials,
            )
            for index, subject in enumerate(animals.subjects)
        ),
        estimator=estimator,
        metric=f"{metric.describe(animals.subjects)}; each animal against the others",
        stimuli=tuple(map(str, stimuli)),
        brain_rdm=evaluation.mean_rdm(animals) if metric.of_rdms else (),
        chance=chance,
        attainable=float(attained.mean()),
        without_stimulus=tuple(without[np.argsort(animals.order)].tolist()) if without.size else (),
        provenance=Provenance.of({"seed": seed, "reliability_gate": RELIABILITY_GATE}),
    )
    return held_to_scale(score)


def _agreement_null(metric: MetricHooks, animals: evaluation.Animals, factors: Floats, seed: int) -> Floats:
    """Return the mean agreement [N] under orders of every animal's stimuli, the given ones first."""
    # Each animal has its own order: one order for all would leave their agreement as it is.
    orders = np.tile(animals.order, (metric.orders_between + 1, len(animals.scored), 1))
    orders[1:] = np.random.default_rng(seed).permuted(orders[1:], axis=-1)
    null = metric.agreement_null([animals.subjects[i] for i in animals.scored], factors, orders)
    return null[np.isfinite(null)] if np.isfinite(null[0]) else np.empty(0)


def _agreement_verdict(
    metric: MetricHooks,
    animals: evaluation.Animals,
    factors: dict[int, Corrected],
    valid: list[int],
    count: int,
    smallest: float,
) -> tuple[Status, tuple[str, ...]]:
    """Return the status of the agreement and its reasons, the gravest first."""
    reasons = tuple(f"{animals.subjects[i].subject}: {factors[i].reason}" for i in factors if factors[i].reason)
    if not valid:
        if count < metric.fewest:
            reasons = (f"{count} stimuli are too few; at least {metric.fewest} are needed",)
        elif not factors:
            reasons = ("fewer than two animals can be used",)
        return "undefined", reasons + animals.reasons
    if count < permutation.SMALLEST_STIMULI:
        reasons = (
            f"{count} stimuli allow no p below {smallest:.3g}; at least {permutation.SMALLEST_STIMULI} are needed",
            *reasons,
        )
    elif len(valid) < len(factors):
        reasons = ("no p: the agreement of some animals is undefined", *reasons)
    if len(valid) == 2:
        reasons += ("two animals make one comparison: no confidence interval",)
    else:
        reasons += interval_reasons(len(valid), count)
    trusted = (
        animals.reliable and count >= permutation.SMALLEST_STIMULI and all(factors[i].status == "ok" for i in factors)
    )
    return "ok" if trusted else "unreliable", reasons + animals.reasons + metric.reasons


def smallest_p_of_animals(stimuli: int, animals: int, draws: int) -> float:
    """Return the smallest p that permuting the animals' stimuli can give."""
    if stimuli < 3:
        return 1.0
    # K!^(A − 1) orders relative to the first animal, as a logarithm, since the number overflows.
    orders = math.lgamma(stimuli + 1) * (animals - 1)
    return max(1 / (draws + 1), math.exp(-min(orders, 700.0)))
