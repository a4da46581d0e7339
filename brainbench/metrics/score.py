"""The engine of all metrics: from layers and animals to a :class:`brainbench.core.records.Score`.

A metric compares all layers with all animals; what is done with the comparisons is the same for each: the choice of
layer, the permutation test that repeats it, chance, what is attainable, the interval over animals and stimuli, and a
verdict in words.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from brainbench.core.errors import check_name, check_once
from brainbench.core.provenance import Provenance
from brainbench.core.records import LayerScore, Score, Status, SubjectScore
from brainbench.core.statistics import t_interval, two_factor_interval
from brainbench.metrics.animals import Animals, ceiling_of, gather, mean_rdm, mean_reliability, recorded_rdm
from brainbench.metrics.arrays import finite_mean
from brainbench.metrics.comparisons import LayerComparisons
from brainbench.metrics.evaluation import LayerEvaluation, attainable_value, defined_layers, evaluate
from brainbench.metrics.hooks import MetricHooks
from brainbench.metrics.inference.intervals import held_to_scale, interval_reasons
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, PermutationTest, layer_p, smallest_p
from brainbench.metrics.layers import first_best, most_chosen
from brainbench.metrics.rdms.pairs import Floats
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE


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
) -> tuple[Score, PermutationTest | None]:
    """Score the layers of a model against animals; also return the permutation test with all statistics.

    ``layers`` are what :meth:`Metric.layer` made of each layer, in network order, ``subjects`` what
    :meth:`Metric.animal` made of each animal. ``committed`` is a layer that was chosen before anything was scored;
    without a torch ``device`` numpy computes the permutations.
    """
    check_once("A score", map(str, stimuli))
    if committed is not None:
        check_name("layer", committed, layers)
    animals = gather(metric, subjects, len(stimuli), estimator=estimator)
    names, result, notes = list(layers), None, ()
    usable = defined = defined_layers(metric, layers)
    if animals.scored and defined and len(stimuli) >= metric.fewest:
        taken = [metric.take(layers[label], animals.order) for label in defined]
        compared = LayerComparisons(metric, taken, animals.sorted, device)
        result, defined, notes = evaluate(compared, defined, animals, estimator, committed, seed)
    lacking = {
        "constant or not finite": [name for name in names if name not in usable],
        "not comparable with every animal": [name for name in usable if name not in defined],
    }
    status, reasons = _verdict(metric, animals, lacking, defined, len(stimuli), estimator, result, committed)
    reliability, reliability_interval = mean_reliability(animals)
    about = {
        "name": name,
        "status": status,
        "reasons": (*reasons[:1], *notes, *reasons[1:]) if result is None else (*notes, *reasons),
        "reliability": reliability,
        "reliability_interval": reliability_interval,
        "p_smallest": smallest_p(len(stimuli), metric.orders),
        "ceiling": ceiling_of(animals, metric.comparison) if metric.of_rdms else None,
        "estimator": estimator,
        "metric": metric.describe(animals.subjects),
        "stimuli": tuple(map(str, stimuli)),
        "brain_rdm": mean_rdm(animals) if metric.of_rdms else (),
    }
    splits = max(len(subject.split_half_r) for subject in animals.subjects)
    stated = {"seed": seed, "splits": splits, "reliability_gate": RELIABILITY_GATE}
    if result is None:
        empty = tuple(LayerScore(label, math.nan, math.nan, "undefined") for label in names)
        parts = tuple(_subject(animals, index, math.nan, math.nan, None) for index in range(len(animals.subjects)))
        return Score(value=math.nan, layers=empty, subjects=parts, provenance=Provenance.of(stated), **about), None
    means = result.layer_values.mean(axis=1)
    best, chosen = first_best(means[:, None]).item(), most_chosen(result.chosen)
    layer, scored = layers[defined[chosen]], [animals.subjects[i] for i in animals.scored]
    attainable, hopeless = attainable_value(metric, animals, result, seed)
    if hopeless:
        told = about["reasons"]
        about |= {"status": "unreliable", "reasons": (hopeless, *told) if status == "ok" else (*told, hopeless)}
    statistics = {
        "monte_carlo_error": {
            "value": _splits_error(result.values, scored, metric.comparison) if metric.of_rdms else 0.0,
            "p": result.test.monte_carlo_error,
        },
        **metric.statistics(metric.take(layer, animals.order), animals.sorted, seed),
    }
    if result.layer_null.size:
        tests = zip(defined, *(p.tolist() for p in layer_p(result.layer_null)), strict=True)
        statistics["layer_tests"] = [{"layer": name, "p": p, "p_corrected": corrected} for name, p, corrected in tests]
    shown = {label: row for row, label in enumerate(defined)}
    repeated = f"{'layer chosen' if estimator == 'default' else 'maximum over layers taken'} anew in each"
    value = float(result.values.mean())
    made = Score(
        value=value,
        r=float(result.r.mean()),
        interval=two_factor_interval(value, result.values, result.without),
        p=result.test.p,
        p_method=result.test.summary(1 if result.rule.kind == "fixed" else len(defined), repeated),
        layer=defined[chosen],
        layer_rule=result.rule.words,
        best_layer=defined[best],
        best_layer_value=float(means[best]),
        layers=tuple(_layer_score(label, shown.get(label), result, status) for label in names),
        subjects=_subjects(metric, layers, animals, result, defined),
        model_rdm=recorded_rdm(layer) if metric.of_rdms else (),
        chance=float(finite_mean(result.test.null)),
        attainable=attainable,
        without_stimulus=tuple(result.without[np.argsort(animals.order)].tolist()),
        provenance=Provenance.of({"statistics": statistics, **stated}),
        **about,
    )
    return held_to_scale(made), result.test


def _verdict(
    metric: MetricHooks,
    animals: Animals,
    lacking: Mapping[str, Sequence[str]],
    defined: Sequence[str],
    stimuli: int,
    estimator: str,
    result: LayerEvaluation | None,
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
    told = {why: ", ".join(found) for why, found in lacking.items() if found}
    reasons += [f"layers without a value ({why}), never chosen: {names}" for why, names in told.items()]
    reasons += [*metric.reasons, *interval_reasons(len(animals.scored), stimuli)]
    unreliable = not animals.reliable or stimuli < SMALLEST_STIMULI
    return "unreliable" if unreliable else "ok", tuple(reasons)


def _layer_score(label: str, row: int | None, result: LayerEvaluation, status: Status) -> LayerScore:
    if row is None:
        return LayerScore(label, math.nan, math.nan, "undefined")
    values, r = result.layer_values[row], result.layer_r[row]
    interval = t_interval(values, over="animals")
    return LayerScore(label, float(values.mean()), float(r.mean()), status, interval)


def _subjects(
    metric: MetricHooks, layers: Mapping[str, Any], animals: Animals, result: LayerEvaluation, names: Sequence[str]
) -> tuple[SubjectScore, ...]:
    """Return every animal's part; one that did not vote meets the layer that the others chose."""
    overall = names[most_chosen(result.chosen)]
    found = []
    for index, subject in enumerate(animals.subjects):
        if index in animals.scored:
            row = animals.scored.index(index)
            part = float(result.values[row]), float(result.r[row]), names[int(result.chosen[row])]
        elif index in animals.usable:
            r = float(LayerComparisons(metric, [layers[overall]], [subject]).given()[0, 0])
            part = r * animals.corrections[index].value, r, overall
        else:
            part = math.nan, math.nan, None
        found.append(_subject(animals, index, *part))
    return tuple(found)


