"""One board of a recovery: animals drawn from a candidate network, and the score of every candidate against them.

Scores are those of the engine, :func:`brainbench.metrics.score.score_layers`, with few orders of the stimuli: the
value, chance and what is attainable need no p. Letters: A animal, C candidate, F feature, K stimulus.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import combinations
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, brief, repeats, unknown_name
from brainbench.core.files import content_hash
from brainbench.core.limits import Count, Limit, Seed, limited
from brainbench.core.progress import Progress, track
from brainbench.core.reading.ranges import check_number
from brainbench.core.records import Score
from brainbench.core.statistics import compare_scores
from brainbench.datasets.synthetic.populations import PopulationDesign, ResponseGeometry, principal_axes
from brainbench.metrics.inference.multiple import adjust
from brainbench.metrics.measures.metric import Metric, get_metric
from brainbench.metrics.rdms.pairs import Ints
from brainbench.metrics.score import score_layers
from brainbench.scoring.options import ScoreOptions

FEWEST_STIMULI = 4  # fewest stimuli whose RDMs can be compared after one is left out


@dataclass(frozen=True)
@limited(of="{} of a recovery")
class RecoveryDesign:
    """An experiment that is repeated on the computer with every candidate in turn as the truth."""

    population: PopulationDesign = field(default_factory=PopulationDesign)
    """Animals, units, trials and noise."""
    stimuli: Annotated[int, Limit(least=FEWEST_STIMULI)] | None = None
    """Stimuli of one board, drawn anew for each from those that the candidates saw; all of them by default."""
    metric: str = "rsa"
    """Metric of the scores."""
    layer: str = "any"
    """Layer whose units the animals mix: any (drawn anew for each board), last, or the name of one."""
    splits: Count = 100
    """Split halves that tell the reliability of an animal's RDM."""
    orders: Annotated[int, Limit(least=40)] = 50
    """Random orders of the stimuli that tell the score expected by chance; the observed score counts among them, so
    with fewer than about 40 it looks like chance."""
    seed: Seed = 0
    """Seed of the animals."""


def parse_trials(text: str) -> int | tuple[int, int]:
    """Return the trials of a stimulus: ``18``, or the fewest and the most as in ``16-20``.

    >>> parse_trials("16-20")
    (16, 20)
    """
    match = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", text)
    first, last = (int(part or 0) for part in match.groups()) if match else (0, 0)
    if first < 1 or (match and match[2] and last < first):
        raise UsageError(f"Trials are a number above 0 or a range such as 16-20; received {brief(text)}.")
    return (first, last) if last else first


