"""The score at each time.

The layer and the lag for an animal are those that suit the *other* animals best over all times; at each time the
animal's comparison with that layer is corrected for the animal's noise in that bin. All of it is repeated under
permuted stimuli, and a time counts as significant where its standardised mean comparison exceeds the largest over all
times of the permutations (maximum statistic, Nichols & Holmes 2002, doi:10.1002/hbm.1058).

Letters: N permutation, L layer, G lag, T time bin, A animal, K stimulus, P RDM pair.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import DataError, UsageError, listing
from brainbench.core.files import to_plain
from brainbench.core.progress import Progress, stages
from brainbench.core.reading.ranges import check_number
from brainbench.core.records import Interval
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, two_factor_interval
from brainbench.metrics.arrays import finite_mean
from brainbench.metrics.evaluation import most_chosen
from brainbench.metrics.inference.permutation import tail_p
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.comparison import check_comparison
from brainbench.metrics.rdms.pairs import Floats, rdm_stack
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE
from brainbench.scoring.over_time.lags import (
    LaggedRDMs,
    LayerLatency,
    held_out_course,
    layer_latencies,
    standardised,
    votes,
)
from brainbench.scoring.over_time.movies import AnimalMovie, animal_movie, layer_movie
from brainbench.scoring.scores import ScoreInputs

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
    metric, labels = inputs.metric, inputs.labels
    if not isinstance(metric, RSA):
        raise UsageError(f"Scores over time compare RDMs; the metric {metric.name!r} has none.")
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
    return score_over_time(layers, animals, width=width, comparison=metric.comparison, seed=options.seed)
