"""What a metric says of a layer and of an animal: the hooks that the engine calls.

The engine (:mod:`brainbench.metrics.score`) does the rest: the choice of layer, permutations, the interval over animals
and stimuli, chance and what is attainable. :class:`brainbench.metrics.Metric` joins both.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.core.provenance import UniquePart
from brainbench.metrics.arrays import Floats, Ints, fetch
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, canonical_order
from brainbench.metrics.reliability.noise_correction import Corrected, gated
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, simulated_animals, subject_rdm
from brainbench.metrics.stimulus_labels import response_matrix

Layers = Mapping[str, Floats]  # what :meth:`MetricHooks.layer` made of layers, by name
_SAFE_EXPONENT = 64
"""Features whose largest value lies outside 2^±64 are rescaled, so that no square overflows or vanishes."""
_SPLIT_STIMULI, _FEWEST_SPLITS = 40, 20
"""Stimuli up to which all split halves are taken, and the fewest of them."""


class MetricHooks:
    """A way to compare a model's features with animals. Subclasses set ``name``, ``title`` and compare.

    :meth:`layer` turns a layer's features into what is compared, an RDM or an array of patterns; the other methods
    receive layers in that form. Animals are :class:`SubjectRDM`, prepared once for all models.
    """

    name = ""
    """Name on the command line."""
    title = ""
    """Comparison and its correction for noise, in one line."""
    comparison = "whitened-cosine"
    """Comparison of RDMs on which an animal's reliability rests."""
    brain_method = "crossnobis"
    """RDM method of the animals."""
    noise = "none"
    """Noise covariance that their RDMs are divided by."""
    splits = 300
    """Random split halves of an animal's trials; more change a score by less than .001. Trials are split by stimulus:
    the error that their number leaves falls with that of stimuli too, so above 40 they are fewer in proportion."""
    orders = 999
    """Random orders of the stimuli in a permutation test; all orders are taken where they are at most five times as
    many."""
    orders_between = 199
    """The same between animals, where every order may be slow."""
    fewest = SMALLEST_STIMULI
    """Fewest stimuli with a value."""
    estimators: tuple[str, ...] = ("default",)
    """Names that ``estimator`` takes."""
    value_error = 0.0
    """Monte-Carlo error of a value without splits; NaN where it is not known."""
    of_rdms = False
    """True when layers and animals are compared by RDMs [P], which a record then shows."""
    of_unique_parts = False
    """True when :meth:`unique` says what layers explain beyond controls."""
    of_model_alone = False
    """True when a comparison says nothing of the animal."""
    chooses_anew = False
    """True when the interval repeats the choice of layers without each stimulus in turn."""
    of_covariates = False
    """True when a comparison also takes what else was measured in the trials: contacts, licks and choices."""
    reasons: tuple[str, ...] = ()
    """Remarks for a reader of every score, in words."""

    def animal(self, subject: str, blocks: Sequence[Trials], n_stimuli: int, **options: Any) -> SubjectRDM:
        """Prepare one animal from the trials of its sessions; what cannot be used says so in the score.

        Options are ``stimuli``, ``seed`` and ``splits`` of :func:`subject_rdm`.
        """
        how: dict[str, Any] = {"method": self.brain_method, "comparison": self.comparison, "noise": self.noise}
        splits = max(min(self.splits, _FEWEST_SPLITS), self.splits * _SPLIT_STIMULI // max(n_stimuli, _SPLIT_STIMULI))
        return subject_rdm(subject, blocks, n_stimuli, **{"splits": splits, **how, **options})

    def layer(self, features: ArrayLike) -> Floats:
        """Return what is compared of a layer's features [K, F]; a stimulus with a value that is not finite is NaN."""
        return usable_features(features)

    def defined(self, layer: Floats) -> np.ndarray:
        """Return where [K] a layer has a value."""
        return np.asarray(np.isfinite(layer).all(axis=1))

    def varies(self, layer: Floats) -> bool:
        """Return whether a layer, without the stimuli that it has no value for, tells any stimuli apart."""
        return bool(np.ptp(layer, axis=0).any())

    def take(self, layer: Floats, stimuli: Ints) -> Floats:
        """Return a layer with some stimuli, in this order."""
        return layer[stimuli]

    def compare_layers(
        self, layers: Sequence[Floats], animals: Sequence[SubjectRDM], chunks: Iterable[Ints], device: Any = None
    ) -> Iterator[Floats]:
        """Yield raw comparisons [N, L, A] with the stimuli of the layers in each order of a chunk [N, K]."""
        raise UsageError(f"The metric {self.name or type(self).__name__!r} does not define a comparison.")

    def compare_without(self, layers: Sequence[Floats], animals: Sequence[SubjectRDM]) -> Floats:
        """Return raw comparisons [K, L, A] without each stimulus in turn."""
        count = animals[0].count
        values = np.full((count, len(layers), len(animals)), np.nan)
        if count <= 3:
            return values
        for stimulus in range(count):
            rest = np.delete(np.arange(count), stimulus)
            parts = [self.take(layer, rest) for layer in layers], [one.take(rest) for one in animals]
            values[stimulus] = next(iter(self.compare_layers(*parts, [np.arange(count - 1)[None]])))[0]
        return values

    def correction(self, animal: SubjectRDM, estimator: str) -> Corrected:
        """Return the factor that corrects a comparison for an animal's noise, and whether the animal is reliable."""
        return gated(1.0, animal.reliability)

    def factors_without(self, animals: Sequence[SubjectRDM], factors: Floats) -> Floats:
        """Return the factors [K, A] of comparisons without each stimulus in turn, from those of all stimuli [A]."""
        return np.tile(factors, (animals[0].count, 1))

    def attainable(self, animals: Sequence[SubjectRDM], seed: int) -> Floats:
        """Return the raw values [A, S], by draws of noise, of a model with each animal's own responses without it."""
        # In the order in which stimuli are scored: folds and noise then do not depend on how they were listed.
        order, draws = canonical_order(np.stack([animal.rdm for animal in animals])), []
        for animal in animals:
            truth, noisy = simulated_animals(animal.take(order), seed)
            draws.append(next(iter(self.compare_layers([truth], noisy, [np.arange(len(truth))[None]])))[0, 0])
        return np.stack(draws)

    def among(self, stimuli: Ints) -> MetricHooks:
        """Return the metric of some stimuli; itself where it knows nothing of single ones."""
        return self

    def halves(self, animal: SubjectRDM, order: Ints) -> tuple[list[SubjectRDM], float] | None:
        """Return an animal's halves (both of each split) as animals, stimuli in an order, and their correction.

        None where the metric does not compare halves.
        """
        return None

    def partner(self, animal: SubjectRDM, others: Sequence[SubjectRDM]) -> Any:
        """Return the layer that an animal is compared with: the others' units side by side, whatever their scale."""
        sizes = [np.linalg.norm(other.patterns - other.patterns.mean(axis=0)) or 1.0 for other in others]
        return np.concatenate([other.patterns / size for other, size in zip(others, sizes, strict=True)], axis=1)

    def agreement(self, animal: SubjectRDM, others: Sequence[SubjectRDM], estimator: str) -> Corrected:
        """Return the factor that corrects the comparison of an animal with others."""
        return self.correction(animal, estimator)

    def agreement_null(self, animals: Sequence[SubjectRDM], factors: Floats, orders: Ints) -> Floats:
        """Return the mean corrected agreement [N] with every animal's stimuli in an order of its own [N, A, K]."""
        agreements = np.empty(len(orders))
        for index, each in enumerate(orders):
            moved = [animal.take(order) for animal, order in zip(animals, each, strict=True)]
            values = []
            for animal in moved:
                partner = self.partner(animal, [other for other in moved if other is not animal])
                identity = [np.arange(animal.count)[None]]
                values.append(next(iter(self.compare_layers([partner], [animal], identity)))[0, 0, 0])
            agreements[index] = np.mean(np.array(values) * factors)
        return agreements

    def statistics(self, layer: Floats, animals: Sequence[SubjectRDM], seed: int) -> dict[str, Any]:
        """Return what else a record keeps of the chosen layer; nothing unless overridden."""
        return {}

    def unique(
        self, layers: Layers, controls: Layers, animals: Sequence[SubjectRDM], factors: Floats, **options: Any
    ) -> UniquePart | None:
        """Return what layers explain of animals beyond controls; None where a metric does not say.

        ``factors`` [A] correct comparisons for noise; ``options`` are ``attainable``, ``committed`` and ``seed``, as of
        the score.
        """
        return None

    def describe(self, animals: Sequence[SubjectRDM]) -> str:
        """Name the metric in words, for the record."""
        return f"{self.name}: {self.title}"


def usable_features(features: ArrayLike) -> Floats:
    """Return features [K, F] in float64, rescaled by a power of two where squares would leave the range of numbers.

    A stimulus with a value that is not finite is NaN throughout.
    """
    array = np.asarray(fetch(response_matrix(features, "stimuli")), dtype=np.float64)
    broken = ~np.asarray(np.isfinite(array).all(axis=1))
    largest = float(np.abs(array[~broken]).max(initial=0.0))
    exponent = int(np.frexp(largest)[1]) if largest > 0 else 0
    if abs(exponent) > _SAFE_EXPONENT:
        # A power of two changes no digit.
        array = np.ldexp(array, -exponent)
    return np.where(broken[:, None], np.nan, array) if broken.any() else array
