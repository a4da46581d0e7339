"""Fit the noise knobs to a recording of a real device, with intervals.

A log holds readings of one or more probes and, where known, the true signal that was applied (a load cell, a
position stage). Per episode (between resets of the device) the model is

    y_j(t) = round_q[γ_j (x + β ξ_τ(x)) (t − delay) + b + d_j(t) + n_j(t)],

as in :mod:`robotics_bridge.sensors.noise.model`. Differences of a random walk plus white noise have a tridiagonal
Toeplitz
covariance, which the sine transform diagonalises: the likelihood is exact and costs one FFT. Rounding counts as
white noise of variance q²/12, which is right while the white noise is not much smaller than a step.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from robotics_bridge.sensors.noise.model import Noise

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

NOT_FITTED = ("radius", "crosstalk")
"""Knobs that a log of one signal cannot tell: they need known places."""
_Z = 1.959963984540054
_ROUNDS = 12
_SIGNIFICANT = 6.63
"""Twice the gain in log-likelihood (χ², one degree, 1 %) that drift or hysteresis must bring to be kept."""


@dataclass(frozen=True, eq=False)
class Log:
    """A recording.

    Raises:
        UsageError: the arrays do not fit each other.
    """

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

    def __post_init__(self) -> None:
        for name in ("reference", "episode"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.time):
                raise UsageError(f"{name} has {len(values)} rows, time {len(self.time)}.")
        if self.readings.ndim != 2 or len(self.readings) != len(self.time):
            raise UsageError(f"Readings are [T, N] with T = {len(self.time)}; received {self.readings.shape}.")

    @property
    def step(self) -> float:
        """Time between readings [s]."""
        return float(np.median(np.diff(self.time)))


@dataclass(frozen=True)
class Estimate:
    """A knob with its interval."""

    value: float
    low: float
    """Lower end of the 95 % interval; NaN where there is none."""
    high: float
    how: str
    """What the value rests on."""


@dataclass(frozen=True)
class Calibration:
    """The fitted noise model."""

    noise: Noise
    estimates: Mapping[str, Estimate]
    """By knob; ``gain_low`` and so on for the ends of ranges."""
    gains: tuple[float, ...] = ()
    """Of each living probe and episode."""
    notes: tuple[str, ...] = ()
    """What could not be told, and why."""
    about: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: str | os.PathLike[str], **about: Any) -> None:
        """Write the noise as a preset with the intervals beside it."""
        self.noise.save(path, estimates=self.estimates, notes=self.notes, **{**self.about, **about})


def read_log(path: str | os.PathLike[str]) -> Log:
    """Read a CSV file with a header: ``time`` (s), optionally ``reference`` and ``episode``, else probes.

    Raises:
        DataFileNotFoundError: the file is missing.
        DataError: it has no time or probe, fewer than 20 rows, uneven steps, or holds what is no number.
    """
    name = Path(path).name
    if not Path(path).is_file():
        raise DataFileNotFoundError(f"There is no log {str(path)!r}.")
    with Path(path).open(newline="", encoding="utf-8-sig") as stream:
        rows = list(csv.reader(stream))
    header = [cell.strip() for cell in rows[0]] if rows else []
    probes = [cell for cell in header if cell.lower() not in ("time", "reference", "episode")]
    if "time" not in [cell.lower() for cell in header] or not probes:
        raise DataError(f"{name} needs a header with 'time' (s) and at least one column of readings; found {header}.")
    if len(rows) < 20:
        raise DataError(f"{name} holds {len(rows) - 1} readings; a calibration needs at least 20 (better thousands).")
    try:
        table = np.array([[float(cell) for cell in row] for row in rows[1:] if row], dtype=float)
    except ValueError as error:
        raise DataError(f"{name} holds a cell that is no number ({error}).") from error
    if table.ndim != 2 or table.shape[1] != len(header) or not np.isfinite(table).all():
        raise DataError(f"{name}: every row needs {len(header)} finite numbers.")
    columns = {cell.lower(): table[:, index] for index, cell in enumerate(header)}
    readings = np.stack([table[:, header.index(probe)] for probe in probes], axis=1)
    episode = columns["episode"].astype(int) if "episode" in columns else None
    log = Log(columns["time"], readings, columns.get("reference"), episode, tuple(probes))
    gaps = np.diff(log.time)[np.diff(episode) == 0] if episode is not None else np.diff(log.time)
    if gaps.min() <= 0 or gaps.max() > 1.5 * gaps.min():
        raise DataError(
            f"{name}: times must rise in equal steps within an episode; found {gaps.min():g}…{gaps.max():g} s."
        )
    return log


def calibrate(log: Log, *, max_delay: float = 0.5) -> Calibration:
    """Fit the knobs to a log.

    Args:
        log: The recording.
        max_delay: Longest delay that is tried [s].

    Raises:
        DataError: no probe is alive, or the reference never changes.
    """
    from robotics_bridge.sensors.calibration import likelihood as parts_of

    estimates: dict[str, Estimate] = {}
    notes = [f"Not fitted: {', '.join(NOT_FITTED)}."]
    knobs: dict[str, Any] = {}
    parts = parts_of.segments(log)
    stuck, values = parts_of.find_dead(parts)
    living = [(x, y[:, ~dead]) for (x, y), dead in zip(parts, stuck, strict=True) if (~dead).any()]
    if not living:
        raise DataError("Every probe of the log is stuck at one value, so nothing can be fitted.")
    if log.reference is not None:
        # Where nothing was applied, a living probe may well read the same all the time.
        moved = [index for index, (x, _y) in enumerate(parts) if np.ptp(x) > 0]
        if not moved:
            raise DataError("The reference never changes; leave the column out for a device at rest.")
        held, at = (np.concatenate([items[index] for index in moved]) for items in (stuck, values))
        _dead(held, at, knobs, estimates)
    quantum = parts_of.find_quantum(np.concatenate([y.ravel() for _x, y in living]))
    knobs["quantum"] = quantum
    estimates["quantum"] = Estimate(
        quantum, quantum, quantum, "all readings are its multiples" if quantum else "none found"
    )
    moving = log.reference is not None
    guess = parts_of.find_delays(living, round(max_delay / log.step)) if moving else (0, 0)
    fit = parts_of.fit_dynamics(parts_of.align(living, *guess), log.step, quantum, moving=moving)
    lags = np.zeros(0, int)
    for _ in range(_ROUNDS if moving and guess[1] else 0):
        aligned, found = parts_of.find_lags(living, guess, log.step, fit)
        settled, lags = np.array_equal(found, lags), found
        if settled or (guess[0] == guess[1] and np.all(lags == guess[0])):
            break
        fit = parts_of.fit_dynamics(aligned, log.step, quantum, moving=True, known=fit)
    if log.reference is None:
        notes.append("Without a column 'reference' the true signal counts as 0: gain, delay, hysteresis and dead "
                     "probes were not fitted.")  # fmt: skip
    else:
        _delay(parts_of.extent(lags, guess), len(lags), log.step, knobs, estimates)
        _gain(fit, knobs, estimates, notes)
    for name, item in fit.estimates.items():
        knobs[name] = item.value
        estimates[name] = item
    if not knobs.get("hysteresis"):
        knobs.pop("hysteresis_tau", None)
    if quantum > 2.5 * max(knobs["white"], 1e-300):
        notes.append("The white noise is far below a quantisation step; its value is an upper bound at best.")
    about = {"readings": int(log.readings.size), "probes": list(log.probes), "episodes": len(parts), "step": log.step}
    return Calibration(Noise(**knobs), estimates, tuple(fit.gains.tolist()), tuple(notes), about)


def _delay(
    lags: tuple[int, int], certain: int, step: float, knobs: dict[str, Any], estimates: dict[str, Estimate]
) -> None:
    """Enter delay and jitter: lags are rounded up to whole readings and spread evenly over twice the jitter."""
    first, last = lags
    middle, half = (first + last - 1) / 2 * step, (last - first + 1) / 2 * step
    if first == last:
        middle, half = last * step, 0.0
    knobs["read_delay"], knobs["jitter"] = middle, min(half, middle)
    low = max(middle - (step if first == last else step / 2), 0.0)
    high = middle if first == last else middle + step / 2
    estimates["read_delay"] = Estimate(middle, low, high, "best agreement, to one reading")
    how = f"{certain} readings whose lag is certain" if certain else "no lag is certain"
    estimates["jitter"] = Estimate(knobs["jitter"], max(half - step / 2, 0.0), half + step / 2, how)


def _dead(stuck: NDArray, values: NDArray, knobs: dict[str, Any], estimates: dict[str, Estimate]) -> None:
    """Enter the share of dead probes with its exact binomial interval (Clopper & Pearson), and their values."""
    from scipy.stats import beta

    count, dead = len(stuck), int(stuck.sum())
    low = float(beta.ppf(0.025, dead, count - dead + 1)) if dead else 0.0
    high = float(beta.ppf(0.975, dead + 1, count - dead)) if dead < count else 1.0
    knobs["dead_probability"] = dead / count
    estimates["dead_probability"] = Estimate(dead / count, low, high, f"{dead} of {count} probes are stuck")
    if dead:
        held = values[stuck]
        knobs["dead_range"] = (float(held.min()), float(held.max()))
        for name, value in zip(("dead_low", "dead_high"), knobs["dead_range"], strict=True):
            estimates[name] = Estimate(value, math.nan, math.nan, "extreme of the stuck values")


def _gain(fit: Any, knobs: dict[str, Any], estimates: dict[str, Estimate], notes: list[str]) -> None:
    """Enter the range of the gains: the extremes, moved out by their mean distance from the ends."""
    gains, count = np.sort(fit.gains), len(fit.gains)
    if count < 2:
        knobs["gain"] = (float(gains[0]),) * 2
        error = _Z * float(fit.gain_errors[0])
        estimates["gain_low"] = estimates["gain_high"] = Estimate(
            float(gains[0]), float(gains[0]) - error, float(gains[0]) + error, "one probe: no range"
        )
        return
    span = float(gains[-1] - gains[0])
    noise = float(np.median(fit.gain_errors))
    if span < 6 * noise:
        middle = float(np.average(fit.gains, weights=1 / fit.gain_errors**2))
        error = _Z * noise / math.sqrt(count)
        knobs["gain"] = (middle, middle)
        for name in ("gain_low", "gain_high"):
            estimates[name] = Estimate(middle, middle - error, middle + error, "gains are equal within their errors")
        return
    out = span / (count - 1)
    knobs["gain"] = (float(gains[0] - out), float(gains[-1] + out))
    # The end lies beyond the extreme by at most the span times a^(-1/(n-1)) - 1, at confidence 1 - a per end.
    reach = span * (0.025 ** (-1 / (count - 1)) - 1)
    how = f"extremes of {count} gains"
    estimates["gain_low"] = Estimate(knobs["gain"][0], float(gains[0]) - reach, float(gains[0]) + _Z * noise, how)
    estimates["gain_high"] = Estimate(knobs["gain"][1], float(gains[-1]) - _Z * noise, float(gains[-1]) + reach, how)
    if count < 20:
        notes.append(f"The range of gains rests on {count} probes; log more probes or resets to narrow it.")


def describe(calibration: Calibration) -> Sequence[tuple[str, Estimate]]:
    """Return the estimates in the order of the model."""
    order = ["gain_low", "gain_high", "hysteresis", "hysteresis_tau", "walk", "white", "bias", "quantum"]
    order += ["dead_probability", "dead_low", "dead_high", "read_delay", "jitter"]
    return [(name, calibration.estimates[name]) for name in order if name in calibration.estimates]
