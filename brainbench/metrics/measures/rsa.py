"""Representational similarity analysis (RSA) as a metric, and what layers explain of RDMs beyond controls.

For the unique part the stimuli are halved at random many times. On the pairs of one half the RDMs of the controls, of
one layer and one of equal distances get non-negative weights that bring their sum nearest to the animals' mean RDM; on
those of the other half the sum is compared with each animal. What is lost without the layer is its unique part; a copy
of a control has none. The layer is chosen on the half that is fitted, so many layers gain nothing by luck.
"""

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
from brainbench.core.statistics import two_factor_interval
from brainbench.metrics.arrays import Floats, Ints
from brainbench.metrics.evaluation import first_best, most_chosen
from brainbench.metrics.hooks import Layers, usable_features
from brainbench.metrics.inference.permutation import canonical_order
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.rdms.comparison import (
    LINEAR,
    WITHOUT,
    check_comparison,
    permuted_comparisons,
    permuted_pairs,
    products_without,
    rdm_stack,
    square,
    squares,
    stimulus_count,
)
from brainbench.metrics.rdms.comparison import compare as compare_rdms
from brainbench.metrics.rdms.dissimilarity import NOISE_METHODS, RDM_METHODS, rdm
from brainbench.metrics.reliability.noise_correction import (
    ESTIMATORS,
    Corrected,
    correction_by,
    noise_corrected,
    spearman_brown,
)
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat
from brainbench.metrics.score import score_layers

FEWEST_STIMULI = 10  # stimuli below which a half has too few pairs to fit and to judge weights
SPLITS = 24  # random halves of the stimuli; the error that their number leaves is stated
_SWEEPS, _TOLERANCE = 100, 1e-8
_TRIAL_SPLITS, _FEWEST_TRIAL_SPLITS, _FEW_STIMULI = 40, 4, 40
"""Splits of the trials for each half of up to 40 stimuli, of more in proportion fewer, and the fewest."""
_LEAST_SHARE = 0.25  # smallest reliability of halves, as a share of that of all stimuli, which is divided by
_PARTS = ((True, True), (True, False), (False, True), (False, False))
"""Sums that are compared, by whether controls and the layer take part; equal distances come first in each."""


def unique_part(
    layers: Layers,
    controls: Layers,
    animals: Sequence[SubjectRDM],
    *,
    comparison: str,
    factors: Floats,
    factors_without: Floats | None = None,
    attainable: float = 1.0,
    committed: str | None = None,
    splits: int = SPLITS,
    seed: int = 0,
) -> UniquePart:
    """Return what layers' RDMs [P] explain of the RDMs of animals beyond those of controls.

    Args:
        layers, controls: RDMs by name; those without a value for some pair, or without any difference, say nothing.
        comparison: one of :data:`~brainbench.metrics.rdms.comparison.LINEAR`; ranks have no sums.
        factors: [A] corrections of a comparison for each animal's noise; halves of the stimuli have their own where the
            halves of the trials are kept, since fewer stimuli are not as reliable.
        factors_without: [K, A] the same without each stimulus in turn.
        attainable: corrected comparison of all that is reliable.
        committed: the layer, where it was chosen beforehand.
        splits, seed: random halves of the stimuli, the same for every network.
    """
    brain = np.stack([animal.rdm for animal in animals])
    count = stimulus_count(brain.shape[-1])
    layers = {name: rdm for name, rdm in layers.items() if committed in (None, name) and not is_flat(rdm)}
    controls = {name: rdm for name, rdm in controls.items() if not is_flat(rdm)}
    ranks = f"the comparison {comparison!r} takes ranks, which do not add up; choose from {', '.join(LINEAR)}"
    if reason := lacking(layers, controls, count) if comparison in LINEAR else ranks:
        return UniquePart("undefined", (reason,), controls=tuple(controls))
    # In an order that the animals fix, the halves do not depend on how stimuli were listed.
    order = canonical_order(brain)
    rdms = np.stack([np.ones(brain.shape[-1]), *controls.values(), *layers.values(), *brain])
    rdms = rdms[:, permuted_pairs(order[None])[0]]
    weights = np.tile(factors, (count, 1)) if factors_without is None else factors_without[order]
    sides, rng = _Sides(len(controls) + 1, len(layers)), np.random.default_rng(seed)
    drawn = [[np.sort(half) for half in np.array_split(rng.permutation(count), 2)] for _ in range(splits)]
    parts = [order[half] for halves in drawn for half in halves]
    of_halves = np.array([_factor(*each, parts, comparison) for each in zip(animals, factors, strict=True)])
    weights, factors = weights * (of_halves / factors), of_halves
    whole, without, chosen = [], np.zeros((count, len(_PARTS))), []
    for halves in drawn:
        products = [_products(rdms, half, comparison) for half in halves]
        for fitted, judged in ((0, 1), (1, 0)):
            values, rest, layer = sides.compared(products[fitted], products[judged])
            whole.append(values * factors)
            chosen.append(layer)
            for half, part in zip((halves[fitted], halves[judged]), rest, strict=True):
                without[half] += (part * weights[half, None]).mean(axis=-1) / (2 * splits)
    by_split = np.array(whole).reshape(splits, 2, len(_PARTS), -1).mean(axis=1)
    equal = by_split[:, -1:]
    span = attainable - float(equal.mean())
    if not span > 0:
        return UniquePart("undefined", ("equal distances reach all that is attainable",), controls=tuple(controls))
    parts = (by_split[:, :-1] - equal) / span
    draws = (parts[:, 0] - parts[:, 1]).mean(axis=1)
    error = float(draws.std(ddof=1) / math.sqrt(splits))
    layer = list(layers)[most_chosen(np.array(chosen))]
    return parted(parts.mean(axis=0), (without[:, 0] - without[:, 1]) / span, controls, layer, error)


