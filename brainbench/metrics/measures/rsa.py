"""Representational similarity analysis (RSA) as a metric."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_each, check_name
from brainbench.core.limits import Count, limited
from brainbench.core.provenance import UniquePart
from brainbench.core.records import Score
from brainbench.metrics.hooks import usable_features
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.measures.unique import unique_part
from brainbench.metrics.rdms.comparison import (
    LINEAR,
    WITHOUT,
    check_comparison,
    permuted_comparisons,
    products_without,
    squares,
)
from brainbench.metrics.rdms.comparison import compare as compare_rdms
from brainbench.metrics.rdms.dissimilarity import RDM_METHODS, rdm
from brainbench.metrics.rdms.noise import NOISE_METHODS
from brainbench.metrics.rdms.pairs import Floats, Ints, permuted_pairs, rdm_stack, square, stimulus_count
from brainbench.metrics.reliability.noise_correction import ESTIMATORS, Corrected, correction_by, noise_corrected
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat
from brainbench.metrics.score import score_layers

_ROUNDING = 1e-12
_LEAST_WITHOUT = 0.25
"""Smallest reliability without a stimulus, as a share of that with all, which the jackknife divides by."""


@dataclass(frozen=True)
@limited
class RSA(Metric):
    """Compare RDMs; corrected by the split-half reliability of each animal's RDM.

    A layer is its RDM [P], NaN in the pairs of a stimulus that it has no value for. With the estimator ``default`` each
    reliable animal is compared with the layer that compares best with the *other* reliable animals, the comparison is
    corrected for the animal's noise, and the score is the mean over animals; a single animal chooses on one half of its
    trials and is scored on the other. ``thesis`` and ``thesis-input`` are the published estimators with their maximum
    over layers, which is optimistic and says so.
    """

    name: str = "rsa"
    title: str = ""
    brain_method: str = "crossnobis"
    noise: str = "none"
    model_method: str = "sqeuclidean"
    """RDM method of the activations, which have no trial noise."""
    comparison: str = "whitened-cosine"
    splits: Count = 300
    """Random halves of the trials of each animal."""

    of_rdms = True
    of_unique_parts = True
    orders = 1999
    orders_between = 499
    fewest = 3
    estimators = ESTIMATORS

    def __post_init__(self) -> None:
        check_each("RDM method", (self.brain_method, self.model_method), RDM_METHODS)
        check_name("noise covariance method", self.noise, ("none", *NOISE_METHODS))
        check_comparison(self.comparison)

    def layer(self, features: ArrayLike) -> Floats:
        """Return the RDM [P] of a layer's features [K, F]."""
        return rdm(usable_features(features), method=self.model_method)

    def defined(self, layer: Floats) -> np.ndarray:
        """Return where [K] a stimulus has any distance."""
        count = stimulus_count(len(layer))
        return np.asarray(np.isfinite(square(layer) + np.diag(np.full(count, np.nan))).any(axis=1))

    def varies(self, layer: Floats) -> bool:
        """Return whether every pair has a distance and they differ."""
        return not bool(is_flat(layer))

    def take(self, layer: Floats, stimuli: Ints) -> Floats:
        """Return the RDM of some stimuli, in this order."""
        return layer[permuted_pairs(np.asarray(stimuli)[None], stimulus_count(len(layer)))[0]]

    def compare_layers(
        self, layers: Sequence[Floats], animals: Sequence[SubjectRDM], chunks: Iterable[Ints], device: Any = None
    ) -> Iterator[Floats]:
        """Yield raw comparisons [N, L, A] under the orders of each chunk."""
        brain = np.stack([animal.rdm for animal in animals])
        return permuted_comparisons(np.stack(layers), brain, iter(chunks), self.comparison, device=device)

    def compare_without(self, layers: Sequence[Floats], animals: Sequence[SubjectRDM]) -> Floats:
        """Return raw comparisons [K, L, A] without each stimulus in turn, of parts of the same RDMs."""
        rdms, brain = np.stack(layers), np.stack([animal.rdm for animal in animals])
        if self.comparison not in WITHOUT or animals[0].count <= 3 or not np.isfinite(np.vstack([rdms, brain])).all():
            return super().compare_without(layers, animals)
        return np.moveaxis(_comparisons_without(rdms, brain, self.comparison), -1, 0)

    def correction(self, animal: SubjectRDM, estimator: str) -> Corrected:
        """Return the factor of the estimator; it is linear in the comparison, so that of a comparison of 1."""
        if estimator == "default":
            return correction_by(animal.reliability_by(self.comparison))
        return noise_corrected(1.0, animal.split_half_by(self.comparison), estimator=estimator)

    def factors_without(self, animals: Sequence[SubjectRDM], factors: Floats) -> Floats:
        """Return the factors [K, A] of all animals' RDMs without each stimulus in turn."""
        without = np.tile(factors, (animals[0].count, 1))
        for index, animal in enumerate(animals):
            if animal.comparison == self.comparison and len(animal.signal_without):
                least = _LEAST_WITHOUT * animal.reliability
                without[:, index] = 1 / np.sqrt(np.clip(animal.signal_without, least, 1.0))
        return without

    def attainable(self, animals: Sequence[SubjectRDM], seed: int) -> Floats:
        """Return the raw comparison [A] that is corrected to 1."""
        return np.array([1 / self.correction(animal, "default").value for animal in animals])

    def halves(self, animal: SubjectRDM, order: Ints) -> tuple[list[SubjectRDM], float]:
        """Return the halves of the animal's splits; their reliability is the raw split-half comparison."""
        # A half in which a stimulus met silent units has no RDM; such splits say nothing.
        halves = animal.halves[~is_flat(animal.halves).any(axis=1)]
        pairs = permuted_pairs(order[None])[0]
        agreement = animal.split_half_by(self.comparison)
        factor = 1 / math.sqrt(float(agreement[np.isfinite(agreement)].mean()))
        return [
            replace(animal, rdm=half, halves=half[:0]) for half in halves.reshape(-1, halves.shape[-1])[:, pairs]
        ], factor

    def partner(self, animal: SubjectRDM, others: Sequence[SubjectRDM]) -> Floats:
        """Return the mean RDM of the other animals."""
        return np.mean([other.rdm for other in others], axis=0)

    def agreement(self, animal: SubjectRDM, others: Sequence[SubjectRDM], estimator: str) -> Corrected:
        """Return the factor for both sides (thesis, equation 3.4): the others' mean RDM is noisy too."""
        # Halves are averaged split by split, so every animal must have them.
        splits = min(len(one.halves) for one in others)
        halves = reduce(np.add, [one.halves[:splits] for one in others]) / len(others)
        if estimator == "default":
            mean = replace(others[0], rdm=self.partner(animal, others), halves=halves, comparison="")
            return correction_by(animal.reliability_by(self.comparison), mean.reliability_by(self.comparison))
        return noise_corrected(
            1.0,
            animal.split_half_by(self.comparison)[:splits],
            estimator=estimator,
            other_split_half_r=compare_rdms(halves[:, 0], halves[:, 1], method=self.comparison),
        )

    def agreement_null(self, animals: Sequence[SubjectRDM], factors: Floats, orders: Ints) -> Floats:
        """Return the mean corrected agreement [N] with every animal's stimuli in an order of its own [N, A, K]."""
        if self.comparison not in LINEAR:
            return super().agreement_null(animals, factors, orders)
        rdms = np.stack([animal.rdm for animal in animals])
        return _linear_agreement(squares(LINEAR[self.comparison](rdms), self.comparison), factors, orders)

    def unique(
        self,
        layers: Mapping[str, Floats],
        controls: Mapping[str, Floats],
        animals: Sequence[SubjectRDM],
        factors: Floats,
        **options: Any,
    ) -> UniquePart:
        """Return what the layers' RDMs explain of the animals' beyond those of the controls."""
        without = self.factors_without(animals, factors)
        how: dict[str, Any] = {"comparison": self.comparison, "factors": factors, "factors_without": without}
        return unique_part(layers, controls, animals, **how, **options)

    def describe(self, animals: Sequence[SubjectRDM]) -> str:
        """Name the RDMs, the noise that they are divided by, and their comparison."""
        methods = sorted({animal.method for animal in animals})
        # Boards and audits tell metrics apart by these words.
        noise = "" if self.noise == "none" else f" divided by noise ({self.noise})"
        return f"RSA: {'/'.join(methods)} RDM{noise}, {self.comparison} comparison"


