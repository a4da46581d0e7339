"""Metrics of patterns: models' features [K, F] against animals' mean responses [K, U].

:class:`PatternMetric` holds what all of them share: the choice of layer on the other animals, the
permutation of stimuli with that choice in every order, the interval over animals, and the animals
against one another (each predicted from the joined units of the others). A subclass says how two
patterns compare.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.core.provenance import Provenance
from brainbench.core.records import Interval, LayerScore, Score, Status
from brainbench.core.trials import Trials
from brainbench.metrics.arrays import fetch
from brainbench.metrics.inference.intervals import interval_reasons, t_interval
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, label_orders, make_test
from brainbench.metrics.layers import choose_on_others, held_out, most_chosen
from brainbench.metrics.measures.animal_patterns import (
    AnimalPatterns,
    PatternAnimals,
    animal_patterns,
    gather_patterns,
    subject_scores,
)
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.score import layer_table
from brainbench.metrics.stimulus_labels import response_matrix

ORDERS = 999
"""Random orders of the stimuli above six; up to six all are taken."""

_EXACT_STIMULI = 6


class PatternMetric:
    """Base of metrics that compare patterns. Subclasses set ``name``, ``title`` and write ``similarity``.

    A subclass whose comparison is corrected for noise sets ``corrected`` and overrides :meth:`compare`,
    or :meth:`compare_orders` where all orders can be computed at once.
    """

    name = ""
    title = ""
    corrected = False
    """True when values are corrected for noise, so that animals below the reliability gate do not count."""

    def similarity(self, model: Floats, brain: Floats) -> float:
        """Return how alike features [K, F] and mean responses [K, U] are; larger is more alike.

        Raises:
            UsageError: the metric does not define it.
        """
        raise UsageError(f"The metric {self.name or type(self).__name__!r} does not define similarity(model, brain).")

    def compare(self, model: Floats, brain: AnimalPatterns) -> float:
        """Return the value for one layer and one animal; NaN where there is none."""
        return float(self.similarity(model, brain.patterns))

    def compare_orders(self, model: Floats, animals: Sequence[AnimalPatterns], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        return np.array([[self.compare(model[order], animal) for animal in animals] for order in orders])

    def statistics(self, model: Floats, animals: Sequence[Any], seed: int) -> dict[str, Any]:
        """Return what else a record keeps of the chosen layer's features [K, F]; nothing unless overridden."""
        return {}

    def animal(
        self,
        subject: str,
        blocks: Sequence[Trials],
        n_stimuli: int,
        *,
        stimuli: Sequence[str] | None = None,
        seed: int = 0,
        draws: int = 0,
    ) -> AnimalPatterns:
        """Return the animal's mean responses; nothing here is random."""
        return self.prepare(animal_patterns(subject, blocks, n_stimuli, stimuli=stimuli), blocks)

    def prepare(self, animal: AnimalPatterns, blocks: Sequence[Trials]) -> AnimalPatterns:
        """Return the animal with what else its trials tell; as it is unless overridden."""
        return animal

    def score(
        self,
        features: Mapping[str, ArrayLike],
        animals: Sequence[AnimalPatterns],
        *,
        name: str,
        stimuli: Sequence[str],
        estimator: str = "default",
        seed: int = 0,
    ) -> Score:
        """Score a model by the features [K, F] of its layers.

        Raises:
            UsageError: no layers or animals, features of another number of stimuli, or a published estimator.
        """
        check_features(self.name, features, stimuli, estimator)
        layers = {layer: fetch(response_matrix(values, "stimuli")).astype(float) for layer, values in features.items()}
        about = {"name": name, "metric": f"{self.name}: {self.title}", "stimuli": tuple(map(str, stimuli))}
        return self.score_layers(layers, gather_patterns(animals, self.corrected), about, seed)

    def score_layers(
        self, layers: Mapping[str, Floats], found: PatternAnimals, about: dict[str, Any], seed: int
    ) -> Score:
        """Score each animal with the layer chosen on the others, averaged."""
        stimuli = about["stimuli"]
        usable = [
            layer for layer, values in layers.items() if np.isfinite(values).all() and np.ptp(values, axis=0).any()
        ]
        if len(stimuli) < SMALLEST_STIMULI:
            return undefined(about, _few_stimuli(len(stimuli)), found)
        if not usable:
            return undefined(about, "activations of every layer are constant or not finite", found)
        if not found.scored:
            return undefined(about, "no animal can be used", found)
        orders = pattern_orders(len(stimuli), seed)
        scored = [found.animals[i] for i in found.scored]
        # [N, L, A] under every order, so that the choice of layer and the mean are repeated in each.
        values = np.stack([self.compare_orders(layers[layer], scored, orders) for layer in usable], axis=1)
        # An animal without a value for some layer in the given order takes no part, in any order.
        known = np.isfinite(values[0]).all(axis=0)
        if not known.any():
            return undefined(about, "the metric has no value for any animal", found)
        values, scored = values[..., known], [animal for animal, keep in zip(scored, known, strict=True) if keep]
        chosen, held, rule = _chosen_layers(values)
        layer = usable[most_chosen(chosen)]
        means = dict(zip(usable, values[0].mean(axis=-1).tolist(), strict=True))
        by_subject = {a.subject: (float(v), usable[int(c)]) for a, v, c in zip(scored, held[0], chosen, strict=True)}
        status: Status = "ok" if found.reliable else "unreliable"
        return make_score(
            about,
            # The score under every order, with the layer chosen anew in each; the first is the observed one.
            held.mean(axis=-1),
            seed,
            {"layer_tests": layer_table(usable, values.mean(axis=-1))} | self.statistics(layers[layer], scored, seed),
            status=status,
            reasons=self._reasons(found, len(scored)),
            reliability=float(np.mean([animal.reliability for animal in scored])),
            interval=t_interval(held[0]),
            layer=layer,
            layer_rule=rule,
            layers=layer_scores(layers, means, status, dict(zip(usable, map(t_interval, values[0]), strict=True))),
            subjects=subject_scores(found, by_subject),
        )

    def score_animals(
        self, animals: Sequence[AnimalPatterns], *, stimuli: Sequence[str], estimator: str = "default", seed: int = 0
    ) -> Score:
        """Score the animals by their mean responses.

        Raises:
            UsageError: no animals, or a published estimator.
        """
        check_features(self.name, {"animals": None}, stimuli, estimator)
        about = {
            "name": "animal-to-animal",
            "metric": f"{self.name}: {self.title}",
            "stimuli": tuple(map(str, stimuli)),
        }
        return self.score_agreement(gather_patterns(animals, self.corrected), about, seed)

    def score_agreement(self, found: PatternAnimals, about: dict[str, Any], seed: int) -> Score:
        """Score each animal against the joined units of the others."""
        stimuli = about["stimuli"]
        about["metric"] += "; each animal against the joined units of the others"
        about["layer_rule"] = "no layers: each animal against the others"
        scored = [found.animals[i] for i in found.scored]
        if len(scored) < 2:
            return undefined(about, "fewer than two animals can be used", found)
        if len(stimuli) < SMALLEST_STIMULI:
            return undefined(about, _few_stimuli(len(stimuli)), found)
        orders = pattern_orders(len(stimuli), seed)
        columns = []
        for animal in scored:
            # The others' units side by side, as if they were one animal.
            others = np.concatenate([other.patterns for other in scored if other is not animal], axis=1)
            # Every order moves the stimuli of the others together, as those of one model.
            columns.append(self.compare_orders(others, [animal], orders))
        values = np.concatenate(columns, axis=1)
        by_subject: dict[str, tuple[float, str | None]] = {
            animal.subject: (float(v), None) for animal, v in zip(scored, values[0], strict=True)
        }
        reasons = self._reasons(found, len(scored))
        if not np.isfinite(values[0]).all():
            return Score(value=math.nan, status="undefined", reasons=("the metric has no value", *reasons), **about)
        return make_score(
            about,
            values.mean(axis=-1),
            seed,
            {},
            status="ok" if found.reliable else "unreliable",
            reasons=reasons,
            reliability=float(np.mean([animal.reliability for animal in scored])),
            interval=t_interval(values[0]) if len(scored) > 2 else None,
            subjects=subject_scores(found, by_subject),
        )

    def _reasons(self, found: PatternAnimals, scored: int) -> tuple[str, ...]:
        """Say what to heed, the gravest first."""
        unreliable = () if found.reliable else ("no animal's responses are reliable",)
        raw = (
            () if self.corrected else ("not corrected for noise: compare with the animal-to-animal value, not with 1",)
        )
        return (*unreliable, *found.reasons, *raw, *interval_reasons(scored))