def parted(shares: Floats, without: Floats, controls: Layers, layer: str, monte_carlo_error: float) -> UniquePart:
    """Return the parts of shares [3, A] that both sides, controls and the layer reach, of what is attainable.

    ``without`` [K] is the unique part without each stimulus in turn.
    """
    both, rivals, network = shares
    unique = both - rivals
    interval = two_factor_interval(float(unique.mean()), unique, without)
    return UniquePart(
        status="ok",
        unique=float(unique.mean()),
        low=math.nan if interval is None else interval.low,
        high=math.nan if interval is None else interval.high,
        total=float(both.mean()),
        shared=float((network + rivals - both).mean()),
        controls_alone=float((both - network).mean()),
        controls=tuple(controls),
        layer=layer,
        monte_carlo_error=monte_carlo_error,
    )


def lacking(layers: Layers, controls: Layers, count: int) -> str:
    """Return why there is no unique part of layers and controls with a value for each of K stimuli; empty if one is."""
    if count < FEWEST_STIMULI:
        return f"{count} stimuli are too few to fit some and judge the others; at least {FEWEST_STIMULI} are needed"
    if not controls:
        return "no control has differences between stimuli"
    return "" if layers else "no layer has a value for every stimulus"


def _factor(animal: SubjectRDM, factor: float, halves: Sequence[Ints], comparison: str) -> float:
    """Return the correction of comparisons over halves of the stimuli, from halves of the trials, pooled over all."""
    most = max(_FEWEST_TRIAL_SPLITS, _TRIAL_SPLITS * _FEW_STIMULI // max(animal.count, _FEW_STIMULI))
    trials = animal.halves[:most]
    if not len(trials):
        return factor
    # Unbiased distances: the share of the square that is no noise. Others: Spearman and Brown of the mean comparison.
    unbiased = animal.signal_by(comparison).size > 0
    agreement, size, cosines = 0.0, 0.0, []
    for half in halves:
        pairs = permuted_pairs(half[None], animal.count)[0]
        first, second, every = (LINEAR[comparison](part[..., pairs]) for part in (*trials.swapaxes(0, 1), animal.rdm))
        product = (first * second).sum(axis=-1)
        agreement, size = agreement + float(np.nanmean(product)), size + float((every**2).sum())
        if not unbiased:
            cosines.append(product / np.sqrt((first**2).sum(axis=-1) * (second**2).sum(axis=-1)))
    share = agreement / size if unbiased else float(spearman_brown(np.nanmean(cosines)))
    return 1 / math.sqrt(min(max(share, _LEAST_SHARE / factor**2), 1.0))


def _products(rdms: Floats, half: Ints, comparison: str) -> Floats:
    """Return inner products [1 + h, R, R] of RDMs over the pairs of a half [h], and without each of its stimuli.

    The first RDM [R, P] is of equal distances, whose products with the others are their sums.
    """
    part = rdms[:, permuted_pairs(half[None], stimulus_count(rdms.shape[-1]))[0]]
    whitened, centred = comparison.startswith("whitened"), comparison.endswith("pearson")
    plain = None if whitened and not centred else _with_and_without(part, "cosine")
    result = _with_and_without(part, "whitened-cosine") if whitened else plain
    assert result is not None
    if not centred or plain is None:
        return result
    # ⟨x − x̄, y − ȳ⟩ in any inner product, from the products with the RDM of equal distances.
    mean, ones = plain[:, 0] / plain[:, :1, 0], result[:, 0]
    crossed = mean[:, :, None] * ones[:, None, :]
    return result - crossed - crossed.swapaxes(-1, -2) + mean[:, :, None] * mean[:, None, :] * ones[:, :1, None]


def _with_and_without(rdms: Floats, comparison: str) -> Floats:
    vectors = LINEAR[comparison](rdms)
    rest = products_without(rdms, rdms, comparison)
    return np.concatenate([(vectors @ vectors.T)[None], np.moveaxis(rest, -1, 0)])


@dataclass(frozen=True)
class _Sides:
    """What is fitted and judged: ``rivals`` (equal distances, then controls), layers, and animals after them."""

    rivals: int
    layers: int

    def compared(self, fitted: Floats, judged: Floats) -> tuple[Floats, tuple[Floats, Floats], int]:
        """Return raw comparisons [4, A], those without each stimulus ([h, 4, A], [h', 4, A]), and the layer."""
        weights, layers = self._fit(fitted)
        every = self._judge(weights[:1], layers[:1], judged)
        return every[0], (self._judge(weights[1:], layers[1:], judged[:1]), every[1:]), int(layers[0])

    def _fit(self, products: Floats) -> tuple[Floats, Ints]:
        """Return weights [V, 4, J + 1] of the sums for each set of products [V, R, R], and the layer [V] of each."""
        rivals, ends = self.rivals, self.rivals + self.layers
        length = np.sqrt(np.maximum(np.diagonal(products, axis1=-2, axis2=-1), 0.0))
        scale = np.divide(
            1.0, length, out=np.zeros_like(length), where=length > 1e-9 * length.max(axis=-1, keepdims=True)
        )
        unit = products * scale[:, :, None] * scale[:, None, :]
        aim = unit[:, :ends, ends:].mean(axis=-1)
        gram = np.zeros((len(products), self.layers, rivals + 1, rivals + 1))
        gram[..., :rivals, :rivals] = unit[:, None, :rivals, :rivals]
        gram[..., :rivals, -1] = gram[..., -1, :rivals] = unit[:, :rivals, rivals:ends].swapaxes(-1, -2)
        gram[..., -1, -1] = np.diagonal(unit, axis1=-2, axis2=-1)[:, rivals:ends]
        sums = np.concatenate([np.repeat(aim[:, None, :rivals], self.layers, axis=1), aim[:, rivals:, None]], axis=-1)
        full = non_negative(gram, sums)
        size = np.sqrt(np.einsum("vlj,vljk,vlk->vl", full, gram, full))
        fit = np.divide((full * sums).sum(axis=-1), size, out=np.zeros_like(size), where=size > 0)
        layers = first_best(fit[..., None])[..., 0]
        rows = np.arange(len(products))
        gram, sums = gram[rows, layers], sums[rows, layers]
        used = [[True, *[controls] * (rivals - 1), network] for controls, network in _PARTS[1:]]
        weights = np.stack([full[rows, layers], *(non_negative(gram, sums, part) for part in used)], axis=1)
        # Of the RDMs as they are, not of unit vectors, which have other lengths on the other half.
        raw = np.concatenate([scale[:, :rivals], scale[rows, rivals + layers][:, None]], axis=1)
        return weights * raw[:, None], layers

    def _judge(self, weights: Floats, layers: Ints, products: Floats) -> Floats:
        """Return raw comparisons [V, 4, A] of sums with animals; weights or products are of one set for all."""
        number, ends = max(len(weights), len(products)), self.rivals + self.layers
        rivals = np.tile(np.arange(self.rivals), (len(layers), 1))
        index: Ints = np.concatenate([rivals, self.rivals + layers[:, None]], axis=1)
        index = np.broadcast_to(index, (number, index.shape[1]))
        weights, products = (np.broadcast_to(part, (number, *part.shape[1:])) for part in (weights, products))
        rows = np.arange(number)[:, None]
        gram = products[rows[:, :, None], index[:, :, None], index[:, None, :]]
        animals = np.sqrt(np.diagonal(products, axis1=-2, axis2=-1)[:, None, ends:])
        length = np.sqrt(np.maximum(np.einsum("vpj,vjk,vpk->vp", weights, gram, weights), 0.0))[:, :, None] * animals
        product = weights @ products[rows, index][:, :, ends:]
        # A sum of nothing explains nothing.
        return np.divide(product, length, out=np.zeros_like(product), where=length > 0)


def non_negative(gram: Floats, sums: Floats, used: Any = None) -> Floats:
    """Return the non-negative weights [..., J] of least squares from inner products [..., J, J] and [..., J].

    Coordinate descent (Franc et al. 2005), all problems at once; variables that are not ``used`` or have no length stay
    at 0.
    """
    weights, size = np.zeros_like(sums), np.diagonal(gram, axis1=-2, axis2=-1)
    for _ in range(_SWEEPS):
        largest = 0.0
        for place in range(sums.shape[-1]):
            if used is not None and not used[place]:
                continue
            step = sums[..., place] - (gram[..., place, :] * weights).sum(axis=-1)
            step = np.divide(step, size[..., place], out=np.zeros_like(step), where=size[..., place] > 0)
            moved = np.maximum(weights[..., place] + step, 0.0)
            largest = max(largest, float(np.abs(moved - weights[..., place]).max(initial=0.0)))
            weights[..., place] = moved
        if largest < _TOLERANCE:
            break
    return weights


_ROUNDING = 1e-12
_LEAST_WITHOUT = 0.25
"""Smallest reliability without a stimulus, as a share of that with all, which the jackknife divides by."""


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
        """Return the raw comparison [A, 1] that is corrected to 1."""
        return np.array([[1 / self.correction(animal, "default").value] for animal in animals])

    def halves(self, animal: SubjectRDM, order: Ints) -> tuple[list[SubjectRDM], float]:
        """Return the halves of the animal's splits; their reliability is the raw split-half comparison."""
        # A half in which a stimulus met silent units has no RDM; such splits say nothing.
        halves = animal.halves[~is_flat(animal.halves).any(axis=1)]
        pairs = permuted_pairs(order[None])[0]
        agreement = animal.split_half_by(self.comparison)
        factor = 1 / math.sqrt(float(agreement[np.isfinite(agreement)].mean()))
        halves = halves.reshape(-1, halves.shape[-1])[:, pairs]
        return [replace(animal, rdm=half, halves=half[:0]) for half in halves], factor

    def partner(self, animal: SubjectRDM, others: Sequence[SubjectRDM]) -> Floats:
        """Return the mean RDM of the other animals, whatever the size of their responses."""
        return np.mean([other.rdm / _size(other) for other in others], axis=0)

    def agreement(self, animal: SubjectRDM, others: Sequence[SubjectRDM], estimator: str) -> Corrected:
        """Return the factor for both sides (thesis, equation 3.4): the others' mean RDM is noisy too."""
        # Halves are averaged split by split, so every animal must have them.
        splits = min(len(one.halves) for one in others)
        halves = reduce(np.add, [one.halves[:splits] / _size(one) for one in others]) / len(others)
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
        rdms = np.stack([animal.rdm / _size(animal) for animal in animals])
        return _linear_agreement(squares(LINEAR[self.comparison](rdms), self.comparison), factors, orders)

    def unique(
        self, layers: Layers, controls: Layers, animals: Sequence[SubjectRDM], factors: Floats, **options: Any
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


def _size(animal: SubjectRDM) -> float:
    """Return what an RDM is divided by before animals are averaged; correlation distances have a scale already.

    Squared distances grow with rates and with the number of units, so that one animal would decide.
    """
    return 1.0 if animal.method == "correlation" else float(np.linalg.norm(animal.rdm)) or 1.0


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
    squares = []
    for side in (layers, animals):
        part = np.stack([products_without(rdm[None], rdm[None], comparison)[0, 0] for rdm in side])
        # What rounding leaves of an RDM that has no other distance is no distance.
        squares.append(np.where(part > _ROUNDING * part.max(axis=-1, keepdims=True), part, np.nan))
    return both / np.sqrt(squares[0][:, None] * squares[1][None])


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