def _linear_agreement(matrices: Floats, factors: Floats, orders: Ints) -> Floats:
    """Return the mean corrected agreement [N] of matrices [A, K, K], each in an order of its own [N, A, K].

    Products of a matrix with the sum of the others are sums of products of two.
    """
    count, agreements = matrices.shape[-1], np.empty(len(orders))
    rows, cols = np.triu_indices(count)
    # Of one triangle; what stands in both counts twice.
    sources = (matrices * np.where(np.eye(count), 1.0, math.sqrt(2))).reshape(len(matrices), -1)
    moved = np.empty((len(matrices), len(rows)))
    for index, each in enumerate(orders):
        for row, source, order in zip(moved, sources, each, strict=True):
            source.take((order * count)[rows] + order[cols], out=row, mode="clip")
        products = moved @ moved.T
        size = np.diagonal(products)
        crossed = products.sum(axis=1) - size
        others = products.sum() - 2 * products.sum(axis=1) + size
        agreements[index] = np.mean(crossed / np.sqrt(size * others) * factors)
    return agreements


def _comparisons_without(layers: Floats, animals: Floats, comparison: str) -> Floats:
    """Return comparisons [L, A, K] of RDMs without each stimulus; NaN where nothing of one is left."""
    both = products_without(layers, animals, comparison)
    left, right = (
        np.stack([products_without(part[None], part[None], comparison)[0, 0] for part in side])
        for side in (layers, animals)
    )
    # What rounding leaves of an RDM that has no other distance is no distance.
    left, right = (
        np.where(part > _ROUNDING * part.max(axis=-1, keepdims=True), part, np.nan) for part in (left, right)
    )
    return both / np.sqrt(left[:, None] * right[None])


