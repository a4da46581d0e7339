"""Responses that are sampled: ΔF/F of imaged cells, power of voltages in a band, or samples by trial.

The response of a trial is the mean of each cell or channel over the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, listing, unknown_name
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.sessions import Series, Session, SessionTable
from brainbench.datasets.trials.selection import WHOLE, Selection, Window

Floats = NDArray[np.float64]
VOLTAGES = "ElectricalSeries"  # type of signals that are read as power in a band
ORDER = 4  # order of the Butterworth filter of a band, which runs forwards and backwards
SETTLING = 4.0
"""Cycles of the lower edge, and inverse widths of the band, that are filtered on either side of what is read."""


def response_series(session: Session, window: Window | None = None) -> Series | None:
    """Return the signal that is read of a session: the one that the window names, else, without spikes, the only one.

    Of several signals of imaged cells the only ΔF/F is taken, of voltages the only LFP.
    """
    every = {place: item for place, item in session.populations.items() if isinstance(item, Series)}
    wanted, banded = (window.signal, window.band is not None) if window is not None else ("", False)
    if not (wanted or banded) and session.has_spikes:
        return None
    series = {place: item for place, item in every.items() if (item.kind == VOLTAGES) == banded}
    if wanted:
        matching = [place for place in every if f"/{wanted}/".lower() in f"/{place}/".lower()]
        if not matching:
            names = sorted({name for place in every for name in place.split("/")[-2:]})
            raise unknown_name("signal", wanted, names, hint=f"(in {session.source})")
        series = {place: item for place, item in series.items() if place in matching}
        if not series:
            advice = "is no voltage: leave the band out" if banded else f"needs a band in Hz, such as {wanted}@70..150"
            raise UsageError(f"{matching[0]} of {session.source} {advice}.")
    if banded and not series:
        raise DataError(f"{session.source} has no {VOLTAGES}, of which a band is read; its signals: {listing(every)}.")
    if len(series) > 1:
        preferred = [place for place in series if ("LFP" if banded else "DfOverF") in place]
        if len(preferred) != 1:
            raise DataError(
                f"{session.source} has several signals ({listing(series)}); name the one to read in the window, such "
                f"as 'start..stop of {next(iter(series))}'."
            )
        return series[preferred[0]]
    return next(iter(series.values()), None)


@dataclass(frozen=True)
class Samples:
    """Units whose signal is sampled; their responses are means, of which negative ones are values too."""

    units: SessionTable
    series: Series
    times: Floats
    """[F] times of the frames, s."""
    name: str
    """Series and file, for messages."""
    starts: Floats | None = None
    """[rows] s from which the times of samples by trial count."""
    band: tuple[float, float] | None = None
    """Band of voltages, Hz."""

    @classmethod
    def of(cls, session: Session, series: Series, table: SessionTable, window: Window, bin: float | None) -> Samples:
        """Take a signal of a session whose trials stand in a table."""
        name, shape = f"{series.name} of {session.source}", tuple(series.data.shape)
        cells = replace(series.cells, where=name)
        if len(cells) != (shape[-1] if len(shape) > 1 else 1) or len(shape) > 2 + bool(series.table):
            raise DataError(f"{name} has the shape {shape}, not [frame, unit], and {len(cells)} units are named.")
        if series.data.dtype.kind not in "biuf" or 0 in shape:
            raise DataError(f"{name} has the shape {shape} of {series.data.dtype}; samples are real numbers, one each.")
        if not series.table:
            samples = cls(cells, series, series.times(), name, band=window.band)
            if samples.band is not None and not 2 * samples.band[1] * samples.step < 1:
                raise DataError(
                    f"{name} has {1 / samples.step:.6g} samples/s, and a band of voltages ends below half of that; "
                    f"received {samples.band[0]:g}..{samples.band[1]:g} Hz."
                )
            return samples
        if series.table != table.name or len(shape) != 3 or shape[0] != len(table):
            raise DataError(
                f"{name} has the shape {shape}, and trials are the {len(table)} rows of {table.name!r}; it must be "
                f"[trial, time, unit], with the rows of {series.table!r}."
            )
        if series.timestamps is None and (shape[1] > 1 or bin is not None or window != WHOLE):
            raise UsageError(
                f"{name} says no time of its {shape[1]} samples of a trial, which have no windows or bins then: "
                "'time' (s from the start of the trial) is missing beside it, or one sample is read without a window."
            )
        times = np.zeros(1) if series.timestamps is None else series.times()
        return cls(cells, series, times, name, table.times("start_time"))

    @property
    def measure(self) -> str:
        """What the responses are."""
        if self.series.unit == "spikes":
            return "spikes"
        band = "" if self.band is None else f"power at {self.band[0]:g}..{self.band[1]:g} Hz of "
        return f"{band}{self.series.name} ({self.series.unit or self.series.kind})"

    @property
    def step(self) -> float:
        """Time from a frame to the next, s; NaN of a single one."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else math.nan

    def rule_out(self, keep: NDArray[np.bool_], selection: Selection, ledger: Ledger) -> NDArray[np.bool_]:
        """Return which units [U] remain without what the file calls no cell."""
        if "iscell" in self.units:
            flags = self.units.times("iscell")
            keep = ledger.apply(keep, np.isfinite(flags), "units", "not known whether a cell (no row has its iscell)")
            keep = ledger.apply(keep, flags > 0, "units", "no cell (iscell)")
        return keep

    def covered(self, edges: Floats, ledger: Ledger) -> NDArray[np.bool_]:
        """Return which windows [rows, 2] (s) lie between the first and the last frame, and in no gap: [rows, U]."""
        spans = edges if self.starts is None else edges - self.starts[:, None]
        inside = (spans[:, 0] >= self.times[0] - self.step) & (spans[:, 1] <= self.times[-1] + self.step)
        inside &= time_lost(self.times, spans) <= LOST * np.diff(spans, axis=1)[:, 0]
        return np.repeat((inside | math.isnan(self.step))[:, None], len(self.units), axis=1)

    def respond(self, rows: NDArray[np.int64], units: NDArray[np.int64], bounds: Floats) -> NDArray[np.float32]:
        """Return mean × length of the frames in bins [begin, end) of trials; NaN frames are left out.

        A bin without any other frame is NaN. Raises DataError where a bin is shorter than a frame, or a cycle.
        """
        duration = np.diff(bounds, axis=1)
        shortest = float(duration[duration > 1e-9].min(initial=math.inf))
        least, what = (self.step, "frame") if self.band is None else (1 / self.band[0], f"cycle of {self.band[0]:g} Hz")
        if shortest < (1 - 1e-6) * least:
            raise DataError(
                f"{self.name} has a {what} every {least:.3g} s, and windows or bins are as short as {shortest:.3g} s; "
                "take longer ones."
            )
        means = np.full((*duration.shape, len(units)), np.nan, dtype=np.float32)
        # A frame on a bound up to rounding, a thousandth of the way to the next, belongs to the later bin.
        edges = bounds - 1e-3 * np.nan_to_num(self.step) - (0.0 if self.starts is None else self.starts[rows, None])
        for index, row in enumerate(rows):
            times, values = self._read(int(row), units, *edges[index, [0, -1]])
            place = np.searchsorted(times, edges[index], side="left")
            if math.isnan(self.step):
                place = np.array([0, 1])
            for column in range(duration.shape[1]):
                frames = values[place[column] : place[column + 1]]
                finite = np.isfinite(frames)
                total, number = np.where(finite, frames, 0.0).sum(axis=0, dtype=np.float64), finite.sum(axis=0)
                mean = np.divide(total, number, out=np.full(len(number), np.nan), where=number > 0)
                # Counts add up over frames; all else is averaged.
                sums = self.series.unit == "spikes" and duration[index, column] > 1e-9
                means[index, column] = mean * len(frames) / duration[index, column] if sums else mean
        return (means * duration[:, :, None]).astype(np.float32)

    def _read(self, row: int, units: NDArray[np.int64], begin: float, end: float) -> tuple[Floats, NDArray[Any]]:
        """Return the frames of a window: times [F] (s) and values [F, units], or their power in the band."""
        if self.starts is not None:
            values = np.asarray(self.series.data[row], dtype=np.float32)[:, units]
            return self.times, values
        settling = 0.0 if self.band is None else SETTLING / min(self.band[0], self.band[1] - self.band[0])
        first, last = np.searchsorted(self.times, [begin - settling, end + settling], side="left")
        values = np.asarray(self.series.data[first:last], dtype=np.float32)
        values = (values[:, None] if values.ndim == 1 else values)[:, units]
        scale = np.broadcast_to(np.asarray(self.series.conversion, np.float64), len(self.units))[units]
        if self.band is None:
            return self.times[first:last], values * scale + self.series.offset
        # A band has no part of the offset.
        return self.times[first:last], self._power(self.times[first:last], values * (1e6 * scale))

    def _power(self, times: Floats, values: NDArray[Any]) -> NDArray[Any]:
        """Return the power (µV²) of voltages [F, U] in the band; NaN for channels and times that have gaps."""
        from scipy.signal import butter, sosfiltfilt

        sections = np.asarray(butter(ORDER, self.band, "bandpass", fs=1 / self.step, output="sos"))
        gaps = np.diff(times, prepend=times[:1]) > 1.5 * self.step
        if gaps.any() or len(values) <= 3 * (2 * len(sections) + 1):
            return np.full(values.shape, np.nan)
        # A filter spreads what is missing over all that follows.
        missing = ~np.isfinite(values).all(axis=0)
        power = sosfiltfilt(sections, np.where(missing, 0.0, values), axis=0) ** 2
        power[:, missing] = np.nan
        return power

    def enter(self, units: NDArray[np.int64], bounds: Floats, counts: NDArray[np.float32], to: Ledger) -> None:
        """Doubt responses of any kind that drift over the session."""
        rates = counts / np.diff(bounds, axis=1)[:, :, None]
        imaged = self.band is None and self.series.unit != "spikes"
        if doubt := fading(rates, BLEACHING if imaged else "as where electrodes or arousal change"):
            to.doubts.append(f"{self.name}: {doubt}")
        if self.starts is None and len(bounds) and np.ptp(self.times) > MOST_BESIDE * np.ptp(bounds):
            times = f"{np.ptp(self.times):,.0f} s and its trials for {np.ptp(bounds):,.0f}"
            to.doubts.append(f"{self.name} runs for {times}, so its times may be numbers of frames, or no seconds")


