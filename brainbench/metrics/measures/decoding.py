"""Decoding of what stimuli have in common, for a model and for each animal (table 3.6 of the work this grew from).

Labels such as ``convex-close`` name properties: the parts between hyphens. Each property that at least two stimuli per
class share is decoded by logistic regression from the patterns of the other stimuli (:func:`decode`), and the value is
the mean accuracy over properties. It is a property of the model alone; the animals' own accuracy stands beside it as
animal to animal.

With two stimuli per class left, chance is not the share of the largest class: leaving a stimulus out makes its class
rarer in training, so accuracies well *below* chance are what a decoder without information gives. The permutation of
classes over stimuli accounts for that, and its mean is the chance level to read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_number
from brainbench.core.records import Score
from brainbench.metrics.arrays import Floats, Ints
from brainbench.metrics.hooks import usable_features
from brainbench.metrics.inference.permutation import label_orders, most_exact, tail_p
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, denoised
from brainbench.metrics.stimulus_labels import response_matrix

ORDERS = 199
"""Random orders of the classes over stimuli that the test takes, where all are more than five times as many."""


@dataclass(frozen=True)
class Decoding:
    """Accuracy of decoding a property of stimuli left out."""

    accuracy: float
    """Mean over left-out stimuli of the share of rows decoded rightly."""
    chance: float
    """One over the number of classes, as published."""
    p: float
    """P(accuracy with the classes in another order over stimuli ≥ observed)."""
    expected: float
    """Mean accuracy over those orders: what no information gives."""
    correct: tuple[float, ...]
    """Share of each stimulus' rows decoded rightly, in order of the stimuli."""
    count: int
    """Orders that were tried, the given one included."""


def decode(
    responses: ArrayLike, stimuli: ArrayLike, classes: Sequence[str], *, penalty: float = 1.0, seed: int = 0
) -> Decoding:
    """Decode a property from activations or trials, leaving one stimulus out.

    Args:
        responses: [R, U] one row per trial, or [K, F] one per stimulus. Stimuli of few trials count as much as others.
        stimuli: [R] stimulus of each row, 0 … K−1.
        classes: [K] class of each stimulus, such as ``["convex", "convex", "concave", …]``.
        penalty: Inverse strength C of the penalty, on features scaled to unit mean square.
        seed: Seed of random orders of the classes, above 6 stimuli.

    >>> decode([[0.], [1], [2], [10], [11], [12]], range(6), list("aaabbb")).accuracy
    1.0
    """
    matrix = response_matrix(responses, "trials").astype(np.float64)
    rows = np.asarray(stimuli)
    names, codes = np.unique(np.asarray(classes, dtype=str), return_inverse=True)
    if rows.shape != (len(matrix),) or sorted(set(rows.tolist())) != list(range(len(codes))):
        raise UsageError(
            f"decode() takes one stimulus 0 … {len(codes) - 1} per row, each at least once; received {len(rows)} for "
            f"{len(matrix)} rows."
        )
    if len(names) < 2 or np.bincount(codes).min() < 2:
        raise UsageError(f"Each of at least 2 classes needs 2 stimuli or more: leaving one out loses it: {classes}.")
    if not np.isfinite(matrix).all():
        raise UsageError("Responses to be decoded must be finite; leave out units or trials with missing values.")
    check_number("The penalty of decoding", penalty, above=0)
    decoder = Decoder(matrix, rows.astype(np.int64), penalty=penalty)
    orders = np.concatenate(list(label_orders(len(codes), seed, exact=most_exact(ORDERS), draws=ORDERS)))
    accuracy = np.array([decoder(codes[order]) for order in orders])
    means = accuracy.mean(axis=1)
    return Decoding(
        accuracy=float(means[0]),
        chance=1 / len(names),
        p=float(tail_p(means)),
        expected=float(means.mean()),
        correct=tuple(accuracy[0].tolist()),
        count=len(orders),
    )


