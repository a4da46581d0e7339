"""RDMs in every bin of time, the latency of each layer, and the score at each time.

A lag is positive where neurons follow the model: the animals' bin t is compared with the model's bin t − lag. A layer's
latency is the lag at which its mean comparison over times and animals, less chance, is highest. Its error is a
jackknife over animals and stimuli (Miller, Patterson & Ulrich 1998, doi:10.1111/1469-8986.3510099, for animals).

The layer and the lag for an animal are those that suit the *other* animals best over all times; at each time the
animal's comparison with that layer is corrected for the animal's noise in that bin. All of it is repeated under
permuted stimuli, and a time counts as significant where its standardised mean comparison exceeds the largest over all
times of the permutations (maximum statistic, Nichols & Holmes 2002, doi:10.1002/hbm.1058).

Letters: N permutation, L layer, G lag, T time bin, A animal, K stimulus, F feature, U unit, P = K(K−1)/2 RDM pair.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError, check_number, listing
from brainbench.core.files import to_plain
from brainbench.core.progress import Progress, stages
from brainbench.core.records import Interval
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, two_factor_interval
from brainbench.metrics.arrays import Floats, Ints, finite_mean
from brainbench.metrics.evaluation import choose_on_others, most_chosen
from brainbench.metrics.inference.permutation import canonical_order, label_orders, tail_p
from brainbench.metrics.rdms.comparison import (
    check_comparison,
    compare_all,
    permuted_comparisons,
    permuted_pairs,
    rdm_stack,
    stimulus_count,
)
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE
from brainbench.metrics.reliability.subject_rdm import is_flat, subject_rdm
from brainbench.scoring.scores import ScoreInputs

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
        """Return the lag [s] of the best match along the axis of lags."""
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


SPLITS = 100  # random split halves of an animal in each bin
_METHOD: dict[str, Any] = {
    "method": "crossnobis", "comparison": "whitened-cosine", "noise": "none", "splits": SPLITS,
}  # fmt: skip
_PARTLY = 0.5  # a last bin of which less than this share lies inside the stimulus is left out


@dataclass(frozen=True)
class AnimalMovie:
    """An animal's RDM in every bin of time, with its reliability there."""

    subject: str
    rdms: Floats = field(repr=False)
    """[T, P]; NaN in bins that have no RDM."""
    reliability: Floats
    """[T] Spearman-Brown reliability of the bin's RDM; NaN where it has none."""
    problems: tuple[str | None, ...] = ()
    """[T] reason for having no RDM in a bin; None elsewhere."""


def animal_movie(subject: str, blocks: Sequence[Trials], n_stimuli: int, **options: Any) -> AnimalMovie:
    """Return an animal's RDM and reliability in every bin, from responses [R, T, U] of its sessions.

    All bins split the same trials into the same halves, so differences between bins are not those of the splits.
    ``options`` are those of :func:`~brainbench.metrics.reliability.subject_rdm.subject_rdm`. The default method is the
    squared Euclidean distance without the share of trial noise, which would look like geometry before any response.
    """
    shapes = [np.shape(block.responses) for block in blocks]
    if not shapes or any(len(shape) != 3 for shape in shapes) or len({shape[1] for shape in shapes}) > 1:
        raise UsageError(
            f"Scores over time need responses [trials, time, units] of equal time in all sessions; {subject!r} has "
            f"shapes {shapes}."
        )
    how = {**_METHOD, **options}
    subjects = []
    for bin in range(shapes[0][1]):
        parts = [replace(block, responses=np.asarray(block.responses)[:, bin], times=None) for block in blocks]
        subjects.append(subject_rdm(subject, parts, n_stimuli, **how))
    usable = np.array([item.problem is None for item in subjects])
    rdms = np.where(usable[:, None], np.stack([item.rdm for item in subjects]), np.nan)
    reliability = np.where(usable, [item.reliability for item in subjects], np.nan)
    return AnimalMovie(subject, rdms, reliability, tuple(item.problem for item in subjects))