MOST_BESIDE = 5.0  # length of a recording, in that of its trials, from which the unit of its times is doubted
LOST = 0.1
"""Share of a window without frames up to which its mean stands for all of it."""


def time_lost(times: Floats, spans: Floats) -> Floats:
    """Return the time (s) without frames in each span [n, 2], from the times [F] of frames.

    A frame stands for the time to the next, but for no more than most frames do (the 90th percentile): the rest of an
    interval that is half as long again is lost.
    """
    steps = np.diff(times)
    most = float(np.quantile(steps, 0.9)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > 1.5 * most)
    if not len(gaps):
        return np.zeros(len(spans))
    ends = np.stack([times[gaps] + most, times[gaps + 1]], axis=1).ravel()
    lost = np.repeat([0.0, *np.cumsum(steps[gaps] - most)], 2)[1:-1]
    return np.diff(np.interp(spans, ends, lost), axis=1)[:, 0]


BLEACHING = "as where an indicator bleaches; take ΔF/F of a running baseline"


def fading(means: NDArray[np.floating[Any]], cause: str = BLEACHING) -> str:
    """Return a doubt where the responses [R, T, U] of trials in order of time drift, with the likely cause."""
    finite = np.isfinite(means)
    number = finite.sum(axis=(1, 2))
    course = np.where(finite, means, 0.0).sum(axis=(1, 2), dtype=np.float64)[number > 0] / number[number > 0]
    if len(course) < FEWEST_TRIALS or not np.ptp(course):
        return ""
    r = float(np.corrcoef(course, np.arange(len(course)))[0, 1])
    if r * r < DRIFT:
        return ""
    return (
        f"the mean over units {'rises' if r > 0 else 'falls'} over the session (time explains {r * r:.0%} of its "
        f"variance), {cause}"
    )


FEWEST_TRIALS, DRIFT = 12, 0.5
"""Trials from which a drift is looked for, and the share of the variance over trials from which it is one: without
drift it is 1 / (R − 1), and .5 or more in one of 100 sessions of 12 trials."""