class Decoder:
    """Decodes any assignment of classes to the stimuli of the same rows.

    Names of classes do not matter, so each partition of the stimuli is decoded once. ``matrix`` has one row of finite
    responses each, ``rows`` their stimuli, numbered from 0, each at least once.
    """

    def __init__(self, matrix: Floats, rows: Ints, *, penalty: float = 1.0) -> None:
        self._rows, self._penalty = rows, penalty
        self._folds = [_fold(matrix, rows, stimulus) for stimulus in range(int(rows.max()) + 1)]
        self._known: dict[tuple[int, ...], list[float]] = {}

    def __call__(self, codes: Ints) -> list[float]:
        """Return the share of each stimulus' rows decoded rightly [K], with classes ``codes`` [K]."""
        seen: dict[int, int] = {}
        partition = tuple(seen.setdefault(code, len(seen)) for code in codes.tolist())
        if partition not in self._known:
            self._known[partition] = [_correct(fold, codes, self._rows, self._penalty) for fold in self._folds]
        return self._known[partition]


@dataclass(frozen=True)
class _Fold:
    stimulus: int
    train: Floats  # [R′, D] rows in the span of the training rows, which is all that a penalised fit can use
    test: Floats
    weights: Floats  # [R′] of the rows, the same sum for every stimulus


def _fold(matrix: Floats, rows: Ints, stimulus: int) -> _Fold:
    inside = rows != stimulus
    train, test = matrix[inside], matrix[~inside]
    # Each stimulus counts alike: else the class whose stimuli have the most trials is told wherever nothing is known.
    numbers = np.bincount(rows)[rows[inside]]
    weights = len(numbers) / rows.max() / numbers
    mean = train.mean(axis=0)
    # The left-out stimulus takes no part in mean and scale, or the test would leak into the training.
    train, test = train - mean, test - mean
    # One scale for all features makes the penalty independent of units and keeps the features' proportions.
    scale = math.sqrt(float((train**2).mean())) or 1.0
    if train.shape[1] > len(train):
        # Coordinates in the span of the training rows: a penalised fit gives no weight to what is orthogonal to them.
        basis = np.linalg.svd(train, full_matrices=False)[2]
        train, test = train @ basis.T, test @ basis.T
    return _Fold(stimulus, train / scale, test / scale, weights)


def _correct(fold: _Fold, codes: Ints, rows: Ints, penalty: float) -> float:
    target = codes[rows[rows != fold.stimulus]]
    weight, bias = fit_softmax(fold.train, target, int(codes.max()) + 1, penalty, fold.weights)
    return float((np.argmax(fold.test @ weight + bias, axis=1) == codes[fold.stimulus]).mean())


def fit_softmax(features: Floats, target: Ints, classes: int, penalty: float, counts: Any = 1) -> tuple[Floats, Floats]:
    """Return weights [D, C], biases [C] of multinomial logistic regression, Σ counts · loss + ‖w‖²/2C, bias free."""
    from scipy.optimize import minimize
    from scipy.special import log_softmax

    width = features.shape[1]
    wanted = np.eye(classes, dtype=bool)[target]
    rows = np.broadcast_to(counts, len(target))

    def loss(flat: Floats) -> tuple[float, Floats]:
        """Return the loss and its gradient [(D + 1) C] at weights and biases in one row."""
        both = flat.reshape(width + 1, classes)
        weight, bias = both[:-1], both[-1]
        log_p = log_softmax(features @ weight + bias, axis=1)
        # Gradient Xᵀ(softmax − wanted) + w/C; the logarithm of the softmax stays finite for large scores.
        rest = (np.exp(log_p) - wanted) * rows[:, None]
        value = float(-(log_p[wanted] * rows).sum() + (weight**2).sum() / (2 * penalty))
        gradient = np.concatenate([features.T @ rest + weight / penalty, rest.sum(axis=0, keepdims=True)])
        return value, gradient.ravel()

    fit = minimize(loss, np.zeros((width + 1) * classes), jac=True, method="L-BFGS-B").x.reshape(width + 1, classes)
    return fit[:-1], fit[-1]