def check_features(metric: str, features: Mapping[str, Any], stimuli: Sequence[str], estimator: str) -> None:
    """Raise UsageError for a published estimator, no layers, or features of another number of stimuli."""
    if estimator != "default":
        raise UsageError(f"The estimator {estimator!r} is one of RSA; the metric {metric!r} has 'default' only.")
    if not features:
        raise UsageError("There are no layers to score; give the features of at least one layer.")
    for layer, values in features.items():
        rows = len(stimuli) if values is None else len(np.asarray(values))
        if rows != len(stimuli):
            raise UsageError(f"The features of layer {layer!r} have {rows} rows; {len(stimuli)} stimuli are scored.")


def pattern_orders(stimuli: int, seed: int, draws: int = ORDERS) -> Ints:
    """Return orders of the stimuli [N, K], the given one first: all up to six stimuli, else random ones."""
    return np.concatenate(list(label_orders(stimuli, seed, exact=_EXACT_STIMULI, draws=draws)))


def undefined(about: Mapping[str, Any], reason: str, found: PatternAnimals) -> Score:
    """Return a score without a value."""
    return Score(value=math.nan, status="undefined", reasons=(reason, *found.reasons), **about)


def make_score(
    about: Mapping[str, Any],
    null: Floats,
    seed: int,
    statistics: Mapping[str, Any],
    *,
    layers: tuple[LayerScore, ...] = (),
    smallest: float | None = None,
    **fields: Any,
) -> Score:
    """Return the score whose value is the first of the statistics [N] under every order of the stimuli."""
    # The given order is the first of the orders, so the value is the first of the statistics.
    test = make_test(null, exact=len(about["stimuli"]) <= _EXACT_STIMULI, smallest=smallest)
    usable = [layer for layer in layers if layer.status != "undefined"]
    best = max(usable, key=lambda layer: layer.value, default=None)
    return Score(
        value=test.observed,
        r=test.observed,
        p=test.p,
        p_method=test.summary(max(1, len(usable))),
        p_smallest=test.smallest,
        layers=layers,
        best_layer=best and best.layer,
        best_layer_value=best.value if best else math.nan,
        provenance=Provenance.of({"statistics": dict(statistics), "seed": seed}),
        **fields,
        **about,
    )


