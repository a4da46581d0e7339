"""Responses that are sampled, such as ΔF/F of imaged cells: the mean of each cell over a window."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, listing
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.sessions import Series, Session, SessionTable
from brainbench.datasets.trials.selection import Selection

Floats = NDArray[np.float64]


def response_series(session: Session) -> Series | None:
    """Return the signal that stands for responses where a session has no spikes: its only one, or its only ΔF/F."""
    every = {place: item for place, item in session.populations.items() if isinstance(item, Series)}
    preferred = [place for place in every if "DfOverF" in place] if len(every) > 1 else [*every]
    if len(preferred) > 1 or (every and not preferred):
        raise DataError(
            f"{session.source} has several signals of cells ({listing(every)}) and no spikes; keep one of them, or one "
            "in a DfOverF, and remove the others from a copy."
        )
    return every[preferred[0]] if preferred else None


def frame_times(series: Series) -> Floats:
    """Return the times (s) of the frames of a signal, checked."""
    number = series.data.shape[0]
    if series.timestamps is None:
        if not series.rate > 0:
            raise DataError(f"The series {series.name} has neither timestamps nor a rate; its frames have no time.")
        return series.start + np.arange(number) / series.rate
    times = np.asarray(series.timestamps[...], dtype=np.float64).ravel()
    if len(times) != number:
        raise DataError(f"The series {series.name} has {len(times)} timestamps for {number} frames.")
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise DataError(f"The timestamps of {series.name} are not finite and increasing; its frames have no order.")
    return times


@dataclass(frozen=True)
class Samples:
    """Units whose signal is sampled; their responses are means, of which negative ones are values too."""

    units: SessionTable
    series: Series
    times: Floats
    """[F] times of the frames, s."""
    source: str
    measure: str

    @classmethod
    def of(cls, session: Session, series: Series) -> Samples:
        """Take a signal of a session."""
        number = 1 if series.data.ndim == 1 else series.data.shape[1]
        cells = SessionTable("cells", {"id": np.arange(number), **series.columns}, session.source)
        return cls(cells, series, frame_times(series), session.source, f"{series.name} ({series.kind})")

    @property
    def step(self) -> float:
        """Time from a frame to the next, s."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else math.nan

    def rule_out(self, keep: NDArray[np.bool_], selection: Selection, ledger: Ledger) -> NDArray[np.bool_]:
        """Leave out what the file calls no cell."""
        if "iscell" in self.units:
            keep = ledger.apply(keep, self.units.times("iscell") > 0, "units", "no cell (iscell)")
        return keep

    def covered(self, edges: Floats, ledger: Ledger) -> NDArray[np.bool_]:
        """Return which windows lie between the first and the last frame."""
        inside = (edges[:, 0] >= self.times[0] - self.step) & (edges[:, 1] <= self.times[-1] + self.step)
        return np.repeat(inside[:, None], len(self.units), axis=1)

    def key(self, unit: int) -> tuple[Any, ...]:
        """Ids are unique."""
        return ()

    def respond(self, units: NDArray[np.int64], bounds: Floats) -> NDArray[np.float32]:
        """Return mean × length of the frames in bins [begin, end); NaN frames are left out.

        A bin without any other frame is NaN. Raises DataError where a bin is shorter than a frame.
        """
        duration = np.diff(bounds, axis=1)
        shortest = float(duration[duration > 1e-9].min(initial=math.inf))
        if shortest < self.step:
            raise DataError(
                f"{self.series.name} of {self.source} has a frame every {self.step:.3g} s, and windows or bins are as "
                f"short as {shortest:.3g} s; take longer ones."
            )
        values = np.asarray(self.series.data[...], dtype=np.float32)
        values = (values[:, None] if values.ndim == 1 else values)[:, units]
        place = np.searchsorted(self.times, bounds, side="left")
        means = np.full((*duration.shape, len(units)), np.nan, dtype=np.float32)
        for row, column in np.ndindex(duration.shape):
            frames = values[place[row, column] : place[row, column + 1]]
            finite = np.isfinite(frames)
            total = np.where(finite, frames, 0.0).sum(axis=0, dtype=np.float64)
            number = finite.sum(axis=0)
            means[row, column] = np.divide(total, number, out=np.full(len(number), np.nan), where=number > 0)
        return (means * duration[:, :, None]).astype(np.float32)

    def enter(self, units: NDArray[np.int64], bounds: Floats, counts: NDArray[np.float32], to: Ledger) -> None:
        """Doubt responses that fade over the session."""
        if doubt := fading(counts / np.diff(bounds, axis=1)[:, :, None]):
            to.doubts.append(f"{self.series.name} of {self.source}: {doubt}")


def fading(means: NDArray[np.floating[Any]]) -> str:
    """Return a doubt where the responses [R, T, U] of trials in order of time drift, as where an indicator bleaches."""
    finite = np.isfinite(means)
    number = finite.sum(axis=(1, 2))
    course = np.where(finite, means, 0.0).sum(axis=(1, 2), dtype=np.float64)[number > 0] / number[number > 0]
    if len(course) < FEWEST_TRIALS or not np.ptp(course):
        return ""
    r = float(np.corrcoef(course, np.arange(len(course)))[0, 1])
    if r * r < DRIFT:
        return ""
    return (
        f"the mean over cells {'rises' if r > 0 else 'falls'} over the session (time explains {r * r:.0%} of its "
        "variance), as where an indicator bleaches; take ΔF/F of a running baseline"
    )


FEWEST_TRIALS, DRIFT = 12, 0.5
"""Trials from which a drift is looked for, and the share of the variance over trials from which it is one: without
drift it is 1 / (R − 1), and .5 or more in one of 100 sessions of 12 trials."""