def layer_movie(values: ArrayLike, step: float, width: float, *, method: str = "sqeuclidean") -> Floats:
    """Return a layer's RDMs [T, P] in bins of ``width`` seconds, from activations [K, T, F] every ``step`` seconds.

    A layer without time ([K, 1, F]) gives one RDM, which stands for all times.
    """
    array = np.asarray(values)
    bins = array if array.ndim == 3 and array.shape[1] == 1 else in_bins(array, step, width)
    return np.stack([rdm(bins[:, index], method=method) for index in range(bins.shape[1])])


def in_bins(values: ArrayLike, step: float, width: float) -> Floats:
    """Average activations [K, T, F], each lasting ``step`` seconds, over bins [K, T', F] of ``width`` seconds.

    An activation counts in a bin for as long as it lasts there.

    >>> in_bins([[[0.0], [1.0], [2.0], [3.0]]], 0.5, 1.0).ravel().tolist()
    [0.5, 2.5]
    """
    array = np.asarray(values)
    if array.ndim != 3 or not (step > 0 and width > 0):
        raise UsageError(
            "Bins of time need activations [stimuli, time, features] and positive times; received shape "
            f"{array.shape}, a step of {step} s and bins of {width} s."
        )
    steps = array.shape[1]
    count = max(1, math.floor(steps * step / width + 1 - _PARTLY))
    begins, starts = np.arange(count)[:, None] * width, np.arange(steps) * step
    shared = np.minimum(begins + width, starts + step) - np.maximum(begins, starts)
    # Rounding leaves steps that only touch a bin a tiny share of it.
    weights = np.where(shared > 1e-9 * width, shared, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.einsum("bt,ktf->kbf", weights, array.astype(np.float64))


PERMUTATIONS = 1000  # random orders of the stimuli, above six stimuli; all orders up to six
_FARTHEST = 0.4  # largest lag, as a share of the recorded time


@dataclass(frozen=True)
class TimePoint:
    """The score in one bin of time."""

    time: float
    """Middle of the bin, seconds after the window's begin."""
    value: float
    """Mean noise-corrected comparison of the animals that are reliable in this bin; NaN without any."""
    r: float
    """Mean raw comparison of all animals."""
    chance: float
    """Mean of ``value`` under permuted stimuli, layer and lag chosen anew."""
    reliability: float
    """Mean over animals."""
    animals: int
    """Animals that are reliable in this bin."""
    p: float
    """Permutation p, corrected for the number of times."""
    interval: Interval | None = None
    """Interval of ``value`` over animals and stimuli."""


@dataclass(frozen=True)
class TimeCourse:
    """A model's score over time."""

    points: tuple[TimePoint, ...]
    latencies: tuple[LayerLatency, ...]
    p: float
    """Permutation p of the best time, corrected for all times."""
    layer: str
    """The layer chosen most often when each animal in turn is held out."""
    bin: float
    """Width of a bin, seconds."""
    largest_lag: float
    """Largest lag that was tried in both directions, seconds."""
    permutations: int
    """Orders of the stimuli, the given one included."""
    reasons: tuple[str, ...] = ()
    """Remarks for a reader, in words."""


def score_over_time(
    layers: Mapping[str, ArrayLike],
    animals: Sequence[AnimalMovie],
    *,
    width: float,
    comparison: str = "whitened-cosine",
    permutations: int = PERMUTATIONS,
    seed: int = 0,
) -> TimeCourse:
    """Score the RDMs of a model's layers against animals at each time.

    ``layers`` are RDMs [T', P] in bins of ``width`` seconds from :func:`layer_movie`, bin 0 beginning when the animals'
    first bin does; ``animals`` come from :func:`animal_movie`, for the same stimuli and bins. ``permutations`` are
    drawn above six stimuli.
    """
    check_comparison(comparison)
    movies = _checked(layers, animals, width)
    bins = len(animals[0].rdms)
    largest = max(1, math.floor(_FARTHEST * bins))
    joined = LaggedRDMs.join(movies, [item.rdms for item in animals], largest=largest, comparison=comparison)
    reliability = np.stack([item.reliability for item in animals], axis=1)
    # A raw comparison is multiplied by this; NaN where a bin is not reliable.
    factors = 1 / np.sqrt(np.where(reliability >= RELIABILITY_GATE, reliability, np.nan))
    courses, values, matches, chosen, expected = [], [], [], None, 0.0
    for r in joined.permuted(permutations, seed):
        expected = expected + r.sum(axis=0)
        course, picked = held_out_course(r)
        chosen = picked[0] if chosen is None else chosen
        courses.append(finite_mean(course))
        values.append(finite_mean(course * factors))
        matches.append(finite_mean(votes(r)))
    assert chosen is not None
    # The first order is the given one.
    course, value, match = (np.concatenate(parts) for parts in (courses, values, matches))
    # Each time is judged by the largest over all times in each permutation.
    z = standardised(course)
    largest_z = z.max(axis=1)
    p = np.where(np.isfinite(course[0]), tail_p(largest_z[:, None], z[0]), np.nan)
    observed = joined.compared()
    corrected = held_out_course(observed)[0][0] * factors
    left_out = [joined.without_stimulus(stimulus) for stimulus in range(joined.stimuli)]
    without_each = [finite_mean(held_out_course(item)[0][0] * factors) for item in left_out]
    every = zip(finite_mean(corrected), corrected, np.stack(without_each, axis=-1), strict=True)
    intervals = [two_factor_interval(float(mean), *item) if np.isfinite(mean) else None for mean, *item in every]
    points = tuple(
        TimePoint(
            time=(index + 0.5) * width,
            value=float(value[0, index]),
            r=float(course[0, index]),
            chance=float(finite_mean(value[:, index])),
            reliability=float(finite_mean(reliability[index])),
            animals=int(np.isfinite(corrected[index]).sum()),
            p=float(p[index]),
            interval=intervals[index],
        )
        for index in range(bins)
    )
    names, chance = tuple(layers), expected / len(course)
    excess, without = observed[0] - chance, [item[0] - chance for item in left_out]
    latencies = layer_latencies(names, joined.lags.astype(np.float64) * width, excess, without, match)
    if not np.isfinite(factors).any():
        # What unreliable bins match is noise, or what all bins share, and either has no lag.
        reason = "no animal is reliable in any bin"
        latencies = tuple(replace(item, latency=math.nan, interval=None, reason=reason) for item in latencies)
    return TimeCourse(
        points=points,
        latencies=latencies,
        p=float(tail_p(largest_z)),
        layer=names[most_chosen(chosen // len(joined.lags))],
        bin=width,
        largest_lag=largest * width,
        permutations=len(course),
        reasons=_reasons(animals, points, joined.stimuli),
    )


def _checked(layers: Mapping[str, ArrayLike], animals: Sequence[AnimalMovie], width: float) -> list[Floats]:
    if not layers or not animals:
        raise UsageError("Scores over time need at least one layer and one animal.")
    check_number("The width of the bins of time (s)", width, above=0)
    movies = [np.atleast_2d(rdm_stack(movie, f"The RDMs of layer {name!r}")) for name, movie in layers.items()]
    bins, pairs = animals[0].rdms.shape
    for name, movie in zip(layers, movies, strict=True):
        if movie.ndim != 2 or movie.shape[1] != pairs:
            raise UsageError(f"The RDMs of layer {name!r} have shape {movie.shape}; expected [time, {pairs} pairs].")
    for animal in animals:
        if animal.rdms.shape != (bins, pairs):
            raise UsageError(
                f"The RDMs of {animal.subject!r} have shape {animal.rdms.shape}; those of {animals[0].subject!r} "
                f"{(bins, pairs)}."
            )
    if bins < 3 or pairs < 6:
        raise UsageError(
            f"Scores over time need at least 3 bins and 4 stimuli; received {bins} and {pairs} pairs of stimuli; "
            "choose smaller bins (--bin) or a longer window."
        )
    return movies


def _reasons(animals: Sequence[AnimalMovie], points: tuple[TimePoint, ...], stimuli: int) -> tuple[str, ...]:
    reasons = []
    if len(animals) < FEWEST_ANIMALS or stimuli < FEWEST_STIMULI:
        needed = f"{FEWEST_ANIMALS} animals and {FEWEST_STIMULI} stimuli"
        reasons.append(f"intervals need {needed}; there are {len(animals)} and {stimuli}")
    blind = sum(point.animals == 0 for point in points)
    if blind:
        reasons.append(f"no animal is reliable in {blind} of {len(points)} bins, which have no corrected value")
    if len(animals) == 1:
        reasons.append("optimistic: layer and lag are the best of the only animal; the permutations take the same best")
    broken = {item.subject: next(filter(None, item.problems)) for item in animals if any(item.problems)}
    reasons += [f"{subject} has no RDM in some bins: {problem}" for subject, problem in broken.items()]
    return tuple(reasons)


def add_time_course(inputs: ScoreInputs, *, progress: Progress | None = None) -> dict[str, Any]:
    """Return what ``--over-time`` adds to the statistics of a record."""
    return {"time_course": to_plain(time_course(inputs, progress=progress))}


def time_course(inputs: ScoreInputs, *, progress: Progress | None = None) -> TimeCourse:
    """Return the score over time of a model against recordings in bins.

    The window of the recordings begins when the stimuli do. Where the stimuli do not state their duration, they last as
    long as the window of most trials (the median). Recordings have bins of one width.
    """
    brain, network, options = inputs.brain, inputs.network, inputs.options
    metric: Any = inputs.metric  # of RDMs, as was checked before anything was read
    labels = inputs.labels
    if "time" not in brain.dataset.coords or brain.dataset.sizes["time"] < 3:
        raise DataError(
            "Scores over time need recordings in at least 3 bins of time; give a smaller bin (--bin, seconds) or a "
            "longer window."
        )
    begins = brain.dataset["time"].values.astype(np.float64)
    width = float(np.median(np.diff(begins)))
    # Bins between which others were left out are shorter than the distances of their begins.
    longest = float(brain.dataset["duration"].values.max())
    if not np.allclose(begins, longest * np.arange(len(begins)), rtol=0, atol=1e-6 * longest):
        raise UsageError(
            "Scores over time need bins that follow one another from the begin of the window; those of these "
            f"recordings begin at {listing(f'{begin:g}' for begin in begins[:4])} … s: take the whole recordings, or "
            "another window (--window)."
        )
    seconds = network.seconds
    if seconds is None:
        # The last bin may be shorter than the others, and a single trial longer than the others.
        window, whole = float(np.median(brain.dataset["duration"].values.sum(axis=1))), width * len(begins)
        seconds = whole if math.isclose(window, whole, rel_tol=1e-6) else window
    sessions = brain.reliable_trials(labels, options)
    how: dict[str, Any] = {"method": metric.brain_method, "noise": metric.noise, "comparison": metric.comparison}
    stage_done = stages(len(sessions) + len(network.activations), "RDMs over time", progress)
    animals, layers = [], {}
    for subject, (blocks, note) in sessions.items():
        if blocks:
            animals.append(animal_movie(subject, blocks, len(labels), stimuli=labels, seed=options.seed, **how))
        else:
            nothing = np.full((len(begins), math.comb(len(labels), 2)), np.nan)
            animals.append(AnimalMovie(subject, nothing, nothing[:, 0], (note,) * len(begins)))
        stage_done()
    for name, values in network.activations.items():
        layers[name] = layer_movie(values[inputs.rows], seconds / values.shape[1], width, method=metric.model_method)
        stage_done()
    course = score_over_time(layers, animals, width=width, comparison=metric.comparison, seed=options.seed)
    return replace(course, reasons=(*inputs.doubts, *course.reasons))