def layer_scores(
    layers: Iterable[str],
    means: Mapping[str, float],
    status: Status = "ok",
    intervals: Mapping[str, Interval | None] | None = None,
) -> tuple[LayerScore, ...]:
    """Return the mean value of every layer; layers without one are undefined."""
    return tuple(
        LayerScore(layer, means[layer], means[layer], status, (intervals or {}).get(layer))
        if layer in means
        else LayerScore(layer, math.nan, math.nan, "undefined")
        for layer in layers
    )


def _few_stimuli(stimuli: int) -> str:
    return f"{stimuli} stimuli are too few to leave one out; at least {SMALLEST_STIMULI} are needed"


def _chosen_layers(values: Floats) -> tuple[Ints, Floats, str]:
    """Return the layers [A] chosen, the values [N, A] held out under every order, and the rule in words."""
    if values.shape[1] == 1:
        return np.zeros(values.shape[2], dtype=np.int64), values[:, 0], "only layer"
    if values.shape[2] == 1:
        rule = "maximum over layers on the only animal (optimistic; the permutation takes the same maximum)"
        return np.argmax(values[0], axis=0), values.max(axis=1), rule
    rule = "chosen on the other animals, evaluated on the animal held out"
    # held_out chooses anew in every order; the layers that are reported are those of the given one.
    return choose_on_others(values[0]), held_out(values), rule
