"""The unique part of a network: what it explains of animals beyond controls, judged on stimuli that were not fitted.

The stimuli are halved at random many times. On the pairs of one half the RDMs of the controls, of one layer and one of
equal distances get non-negative weights that bring their sum nearest to the animals' mean RDM; on the pairs of the
other half the sum is compared with each animal by the metric's own comparison. The same is done without the layer, and
without the controls. What is lost without the layer is its unique part; a copy of a control has none. The layer is
chosen on the half that is fitted, so a network of many layers gains nothing by luck.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brainbench.core.provenance import UniquePart
from brainbench.core.statistics import two_factor_interval
from brainbench.metrics.evaluation import first_best, most_chosen
from brainbench.metrics.inference.permutation import canonical_order
from brainbench.metrics.rdms.comparison import LINEAR, products_without
from brainbench.metrics.rdms.pairs import Floats, Ints, permuted_pairs, stimulus_count
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat

FEWEST_STIMULI = 10  # stimuli below which a half has too few pairs to fit and to judge weights
SPLITS = 24  # random halves of the stimuli; the error that their number leaves is stated
_SWEEPS, _TOLERANCE = 100, 1e-8
_TRIAL_SPLITS, _FEWEST_TRIAL_SPLITS, _FEW_STIMULI = 40, 4, 40
"""Splits of the trials for each half of up to 40 stimuli, of more in proportion fewer, and the fewest."""
_LEAST_SHARE = 0.25  # smallest reliability of halves, as a share of that of all stimuli, which is divided by
_PARTS = ("both", "controls", "network", "equal")
"""Sums that are compared: controls and layer, controls, layer; each with equal distances, and these alone."""


def unique_part(
    layers: Mapping[str, Floats],
    controls: Mapping[str, Floats],
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


def parted(
    shares: Floats, without: Floats, controls: Mapping[str, Floats], layer: str, monte_carlo_error: float
) -> UniquePart:
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


def lacking(layers: Mapping[str, Floats], controls: Mapping[str, Floats], count: int) -> str:
    """Return why there is no unique part of layers and controls with a value for each of K stimuli; empty if one is."""
    if count < FEWEST_STIMULI:
        return f"{count} stimuli are too few to fit one half and judge the other; at least {FEWEST_STIMULI} are needed"
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
        first, second, every = (
            LINEAR[comparison](part[..., pairs]) for part in (trials[:, 0], trials[:, 1], animal.rdm)
        )
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
        weights = np.stack([full[rows, layers], *(_fitted_to(gram, sums, part, rivals) for part in _PARTS[1:])], axis=1)
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


def _fitted_to(gram: Floats, sums: Floats, part: str, rivals: int) -> Floats:
    """Return the weights [V, J + 1] of a sum that lacks some RDMs; equal distances come first, the layer last."""
    used = np.ones(rivals + 1, dtype=bool)
    if part in ("controls", "equal"):
        used[-1] = False
    if part in ("network", "equal"):
        used[1:-1] = False
    return non_negative(gram, sums, used)


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
