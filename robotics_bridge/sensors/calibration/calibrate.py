"""Fit the noise knobs to a recording of a real device, with intervals.

A log holds readings of one or more probes and, where known, the true signal that was applied (a load cell, a
position stage). Per episode (between resets of the device) the model is

    y_j(t) = round_q[γ_j (x + β ξ_τ(x)) (t − delay) + b + d_j(t) + n_j(t)],

as in :mod:`robotics_bridge.sensors.noise.model`. The likelihood is exact and costs one sine transform. Rounding counts
as white noise of variance q²/12, which is right while the white noise is not much smaller than a step.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from brainbench.core.errors import DataError, UsageError, check_number, listing
from brainbench.core.reading.tables import read_columns
from robotics_bridge.sensors.calibration.likelihood import (
    MOST_HYSTERESIS,
    SIGNIFICANT,
    Z95,
    Episode,
    Estimate,
    Fit,
    align,
    calm,
    extent,
    find_delays,
    find_lags,
    fit_dynamics,
)
from robotics_bridge.sensors.noise.model import Noise

SHORTEST = 10
"""Readings of the shortest episode that is used."""
LARGEST = 1e12
"""Magnitude of times and readings beyond which a log is taken to be damaged."""
SLOWEST = 0.2
"""Longest time (s) between readings of a device; beyond it times look like milliseconds."""
FARTHEST = 2.0
"""Distance (m) of the ball from its link above which numbers look like millimetres."""
_PLACE = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Log:
    """A recording."""

    time: NDArray[np.float64]
    """[T] (s), evenly spaced within an episode."""
    readings: NDArray[np.float64]
    """[T, N] [unit of the sensor]."""
    reference: NDArray[np.float64] | None = None
    """[T] true signal [unit of the sensor]; None for a device at rest, whose true signal is 0."""
    episode: NDArray[np.int64] | None = None
    """[T] number of the episode; None for one."""
    probes: tuple[str, ...] = ()
    """Names [N]."""
    ball: NDArray[np.float64] | None = None
    """[T, 3] centre of the ball that presses the device (m, frame of its link); None where none is known."""

    def __post_init__(self) -> None:
        for name in ("time", "readings", "reference", "episode", "ball"):
            if (values := getattr(self, name)) is not None:
                object.__setattr__(self, name, values := np.asarray(values))
                flat = values.ndim == 1 or name in ("readings", "ball")
                if values.shape[:1] != np.shape(self.time)[:1] or not flat:
                    raise UsageError(f"{name} has the shape {values.shape}, time {np.shape(self.time)}.")
                if not np.isfinite(values).all():
                    raise UsageError(f"{name} of a log must be finite numbers; leave out the rows of the others.")
        if self.readings.ndim != 2 or not self.readings.size:
            raise UsageError(f"Readings are [T, N] with T = {len(self.time)}; received {self.readings.shape}.")
        if self.probes and len(self.probes) != self.readings.shape[1]:
            raise UsageError(f"{self.readings.shape[1]} probes have as many names; received {len(self.probes)}.")
        gaps = np.concatenate([np.diff(self.time[span]) for span in self.spans])
        if len(gaps) and not (gaps.min() > 0 and gaps.max() <= 1.5 * gaps.min()):
            raise UsageError(
                "Times of a log must rise in equal steps within an episode; received steps of "
                f"{gaps.min():g} to {gaps.max():g} s. Begin an episode at a gap, and leave out what was written twice."
            )
        if len(self.time) > 1 and not 0 < self.step <= SLOWEST:
            raise UsageError(
                f"Times of a log (s) rise by at most {SLOWEST:g} s; received steps of {self.step:g} s. Scale "
                "milliseconds by 1e-3."
            )
        if self.ball is not None and self.ball.shape[1:] != (3,):
            raise UsageError(f"ball is [T, 3] (m); received {self.ball.shape}.")
        if self.ball is not None and (far := float(np.abs(self.ball).max())) > FARTHEST:
            raise UsageError(f"The ball lies {far:g} m from the origin of its link; scale millimetres by 1e-3.")

    @cached_property
    def spans(self) -> list[slice]:
        """Rows of each episode."""
        numbers = self.episode if self.episode is not None else np.zeros(len(self.time), int)
        edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1), len(numbers)]
        return [slice(start, end) for start, end in itertools.pairwise(edges)]

    @property
    def step(self) -> float:
        """Time between readings [s]."""
        return float(np.median(np.diff(self.time)))


def read_log(path: str | os.PathLike[str]) -> Log:
    """Read a CSV file with a header: ``time`` (s), optionally ``reference``, ``episode``, ``x``, ``y`` and ``z`` (the
    centre of a ball, m), else probes.
    """
    name = Path(path).name
    header, table = read_columns(path, "log")
    pressed = set(_PLACE) <= set(header)
    others = ("time", "reference", "episode", *(_PLACE if pressed else ()))
    probes = [cell for cell in header if cell.lower() not in others]
    if "time" not in [cell.lower() for cell in header] or not probes:
        raise DataError(
            f"{name} needs a header with 'time' (s) and at least one column of readings; found {listing(header)}."
        )
    if len(table) < 20:
        raise DataError(f"{name} holds {len(table)} readings; a calibration needs at least 20 (better thousands).")
    if (np.abs(table) > LARGEST).any():
        raise DataError(f"{name} holds a number beyond ±{LARGEST:g}, which no device reads; remove its row.")
    columns = {cell.lower(): table[:, index] for index, cell in enumerate(header)}
    readings = np.stack([table[:, header.index(probe)] for probe in probes], axis=1)
    episode = None
    if "episode" in columns:
        episode = columns["episode"].astype(np.int64)
        if (np.abs(columns["episode"]) > 1e9).any() or (episode != columns["episode"]).any():
            raise DataError(f"{name}: episodes are whole numbers of at most a billion.")
    if episode is not None and not (np.diff(episode) == 0).any():
        raise DataError(f"{name}: no two rows are of one episode.")
    ball = np.stack([columns[name] for name in _PLACE], axis=1) if pressed else None
    try:
        return Log(columns["time"], readings, columns.get("reference"), episode, tuple(probes), ball)
    except UsageError as error:
        raise DataError(f"{name}: {error}") from None


def segments(log: Log) -> list[Episode]:
    """Split a log into its episodes, without those of fewer than :data:`SHORTEST` readings."""
    x = np.zeros(len(log.time)) if log.reference is None else log.reference
    long = [(x[span], log.readings[span]) for span in log.spans if span.stop - span.start >= SHORTEST]
    if not long:
        raise DataError(f"Every episode of the log has fewer than {SHORTEST} readings; record longer ones.")
    return long


def find_quantum(values: NDArray[np.float64]) -> float:
    """Return the step of which all readings are multiples, 0 if there is none."""
    distinct = np.unique(values)
    if len(distinct) < 2:
        return 0.0
    steps = np.diff(distinct)
    scale = float(np.abs(distinct).max())
    steps = steps[steps > 1e-6 * scale]
    if not len(steps):
        return 0.0
    step = float(steps.min())
    # A finer estimate from far apart values, then the test that every value is a multiple.
    for _ in range(3):
        whole = np.round(distinct / step)
        step = float(distinct @ whole / (whole @ whole)) if whole @ whole else step
    off = np.abs(distinct / step - np.round(distinct / step))
    coarse = len(distinct) < 0.5 * len(values) or len(values) < 50
    return step if off.max() < 0.02 and coarse else 0.0


NOT_FITTED = ("radius", "crosstalk")  # knobs that a log of one signal cannot tell: they need known places
_ROUNDS = 12
_ROUGH = 0.5  # noise of the reference, as a part of the probes' in its unit, from which it is mentioned
_SLOW = 1.05  # noise, in that at rest, up to which readings are explained without delays that vary
_BETTER = 0.97  # part of the variance that must remain for readings to be called early
ORDER = (
    "gain_low", "gain_high", "hysteresis", "hysteresis_tau", "walk", "white", "bias", "quantum", "dead_probability",
    "dead_low", "dead_high", "read_delay", "jitter",
)  # fmt: skip
"""Knobs in the order of the model."""


@dataclass(frozen=True)
class Calibration:
    """The fitted noise model."""

    noise: Noise
    estimates: Mapping[str, Estimate]
    """By knob, in the order of the model; ``gain_low`` and so on for the ends of ranges."""
    notes: tuple[str, ...] = ()
    """Knobs that could not be told, and why."""
    about: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: str | os.PathLike[str], **about: Any) -> None:
        """Write the noise as a preset with the intervals beside it."""
        self.noise.save(path, estimates=self.estimates, notes=self.notes, **{**self.about, **about})


def calibrate(log: Log, *, max_delay: float = 0.5) -> Calibration:
    """Fit the knobs to a log, with delays of at most ``max_delay`` [s]."""
    check_number("max_delay (s)", max_delay, least=0)
    estimates: dict[str, Estimate] = {}
    notes = [f"Not fitted: {', '.join(NOT_FITTED)}."]
    parts = segments(log)
    if skipped := len(np.unique(log.episode)) - len(parts) if log.episode is not None else 0:
        notes.append(f"{skipped} episodes of fewer than {SHORTEST} readings were left out.")
    # Exactly equal: a living probe has noise, or moves by a quantisation step now and then.
    stuck = [np.ptp(y, axis=0) == 0 for _x, y in parts]
    living = [(x, y[:, ~dead]) for (x, y), dead in zip(parts, stuck, strict=True) if (~dead).any()]
    if not living:
        raise DataError("Every probe of the log is stuck at one value, so nothing can be fitted.")
    if log.reference is not None:
        # Where nothing was applied, a living probe may well read the same all the time.
        moved = [index for index, (x, _y) in enumerate(parts) if np.ptp(x) > 0]
        if not moved:
            raise DataError("The reference never changes; leave the column out for a device at rest.")
        dead, values = (
            np.concatenate([items[index] for index in moved]) for items in (stuck, [y[0] for _, y in parts])
        )
        estimates |= _dead(dead, values)
    quantum = find_quantum(np.concatenate([y.ravel() for _x, y in living]))
    how = "all readings are its multiples" if quantum else "none found"
    estimates["quantum"] = Estimate(quantum, quantum, quantum, how)
    moving = log.reference is not None
    longest = round(max_delay / log.step)
    guess = _delays(living, log.step, longest) if moving else (0, 0)
    fit, guess, doubts = _fit_delayed(living, guess, log.step, quantum, longest, moving=moving)
    notes += doubts
    lags = np.zeros(0, int)
    if moving and guess[1]:
        # Hysteresis can stand for a part of a delay that varies, so lags are also sought without it.
        starts = [fit] + [replace(fit, dynamics=fit.dynamics._replace(hysteresis=0.0))] * bool(fit.dynamics.hysteresis)
        settled = [_settle(living, guess, log.step, quantum, start, longest) for start in starts]
        fit, lags = min(settled, key=lambda pair: _spread(pair[0]))
        if _spread(fit) > 2 * _calm(living, fit, log.step, 2 * guess[1]):
            notes.append(
                "Where the reference moves, readings differ more from the model than where it rests: delay, jitter, "
                "hysteresis and white noise may be wrong; log more presses."
            )
    if not moving:
        notes.append("Without a column 'reference' the true signal counts as 0: gain, delay, hysteresis and dead "
                     "probes were not fitted.")  # fmt: skip
    else:
        notes += _reference_notes(living, fit)
        estimates |= delay_of(extent(lags, guess), len(lags), log.step) | _gain(fit)
        if len(fit.gains) < 20 and estimates["gain_high"].value > estimates["gain_low"].value:
            notes.append(
                f"The range of gains rests on {len(fit.gains)} probes; log more probes or resets to narrow it."
            )
    estimates |= fit.estimates
    if quantum > 2.5 * max(estimates["white"].value, 1e-300):
        notes.append("The white noise is far below a quantisation step; its value is an upper bound at best.")
    estimates = {name: estimates[name] for name in ORDER if name in estimates}
    about = {"readings": int(log.readings.size), "probes": list(log.probes), "episodes": len(parts), "step": log.step}
    return Calibration(_noise(estimates), estimates, tuple(notes), about)


def _fit_delayed(
    living: list[Episode], guess: tuple[int, int], step: float, quantum: float, longest: int, *, moving: bool
) -> tuple[Fit, tuple[int, int], list[str]]:
    """Return a fit at a range of lags, that range or what explains as much without it, and what is to be said of it."""
    fit = fit_dynamics(align(living, *guess, longest), step, quantum, moving=moving)
    if guess[1]:
        # A delay must earn its place, too: where a reference hardly bends it is hysteresis of the other sign.
        prompt = fit_dynamics(align(living, 0, 0, longest), step, quantum, moving=True)
        if 2 * (prompt.cost - fit.cost) <= SIGNIFICANT:
            note = f"A delay of {guess[1] * step:g} s fits no better than none, which is written: log faster presses."
            return prompt, (0, 0), [note]
    if guess[0] < guess[1]:
        # Readings that follow slowly (a hysteresis below 0) look as if they were late by more or less.
        slow = fit_dynamics(align(living, guess[0], guess[0], longest), step, quantum, moving=True)
        if slow.dynamics.hysteresis < 0 and _spread(slow) < _SLOW * _calm(living, slow, step, 2 * guess[1]):
            return slow, (guess[0], guess[0]), []
    return fit, guess, []


def _delays(parts: list[Episode], step: float, longest: int) -> tuple[int, int]:
    """Return the range of lags of the readings; DataError where they lie beyond ``longest``, or before the reference.

    Early readings follow the reference better when they are put later, which those of hysteresis do not.
    """
    guess = find_delays(parts, longest)
    if guess[1] == longest < find_delays(parts, longest + 1)[1]:
        raise DataError(
            f"The readings come later after the reference than the longest delay that was tried ({longest * step:g} s, "
            f"{longest} readings); allow a longer one (max_delay)."
        )
    reach = min(max(longest, 1), min(len(x) for x, _y in parts) // 4)
    lead = reach - find_delays([(x[reach:], y[:-reach]) for x, y in parts], 2 * reach)[1]
    if lead > 0:
        shifted = ([(x[shift:], y[: len(y) - shift]) for x, y in parts] for shift in (0, lead))
        fits = (fit_dynamics(align(each, 0, 0, longest), step, 0.0, moving=True) for each in shifted)
        now, put = map(_spread, fits)
        if put < _BETTER * now:
            raise DataError(
                f"The readings come {lead * step:g} s before the reference: the clock of one is wrong. Put the "
                f"reference earlier by that ({lead} rows)."
            )
    return guess


def _reference_notes(parts: list[Episode], fit: Fit) -> list[str]:
    """Return what the reference spoils; DataError where the readings hardly follow it."""
    if abs(fit.dynamics.hysteresis) > 0.99 * MOST_HYSTERESIS:
        raise DataError(
            f"No delay and hysteresis explain the readings (a hysteresis of {MOST_HYSTERESIS:g} or more): the "
            "reference is noisy, of another clock, or of something else."
        )
    # Second differences of presses are small; their median is that of noise.
    bends = np.concatenate([np.diff(x, 2) for x, _y in parts])
    rough = 1.4826 * float(np.median(np.abs(bends))) / math.sqrt(6)
    if rough <= _ROUGH * fit.dynamics.white / abs(float(np.median(fit.gains))):
        return []
    return [
        f"The reference has noise of its own of about {rough:.2g}: white noise counts both, and gain, delay and "
        "hysteresis may be wrong; smooth the reference."
    ]


def _spread(fit: Fit) -> float:
    return fit.dynamics.white**2 + fit.dynamics.walk**2


def _calm(living: list[Episode], fit: Fit, step: float, longest: int) -> float:
    """Return the noise's variance where lags of up to ``longest`` matter least."""
    models = [fit.dynamics.response(x, step, own) for (x, _y), own in zip(living, fit.creep, strict=True)]
    return float(np.median([calm(model, y, longest) for model, (_x, y) in zip(models, living, strict=True)]))