def label_properties(stimuli: Sequence[str]) -> dict[str, Ints]:
    """Return the classes [K] of each property that labels name, by the values it takes.

    >>> list(label_properties(["convex-far", "convex-close", "concave-far", "concave-close"]))
    ['concave/convex', 'close/far']
    """
    parts = [str(label).split("-") for label in stimuli]
    if len({len(part) for part in parts}) != 1:
        return {}
    properties = {}
    for place, values in enumerate(zip(*parts, strict=True), start=1):
        names, codes = np.unique(np.asarray(values, dtype=str), return_inverse=True)
        if len(names) > 1 and np.bincount(codes).min() > 1:
            name = "/".join(names.tolist())
            # Two places may take the same values, as the sides of two things do.
            properties[f"{name} ({place})" if name in properties else name] = codes.astype(np.int64)
    return properties


@dataclass(frozen=True)
class LabelledFeatures:
    """A layer with the classes of its stimuli."""

    features: Floats
    """[K, F]"""
    classes: Mapping[str, Ints]
    """Property → class of each stimulus [K]."""

    @cached_property
    def decoder(self) -> Decoder:
        """The decoder, which remembers what it has decoded."""
        return Decoder(self.features, np.arange(len(self.features)))

    def right(self, order: Ints) -> Floats:
        """Return whether each left-out stimulus is decoded rightly [properties, K], its classes in an order [K]."""
        return np.array([self.decoder(codes[order]) for codes in self.classes.values()])


def _classes_of(classes: Mapping[str, Ints], stimuli: Ints) -> dict[str, Ints]:
    """Return the classes of some stimuli, those that are left numbered anew."""
    return {name: np.unique(codes[stimuli], return_inverse=True)[1] for name, codes in classes.items()}