def score_rdms(
    layer_rdms: Mapping[str, ArrayLike],
    subjects: Sequence[SubjectRDM],
    *,
    name: str,
    stimuli: Sequence[str],
    compare: str = "pearson",
    **options: Any,
) -> Score:
    """Score a model by the RDMs [P] of its layers, in network order, against animals of :func:`subject_rdm`.

    Both are of the same stimuli in the same order. ``options`` are those of
    :func:`~brainbench.metrics.score.score_layers`; a torch ``device`` pays from some hundred stimuli on.
    """
    check_comparison(compare)
    rdms = check_layers(layer_rdms, stimuli)
    return score_layers(RSA(comparison=compare), rdms, subjects, name=name, stimuli=stimuli, **options)[0]


def check_layers(layer_rdms: Mapping[str, ArrayLike], stimuli: Sequence[str]) -> dict[str, Floats]:
    """Return the layers' RDMs [P] by name."""
    if not layer_rdms:
        raise UsageError("There are no layers to score; give the RDM of at least one layer.")
    rdms = {str(layer): rdm_stack(values, f"The RDM of layer {layer!r}") for layer, values in layer_rdms.items()}
    pairs = len(stimuli) * (len(stimuli) - 1) // 2
    for layer, values in rdms.items():
        if values.shape != (pairs,):
            raise UsageError(f"Layer {layer!r} has an RDM [{len(values)}]; {len(stimuli)} stimuli have {pairs} pairs.")
    return rdms
