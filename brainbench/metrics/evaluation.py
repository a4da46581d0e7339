"""The layers of a model against the scored animals: comparisons, the choice of layer, and the permutation test."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from brainbench.metrics.animals import Animals
from brainbench.metrics.comparisons import LayerComparisons
from brainbench.metrics.hooks import MetricHooks
from brainbench.metrics.inference.permutation import (
    SMALLEST_STIMULI,
    PermutationTest,
    label_orders,
    make_test,
    most_exact,
    smallest_p,
)
from brainbench.metrics.layers import HALVES, LayerRule, layer_rule, most_chosen, take_layers
from brainbench.metrics.rdms.pairs import Floats, Ints

_CHUNK_ELEMENTS = 1 << 22
_HALVES_IN_PERMUTATIONS = 100
"""Splits of a single animal that every permutation repeats; more only cost time."""


@dataclass(frozen=True)
class LayerEvaluation:
    """A score's parts. L counts the layers that have a value."""

    rule: LayerRule
    values: Floats
    """[A] corrected."""
    r: Floats
    """[A] raw comparisons."""
    chosen: Ints
    """[A] layers."""
    layer_values: Floats
    """[L, A] corrected comparisons of every layer."""
    layer_r: Floats
    without: Floats
    """[K] the score without each stimulus."""
    test: PermutationTest
    layer_null: Floats
    """[N, L] mean of every layer under the orders of the stimuli; empty without a test."""


def defined_layers(metric: MetricHooks, layers: Mapping[str, Floats]) -> list[str]:
    """Return the layers with a value for enough stimuli: at least half of them, and as many as the metric needs."""
    found = []
    for label, layer in layers.items():
        known = metric.known(layer)
        enough = known.sum() >= max(metric.fewest, len(known) / 2)
        if enough and metric.varies(metric.take(layer, np.flatnonzero(known))):
            found.append(label)
    return found


def evaluate(
    compared: LayerComparisons, names: list[str], animals: Animals, estimator: str, committed: str | None, seed: int
) -> tuple[LayerEvaluation | None, list[str], tuple[str, ...]]:
    """Compare, choose layers by the rule and test; also return the layers with a value, and notes."""
    metric, factors = compared.metric, animals.factors(animals.scored)
    given = compared.given()
    kept = np.flatnonzero(np.isfinite(given).all(axis=1)).tolist()
    names, given = [names[row] for row in kept], given[kept]
    if not names or (committed is not None and committed not in names):
        return None, names, ()
    compared = compared.among([compared.layers[row] for row in kept], compared.animals)
    voters = 1 if metric.of_model_alone else len(factors)
    rule = layer_rule(names, voters, committed=committed, estimator=estimator, factors=factors)
    judged, tested, weights = compared, compared, factors
    if rule.kind == "maximum" and estimator == "default" and len(factors) == 1:
        halves = metric.halves(animals.subjects[animals.scored[0]], animals.order)
        if halves is not None:
            parts, factor = halves
            if not parts:
                return None, names, ()
            # The halves stand for animals; fewer of them serve the permutations.
            rule, judged = HALVES, compared.among(compared.layers, parts)
            tested = compared.among(compared.layers, parts[: 2 * _HALVES_IN_PERMUTATIONS])
            weights = np.full(len(parts), factor)
    r = given if judged is compared else judged.given()
    chosen = rule.choose(r)
    held, values = rule.held(r), rule.held(r) * weights
    # The layers of the data serve without a stimulus too: where the choice jumps between layers that are nearly alike,
    # a jackknife that repeats it measures the jumps instead of the stimuli.
    without = take_layers(judged.without_each(), chosen) @ weights / len(weights)
    test, null = _test(tested, rule, weights[: len(tested.animals)], seed)
    if rule is HALVES:
        values, held, chosen = values.mean(keepdims=True), held.mean(keepdims=True), np.array([most_chosen(chosen)])
    found = LayerEvaluation(rule, values, held, chosen, given * factors, given, without, test, null)
    return found, names, _partly(compared, names)


def _test(judged: LayerComparisons, rule: LayerRule, weights: Floats, seed: int) -> tuple[PermutationTest, Floats]:
    """Test the score by orders of the stimuli, the choice of layer repeated in each; also return layers' means."""
    metric, count = judged.metric, judged.animals[0].count
    exact, draws = most_exact(metric.orders), metric.orders
    smallest = smallest_p(count, draws)
    if count < SMALLEST_STIMULI:
        reason = f"{count} stimuli allow no p below {smallest:.3g}; at least {SMALLEST_STIMULI} are needed"
        return PermutationTest(math.nan, smallest, True, 0, math.nan, np.empty(0), reason), np.empty((0, 0))
    step = max(1, _CHUNK_ELEMENTS // (len(judged.layers) * max(count * count, len(judged.animals))))
    null, means = [], []
    for r in judged.under(partial(label_orders, count, seed, exact=exact, draws=draws, step=step)):
        null.append(rule.held(r) @ weights / len(weights))
        means.append((r * weights).mean(axis=-1))
    found = np.concatenate(null)
    # An order under which a comparison has no value says nothing.
    found = np.where(np.isfinite(found), found, -np.inf)
    return make_test(found, exact=count <= exact, smallest=smallest), np.concatenate(means)


def attainable_value(metric: MetricHooks, animals: Animals, result: LayerEvaluation, seed: int) -> tuple[float, str]:
    """Return the value of a perfect model, NaN where chance reaches it in one of twenty orders, and why."""
    raw = metric.attainable([animals.subjects[i] for i in animals.scored], seed)
    found = float((raw * animals.factors(animals.scored)).mean())
    null = result.test.null[np.isfinite(result.test.null)]
    if null.size and not found > (reached := float(np.quantile(null, 0.95))):
        return math.nan, f"no scale: a perfect model would score {found:.2f}, which chance reaches ({reached:.2f})"
    return found, ""


def _partly(compared: LayerComparisons, names: Sequence[str]) -> tuple[str, ...]:
    counts = [(name, (~known).sum(), len(known)) for name, known in zip(names, compared.known, strict=True)]
    lacking = [f"{name} ({number} of {count})" for name, number, count in counts if number]
    if not lacking:
        return ()
    return (f"layers without a value for some stimuli, compared over the others: {', '.join(lacking)}",)