class LabelDecoding(Metric):
    """Accuracy of decoding the labels' properties, leaving one stimulus out."""

    name = "decoding"
    title = "accuracy of logistic regression for properties of stimuli left out, mean over properties"
    orders = orders_between = ORDERS
    of_model_alone = True
    reasons = ("accuracy of the model alone, no likeness: the animals' own stands beside it",)

    def defined(self, layer: Any) -> np.ndarray:
        """Return where [K] a layer has a value."""
        return np.isfinite(layer.features).all(axis=1)

    def varies(self, layer: Any) -> bool:
        """Return whether classes can be learnt: at least two, each of two stimuli that the layer has a value for."""
        counts = [np.bincount(codes)[np.unique(codes)] for codes in layer.classes.values()]
        return all(len(part) > 1 and part.min() > 1 for part in counts)

    def take(self, layer: Any, stimuli: Ints) -> Any:
        """Return a layer with some stimuli, in this order."""
        return LabelledFeatures(layer.features[stimuli], _classes_of(layer.classes, stimuli))

    def compare_layers(
        self, layers: Sequence[Any], animals: Sequence[SubjectRDM], chunks: Iterable[Ints], device: Any = None
    ) -> Iterator[Floats]:
        """Yield accuracies [N, L, A], the same for all animals."""
        for orders in chunks:
            # Classes are permuted over stimuli; the folds of patterns stay and are prepared once.
            values = np.array([[layer.right(order).mean() for layer in layers] for order in orders])
            yield np.repeat(values[..., None], len(animals), axis=-1)

    def compare_without(self, layers: Sequence[Any], animals: Sequence[SubjectRDM]) -> Floats:
        """Return accuracies [K, L, A] without each stimulus in turn, with the corrected spread."""
        accuracies = []
        for layer in layers:
            right = layer.right(np.arange(len(layer.features))).mean(axis=0)
            count = len(right)
            # Classifiers share their training stimuli: the variance of 1/K grows by the stimuli of a test over those of
            # training, 1/(K − 1) (Nadeau & Bengio 2003). Without that, 95 % intervals held the mean in 83 to 89 %.
            wider = math.sqrt(1 + count / (count - 1))
            accuracies.append(right.mean() + wider * (right.mean() - right) / (count - 1))
        return np.repeat(np.stack(accuracies, axis=1)[..., None], len(animals), axis=-1)

    def statistics(self, layer: Any, animals: Sequence[SubjectRDM], seed: int) -> dict[str, Any]:
        """Return the accuracy of every property."""
        if not self.defined(layer).all():
            return {}
        orders = np.concatenate(list(label_orders(len(layer.features), seed, exact=most_exact(ORDERS), draws=ORDERS)))
        values = np.stack([layer.right(order).mean(axis=1) for order in orders])
        accuracies = [
            {
                "property": name,
                "accuracy": float(column[0]),
                "chance": 1 / (int(codes.max()) + 1),
                "expected": float(column.mean()),
                "p": float(tail_p(column)),
            }
            for (name, codes), column in zip(layer.classes.items(), values.T, strict=True)
        ]
        return {"decoding": accuracies}

    def score(self, features: Mapping[str, ArrayLike], animals: Sequence[SubjectRDM], **options: Any) -> Score:
        """Score a model by the features [K, F] of its layers; options are those of :meth:`Metric.score`."""
        properties = label_properties(options["stimuli"])
        if not properties:
            return self._undefined(options["name"], options["stimuli"])
        return Metric.score(_BoundDecoding(properties), features, animals, **options)

    def score_animals(self, animals: Sequence[SubjectRDM], **options: Any) -> Score:
        """Return the accuracy of each animal's own mean responses."""
        properties = label_properties(options["stimuli"])
        if not properties:
            return self._undefined("animal-to-animal", options["stimuli"])
        return Metric.score_animals(_BoundDecoding(properties), animals, **options)

    def _undefined(self, name: str, stimuli: Sequence[str]) -> Score:
        reason = (
            "the labels name no property that at least two stimuli of each class share, as 'convex-far' and "
            f"'convex-close' do: {', '.join(map(str, stimuli[:4]))}"
        )
        about = {"metric": self.describe(()), "stimuli": tuple(map(str, stimuli))}
        return Score(name, math.nan, "undefined", (reason,), **about)


class _BoundDecoding(LabelDecoding):
    """Decoding of given properties."""

    def __init__(self, properties: Mapping[str, Ints]) -> None:
        self._classes = properties

    def layer(self, features: ArrayLike) -> Any:
        """Return features [K, F] with the classes of their stimuli."""
        return LabelledFeatures(usable_features(features), self._classes)

    def among(self, stimuli: Ints) -> LabelDecoding:
        """Return the decoding of the same properties of some stimuli."""
        return _BoundDecoding(_classes_of(self._classes, stimuli))

    def attainable(self, animals: Sequence[SubjectRDM], seed: int) -> Floats:
        """Return the accuracy [A, 1] of each animal's responses without their noise."""
        layers = [LabelledFeatures(denoised(animal.patterns, animal.noise), self._classes) for animal in animals]
        return np.array([[layer.right(np.arange(len(layer.features))).mean()] for layer in layers])

    def partner(self, animal: SubjectRDM, others: Sequence[SubjectRDM]) -> Any:
        """Return the animal's own mean responses, whose accuracy needs no others."""
        return LabelledFeatures(animal.patterns, self._classes)

    def agreement_null(self, animals: Sequence[SubjectRDM], factors: Floats, orders: Ints) -> Floats:
        """Return the mean accuracy [N] with the classes of every animal's stimuli in another order."""
        accuracies = []
        for animal, given in zip(animals, orders.swapaxes(0, 1), strict=True):
            layer = LabelledFeatures(animal.patterns, self._classes)
            # Orders are relative to the first, which is that of the data.
            moved = given[:, np.argsort(given[0])]
            accuracies.append([layer.right(order).mean() for order in moved])
        return np.mean(accuracies, axis=0)
