"""Layers against animals at every lag between the model's time and the neurons', and the latency of each layer.

A lag is positive where neurons follow the model: the animals' bin t is compared with the model's bin t − lag. A layer's
latency is the lag at which its mean comparison over times and animals, less chance, is highest. Its error is a
jackknife over animals and stimuli (Miller, Patterson & Ulrich 1998, doi:10.1111/1469-8986.3510099, for animals).

Letters: N permutation, L layer, G lag, T bin of the recordings, A animal, K stimulus, P RDM pair.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.core.records import Interval
from brainbench.core.statistics import two_factor_interval
from brainbench.metrics.arrays import finite_mean
from brainbench.metrics.evaluation import choose_on_others
from brainbench.metrics.inference.permutation import canonical_order, label_orders, tail_p
from brainbench.metrics.rdms.comparison import compare_all, permuted_comparisons
from brainbench.metrics.rdms.pairs import Floats, Ints, permuted_pairs, stimulus_count
from brainbench.metrics.reliability.subject_rdm import is_flat

_NEVER = -2.0  # vote of a layer and lag that cannot be chosen; comparisons are at least −1
_CHUNK_ELEMENTS = 1 << 22
_EXACT_STIMULI = 6  # up to this many stimuli all orders are taken (6! = 720)


@dataclass(frozen=True)
class LaggedRDMs:
    """RDMs of layers and animals over time, and which of their bins are compared at which lag."""

    layers: Floats
    """[M, P] RDMs of all layers and bins in a row."""
    animals: Floats
    """[T·A, P], animals fastest."""
    place: Ints
    """[L, G, T] row of ``layers`` compared with bin t; −1 for none."""
    usable: NDArray[np.bool_]
    """[L, G, T, A] True where both have an RDM."""
    lags: Ints
    """[G] in bins."""
    comparison: str

    @classmethod
    def join(cls, movies: Sequence[Floats], animals: Sequence[Floats], *, largest: int, comparison: str) -> LaggedRDMs:
        """Join movies [T', P] of layers and [T, P] of animals.

        A movie of a single RDM is that of a layer without time, which is compared at lag 0 alone. Lags up to
        ``largest`` bins are tried in both directions.
        """
        bins, lags = len(animals[0]), np.arange(-largest, largest + 1)
        place = np.full((len(movies), len(lags), bins), -1, dtype=np.int64)
        start = 0
        for index, movie in enumerate(movies):
            if len(movie) == 1:
                place[index, largest] = start
            else:
                at = np.arange(bins) - lags[:, None]
                inside = (at >= 0) & (at < len(movie))
                # A lag at which most of the recordings meet no model time would be chosen by luck.
                inside &= 2 * inside.sum(axis=1, keepdims=True) >= min(bins, len(movie))
                place[index] = np.where(inside, start + at, -1)
            start += len(movie)
        rows, brain = np.concatenate(movies), np.stack(animals, axis=1)
        known_rows, known_brain = ~is_flat(rows), ~is_flat(brain)
        usable = (place[..., None] >= 0) & known_rows[place][..., None] & known_brain
        # What stands for a missing RDM is never looked at, but must be a number for the matrix products.
        dummy = np.arange(rows.shape[1], dtype=np.float64)
        rows = np.where(known_rows[:, None], rows, dummy)
        brain = np.where(known_brain[..., None], brain, dummy).reshape(-1, rows.shape[1])
        return cls(rows, brain, place, usable, lags, comparison)

    @property
    def stimuli(self) -> int:
        """K."""
        return stimulus_count(self.layers.shape[1])

    def compared(self) -> Floats:
        """Return comparisons [1, L, G, T, A]."""
        return self._arranged(compare_all(self.layers, self.animals, method=self.comparison)[None])

    def permuted(self, draws: int, seed: int) -> Iterator[Floats]:
        """Yield comparisons [N, L, G, T, A] under orders of the stimuli, the given order first of all."""
        # Stimuli are sorted by the animals' RDMs, so that random orders do not depend on how they were listed.
        pairs = permuted_pairs(canonical_order(self.animals)[None])[0]
        step = max(1, _CHUNK_ELEMENTS // max(self.layers.size, len(self.layers) * len(self.animals)))
        orders = label_orders(self.stimuli, seed, exact=_EXACT_STIMULI, draws=draws, step=step)
        layers, animals = self.layers[:, pairs], self.animals[:, pairs]
        for r in permuted_comparisons(layers, animals, orders, self.comparison):
            yield self._arranged(r)

    def without_stimulus(self, stimulus: int) -> Floats:
        """Return comparisons [1, L, G, T, A] without one stimulus."""
        rows, cols = np.triu_indices(self.stimuli, k=1)
        rest = (rows != stimulus) & (cols != stimulus)
        r = compare_all(self.layers[:, rest], self.animals[:, rest], method=self.comparison)
        return self._arranged(r[None])

    def _arranged(self, r: Floats) -> Floats:
        """Return comparisons [N, M, T·A] as [N, L, G, T, A]; NaN where nothing is compared."""
        _, _, bins, animals = self.usable.shape
        every = r.reshape(*r.shape[:2], bins, animals)
        shifted = every[:, self.place, np.arange(bins)]
        return np.where(self.usable, shifted, np.nan)


def votes(r: Floats) -> Floats:
    """Return the mean over time [N, L, G, A] of comparisons [N, L, G, T, A]; NaN where there are none."""
    return finite_mean(r, axis=-2)


def held_out_course(r: Floats) -> tuple[Floats, Ints]:
    """Return comparisons over time [N, T, A] at the layer and lag that suit the *other* animals best.

    A single animal has no others; its own best is taken, and the permutations repeat that. From comparisons [N, L, G,
    T, A]. Returns the comparisons, and the chosen candidates [N, A], counted through layers and lags.
    """
    number, layers, lags, bins, animals = r.shape
    vote = np.nan_to_num(votes(r), nan=_NEVER).reshape(number, layers * lags, animals)
    chosen = choose_on_others(vote) if animals > 1 else vote.argmax(axis=1)
    every = r.reshape(number, layers * lags, bins, animals)
    return np.take_along_axis(every, chosen[:, None, None, :], axis=1)[:, 0], chosen


def profile(excess: Floats) -> Floats:
    """Return how well layers match at each lag [L, G], up to a constant per layer, from comparisons [L, G, T, A].

    Lags differ in the bins that have a model time, and bins differ in how well they match at any lag (before the
    response nothing does). So neighbouring lags are compared over the bins that both have, and the differences added
    up. NaN where a lag has no comparison.
    """
    steps = finite_mean(excess[:, 1:] - excess[:, :-1], axis=(-2, -1))
    total = np.cumsum(np.nan_to_num(steps), axis=-1)
    heights = np.concatenate([np.zeros((len(excess), 1)), total], axis=-1)
    return np.where(np.isfinite(excess).any(axis=(-2, -1)), heights, np.nan)


def best_lag(excess: Floats) -> Floats:
    """Return the lag [L] at which each layer matches best, in steps from the first one, from comparisons [L, G, T, A].

    Between steps a parabola goes through the best lag and its neighbours, over the bins that all three have. NaN where
    there is no comparison, or the best lag is the first or last of those compared.
    """
    height = profile(excess)
    top = np.where(np.isfinite(height), height, -np.inf).argmax(axis=1)
    at = np.clip(top, 1, excess.shape[1] - 2)
    three = np.take_along_axis(excess, (at[:, None] + np.arange(-1, 2))[:, :, None, None], axis=1)
    shared = np.where(np.isfinite(three).all(axis=1, keepdims=True), three, np.nan)
    before, here, after = finite_mean(shared, axis=(-2, -1)).T
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = 0.5 * (before - after) / (before - 2 * here + after)
    # Over fewer bins the peak may move, but not beyond the neighbours.
    inside = (top == at) & np.isfinite(shift) & (before - 2 * here + after < 0)
    return np.where(inside, at + np.clip(shift, -1, 1), np.nan)


ALPHA = 0.05  # level at which a layer's latency is given


@dataclass(frozen=True)
class LayerLatency:
    """Lag of the animals behind one layer."""

    layer: str
    latency: float
    """Lag of the best match, seconds; positive where neurons follow the model. NaN where ``reason`` says why."""
    value: float
    """Mean raw comparison at the best lag, less chance."""
    p: float
    """Permutation p of the best match over lags, corrected for the number of layers and lags."""
    interval: Interval | None = None
    """Interval of ``latency`` over animals and stimuli."""
    reason: str = ""
    """Reason for having no latency."""


def standardised(null: Floats) -> Floats:
    """Return statistics [N, ...] in standard deviations from their mean over permutations; −∞ where undefined."""
    # Chance differs between times and lags: by an early bin's few spikes, by the bins that overlap.
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = finite_mean(np.moveaxis(null, 0, -1))
        spread = np.sqrt(finite_mean(np.moveaxis((null - mean) ** 2, 0, -1)))
        z = (null - mean) / spread
    return np.where(np.isfinite(z), z, -np.inf)


def layer_latencies(
    names: tuple[str, ...], lags: Floats, excess: Floats, left_out: list[Floats], match: Floats
) -> tuple[LayerLatency, ...]:
    """Return every layer's latency.

    ``lags`` [G] are seconds, ``excess`` [L, G, T, A] comparisons less chance, ``left_out`` the same without each
    stimulus in turn, ``match`` [N, L, G] mean comparisons under permutations, the given order first.
    """
    z = standardised(match)
    p = tail_p(z.reshape(len(z), -1).max(axis=1)[:, None], z[0].max(axis=-1))
    animals, step = excess.shape[-1], lags[1] - lags[0]

    def latency(values: Floats) -> Floats:
        return lags[0] + step * best_lag(values)

    best = latency(excess)
    # Pseudo-values, whose variance over animals is that of the jackknife.
    singles = np.stack([latency(np.delete(excess, index, axis=-1)) for index in range(animals)], axis=-1)
    pseudo = animals * best[:, None] - (animals - 1) * singles
    without = np.stack([latency(item) for item in left_out], axis=-1)
    reached = finite_mean(votes(excess[None])[0])
    latencies = []
    for index, name in enumerate(names):
        tried, reason = int(np.isfinite(reached[index]).sum()), ""
        if tried < 3:
            reason = "the layer has no time" if tried == 1 else "too few lags have a comparison"
        elif p[index] > ALPHA:
            reason = "no lag matches better than permuted stimuli"
        elif not math.isfinite(best[index]):
            reason = f"the best match lies at the end of the lags tried, {lags[0]:g} to {lags[-1]:g} s"
        # One replicate without a peak would make the error too small.
        steady = bool(np.isfinite(pseudo[index]).all() and np.isfinite(without[index]).all()) and animals > 1
        latencies.append(
            LayerLatency(
                layer=name,
                latency=math.nan if reason else float(best[index]),
                value=float(np.nanmax(reached[index])) if tried else math.nan,
                p=float(p[index]) if tried else math.nan,
                interval=two_factor_interval(float(best[index]), pseudo[index], without[index])
                if steady and not reason
                else None,
                reason=reason,
            )
        )
    return tuple(latencies)