def _settle(
    living: list[Episode], guess: tuple[int, int], step: float, quantum: float, fit: Fit, longest: int
) -> tuple[Fit, NDArray[np.int64]]:
    """Return dynamics and certain lags: each is simple where the other is known, so they are fitted in turn."""
    lags = np.zeros(0, int)
    for _ in range(_ROUNDS):
        aligned, fresh = find_lags(living, guess, step, fit, longest)
        settled, lags = np.array_equal(fresh, lags), fresh
        if settled or (guess[0] == guess[1] and np.all(lags == guess[0])):
            break
        fit = fit_dynamics(aligned, step, quantum, moving=True, start=fit)
    return fit, lags


def _noise(estimates: Mapping[str, Estimate]) -> Noise:
    knobs: dict[str, Any] = {name: item.value for name, item in estimates.items()}
    for name, ends in {"gain": ("gain_low", "gain_high"), "dead_range": ("dead_low", "dead_high")}.items():
        if ends[0] in knobs:
            knobs[name] = tuple(knobs.pop(end) for end in ends)
    if not knobs["hysteresis"]:
        knobs.pop("hysteresis_tau", None)
    return Noise(**knobs)


def delay_of(lags: tuple[int, int], certain: int, step: float) -> dict[str, Estimate]:
    """Return delay and jitter: lags are rounded up to whole readings and spread evenly over twice the jitter."""
    first, last = lags
    middle, half = (first + last - 1) / 2 * step, (last - first + 1) / 2 * step
    if first == last:
        middle, half = last * step, 0.0
    # No reading comes before its signal.
    half = min(half, middle)
    low = max(middle - (step if first == last else step / 2), 0.0)
    high = middle if first == last else middle + step / 2
    how = f"{certain} readings whose lag is certain" if certain else "no lag is certain"
    return {
        "read_delay": Estimate(middle, low, high, "best agreement, to one reading"),
        "jitter": Estimate(half, max(half - step / 2, 0.0), half + step / 2, how),
    }