@dataclass(frozen=True)
class Candidate:
    """A network that may have made the data."""

    name: str
    stimuli: tuple[str, ...]
    """[K] names."""
    features: Mapping[str, NDArray[np.float64]]
    """Layer → [K, F]; without layers that are the same for all stimuli or not finite."""
    weights: str | None = None
    """Content hash of its weights."""

    @classmethod
    def of(
        cls, name: str, stimuli: Sequence[str], layers: Mapping[str, ArrayLike], weights: str | None = None
    ) -> Candidate:
        """Take the layers that can be compared."""
        usable = {}
        for layer, values in layers.items():
            array = np.asarray(values, dtype=np.float64)
            if array.ndim != 2 or len(array) != len(stimuli):
                raise UsageError(f"Layer {layer!r} of {name} is {list(array.shape)}; expected [{len(stimuli)}, F].")
            if np.isfinite(array).all() and np.ptp(array, axis=0).any():
                usable[str(layer)] = array
        if not usable:
            raise UsageError(f"No layer of {name} differs between the stimuli, so nothing can be drawn from it.")
        return cls(name, tuple(stimuli), usable, weights)

    def choose(self, layer: str, random: np.random.Generator) -> str:
        """Return the layer that ``any``, ``last`` or a name means."""
        names = list(self.features)
        if layer in names:
            return layer
        if layer not in ("any", "last"):
            raise unknown_name(f"layer of {self.name}", layer, ["any", "last", *names])
        return names[-1] if layer == "last" else names[int(random.integers(len(names)))]

    def geometry(self, layer: str, rows: NDArray[np.int64]) -> ResponseGeometry:
        """Return the Euclidean geometry of a layer for some stimuli.

        Features are mixed as they are, not standardised, so that the truth is the layer's own RDM of squared
        Euclidean distances.
        """
        directions = self._axes[layer][rows]
        directions = directions - directions.mean(axis=0)
        size = np.sqrt((directions**2).sum() / len(rows))
        return ResponseGeometry(directions / (size or 1.0), tuple(self.stimuli[row] for row in rows))

    def layers(self, metric: Metric) -> dict[str, NDArray[np.float64]]:
        """Return what a metric compares of every layer, computed once."""
        key = (metric.name, str(metric))
        if key not in self._layers:
            self._layers[key] = {name: metric.layer(values) for name, values in self.features.items()}
        return self._layers[key]

    @cached_property
    def _layers(self) -> dict[tuple[str, str], dict[str, NDArray[np.float64]]]:
        return {}

    @cached_property
    def _axes(self) -> dict[str, NDArray[np.float64]]:
        """Layer → [K, ≤ K] stimuli on the principal axes of its features: the same distances in fewer columns."""
        return {layer: principal_axes(values - values.mean(axis=0)) for layer, values in self.features.items()}

    @property
    def identity(self) -> str:
        """Content hash of its name, stimuli and features."""
        parts = [part for layer, values in self.features.items() for part in (layer, values)]
        return content_hash(self.name, list(self.stimuli), *parts)


def open_candidates(
    models: Sequence[Any], options: ScoreOptions, *, progress: Progress | None = None
) -> tuple[tuple[Candidate, ...], dict[str, Any]]:
    """Run the models on the stimuli of ``options``; return them as candidates, and the provenance of the stimuli."""
    from brainbench.scoring.model_responses import resolve_model
    from brainbench.stimuli import load_stimuli

    check_number("number of candidates, which a recovery tells apart,", len(models), least=2)
    # Whatever can be wrong with a name is found before stimuli are simulated.
    resolved = [resolve_model(model, seed=options.model_seed) for model in models]
    names = [item.card.name for item in resolved]
    if twice := repeats(names):
        raise UsageError(f"The candidate {twice[0]!r} is given twice; candidates have different names.")
    if any(item.labels is None for item in resolved):
        how = {"whiskers": options.whiskers, "fidelity": options.fidelity}
        simulated = load_stimuli(options.stimuli or "objects", **how, progress=progress)
        options, stimuli = replace(options, stimuli=simulated, whiskers="all"), simulated.labels
    else:  # activations from files alone, whose labels name the stimuli
        stimuli = next(item.labels for item in resolved if item.labels)
    candidates, origin = [], {}
    for network in track(resolved, "running networks", progress):
        responses = network.respond(options)
        lacking = [label for label in stimuli if label not in responses.labels]
        if lacking:
            raise UsageError(f"{network.card.name} has no activations for the stimulus {lacking[0]!r}.")
        rows = [responses.labels.index(label) for label in stimuli]
        candidates.append(Candidate.of(network.card.name, stimuli, responses.features(rows), responses.card.weights))
        origin = dict(responses.origin.get("stimuli") or origin)
    return tuple(candidates), origin


LEVEL = 0.05  # false discovery rate over all pairs of a board