def _subject(animals: Animals, index: int, value: float, r: float, layer: str | None) -> SubjectScore:
    subject, correction = animals.subjects[index], animals.corrections[index]
    status = "undefined" if math.isnan(value) else correction.status
    return SubjectScore(subject.subject, value, r, correction.reliability, status, subject.units, subject.trials, layer)


def _splits_error(values: Floats, subjects: Sequence[Any], comparison: str) -> float:
    """Return the standard error of the mean score over animals from the finite number of random splits.

    Splits are independent draws given the trials, so the mean split-half correlation h has standard
    error s/√S, and value ∝ √((1 + h)/2h) turns it into value · se / (2h(1 + h)).
    """
    errors = []
    for value, subject in zip(values, subjects, strict=True):
        r = subject.split_half_by(comparison)
        finite = r[np.isfinite(r)]
        h = float(finite.mean()) if finite.size else math.nan
        spread = float(finite.std(ddof=1)) / math.sqrt(finite.size) if finite.size > 1 else math.nan
        # Delta method: the derivative of ln √((1 + h)/2h) is −1/(2h(1 + h)).
        errors.append(float(value) * spread / (2 * h * (1 + h)))
    # Splits of different animals are independent, so squared errors add up in the mean over animals.
    return math.sqrt(sum(error**2 for error in errors)) / len(errors)