def _dead(stuck: NDArray, values: NDArray) -> dict[str, Estimate]:
    """Return the share of dead probes with its exact binomial interval (Clopper & Pearson), and their values."""
    count, dead = len(stuck), int(stuck.sum())
    low = float(beta.ppf(0.025, dead, count - dead + 1)) if dead else 0.0
    high = float(beta.ppf(0.975, dead + 1, count - dead)) if dead < count else 1.0
    estimates = {"dead_probability": Estimate(dead / count, low, high, f"{dead} of {count} probes are stuck")}
    if dead:
        for name, value in {"dead_low": values[stuck].min(), "dead_high": values[stuck].max()}.items():
            estimates[name] = Estimate(float(value), math.nan, math.nan, "extreme of the stuck values")
    return estimates


def _gain(fit: Fit) -> dict[str, Estimate]:
    """Return the range of the gains: the extremes, moved out by their mean distance from the ends."""
    gains, count = np.sort(fit.gains), len(fit.gains)
    mean = float(np.average(fit.gains, weights=1 / fit.gain_errors**2))
    if mean <= 0:
        raise DataError("The readings fall where the reference rises; turn the sign of one of them.")
    span = float(gains[-1] - gains[0])
    noise = float(np.median(fit.gain_errors))
    if count < 2 or span < 6 * noise:
        middle, how = float(gains[0]), "one probe: no range"
        if count > 1:
            middle, how = mean, "gains are equal within their errors"
        error = Z95 * noise / math.sqrt(count)
        return dict.fromkeys(("gain_low", "gain_high"), Estimate(middle, middle - error, middle + error, how))
    # For uniform gains the extremes lie inside the range by its width / (n + 1) on average, which is span / (n − 1).
    out = span / (count - 1)
    low, high = max(float(gains[0] - out), 0.0), float(gains[-1] + out)
    # The end lies beyond the extreme by at most the span times a^(-1/(n-1)) - 1, at confidence 1 - a per end.
    reach = span * (0.025 ** (-1 / (count - 1)) - 1)
    how = f"extremes of {count} gains"
    return {
        "gain_low": Estimate(low, float(gains[0]) - reach, float(gains[0]) + Z95 * noise, how),
        "gain_high": Estimate(high, float(gains[-1]) - Z95 * noise, float(gains[-1]) + reach, how),
    }