@dataclass(frozen=True)
class RecoveryBoard:
    """Result of one board that a recovery keeps."""

    true: int
    """Candidate from which the animals were drawn."""
    number: int
    layer: str
    """Layer whose units they mix."""
    scaled: tuple[float, ...]
    """[C] scores between chance (0) and all that is reliable (1)."""
    verdicts: tuple[int, ...]
    """[C] 1 where the true candidate is told apart above this one, −1 below, 0 where they tie."""
    reliability: float
    """Mean split-half reliability of the animals."""

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> RecoveryBoard:
        """Rebuild a board from its JSON, where a missing number is null."""
        scaled = tuple(math.nan if value is None else float(value) for value in data["scaled"])
        reliability = math.nan if data["reliability"] is None else float(data["reliability"])
        return cls(data["true"], data["number"], data["layer"], scaled, tuple(data["told"]), reliability)

    @property
    def stored(self) -> dict[str, Any]:
        """The board as files hold it: :meth:`of` reads it."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {("told" if name == "verdicts" else name): value for name, value in values.items()}

    @property
    def first(self) -> int | None:
        """Candidate with the highest score; None where no score is defined or the highest is shared."""
        values = np.array(self.scaled)
        if not np.isfinite(values).any():
            return None
        best = np.flatnonzero(values == np.nanmax(values))
        return int(best[0]) if len(best) == 1 else None


def make_board(candidates: Sequence[Candidate], design: RecoveryDesign, true: int, number: int) -> RecoveryBoard:
    """Draw the animals of a board from candidate ``true`` and score all candidates, by the arguments alone."""
    layer, rows, animals = draw_board(candidates, design, true, number)
    scores = score_board(candidates, rows, animals, design)
    scaled, verdicts = tuple(score.scaled for score in scores), tuple(told_apart(scores)[true].tolist())
    return RecoveryBoard(true, number, layer, scaled, verdicts, scores[true].reliability)


def draw_board(
    candidates: Sequence[Candidate], design: RecoveryDesign, true: int, number: int
) -> tuple[str, Ints, tuple[Any, ...]]:
    """Return the true layer, the stimuli [K] that are shown, and the animals as the metric prepares them."""
    from brainbench.datasets.synthetic.populations import draw_animals

    stream = (design.seed, true, number)
    random = np.random.default_rng(stream)
    pool = len(candidates[true].stimuli)
    count = design.stimuli or pool
    rows = np.sort(random.permutation(pool)[:count]) if count < pool else np.arange(pool)
    layer = candidates[true].choose(design.layer, random)
    metric, animals = get_metric(design.metric), []
    for subject, sessions in draw_animals(candidates[true].geometry(layer, rows), design.population, stream).items():
        trials = [replace(item, responses=item.responses[:, 0]) for item in sessions]
        animals.append(metric.animal(subject, trials, count, seed=design.seed, splits=design.splits))
    return layer, rows, tuple(animals)


def score_board(
    candidates: Sequence[Candidate], rows: Ints, animals: Sequence[Any], design: RecoveryDesign
) -> list[Score]:
    """Return the score of every candidate against prepared animals, over the stimuli ``rows`` [K]."""
    metric = copy.copy(get_metric(design.metric))
    # Metrics may be frozen; the copy is ours.
    object.__setattr__(metric, "orders", design.orders)
    scores = []
    for candidate in candidates:
        layers = {name: metric.take(layer, rows) for name, layer in candidate.layers(metric).items()}
        labels = [candidate.stimuli[row] for row in rows]
        scores.append(score_layers(metric, layers, animals, name=candidate.name, stimuli=labels, seed=design.seed)[0])
    return scores


def told_apart(scores: Sequence[Score]) -> Ints:
    """Return [C, C]: 1 where a candidate is told apart above another, −1 below, 0 where they tie.

    By the test of a board (:func:`brainbench.core.statistics.compare_scores`: differences of scaled scores
    over animals and stimuli), false discovery rate 5 % over all pairs.
    """
    result = np.zeros((len(scores), len(scores)), dtype=np.int64)
    places = list(combinations(range(len(scores)), 2))
    tests = [compare_scores(scores[first], scores[second]) for first, second in places]
    for (first, second), test, p in zip(places, tests, adjust([test.p for test in tests], "fdr"), strict=True):
        if p <= LEVEL:
            result[first, second] = 1 if test.difference > 0 else -1
            result[second, first] = -result[first, second]
    return result
