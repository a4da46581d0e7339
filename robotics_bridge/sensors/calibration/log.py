"""Recordings of real devices: reading them, their episodes, stuck probes and the step of the converter.

Letters: T reading, N probe. An episode is (x [T], y [T, N]): the true signal and the readings.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, listing
from brainbench.core.reading.tables import read_columns

SHORTEST = 10
"""Readings of the shortest episode that is used."""
LARGEST = 1e12
"""Magnitude of times and readings beyond which a log is taken to be damaged."""
Episode = tuple["NDArray[np.float64]", "NDArray[np.float64]"]


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

    def __post_init__(self) -> None:
        for name in ("time", "readings", "reference", "episode"):
            if (values := getattr(self, name)) is not None:
                object.__setattr__(self, name, values := np.asarray(values))
                if values.shape[:1] != np.shape(self.time)[:1] or (values.ndim != 1 and name != "readings"):
                    raise UsageError(f"{name} has the shape {values.shape}, time {np.shape(self.time)}.")
                if not np.isfinite(values).all():
                    raise UsageError(f"{name} of a log must be finite numbers; leave out the rows of the others.")
        if self.readings.ndim != 2 or not self.readings.size:
            raise UsageError(f"Readings are [T, N] with T = {len(self.time)}; received {self.readings.shape}.")
        if self.probes and len(self.probes) != self.readings.shape[1]:
            raise UsageError(f"{self.readings.shape[1]} probes have as many names; received {len(self.probes)}.")
        if len(self.time) > 1 and not self.step > 0:
            raise UsageError(f"Times of a log (s) rise; received steps of {self.step:g} s.")

    @property
    def step(self) -> float:
        """Time between readings [s]."""
        return float(np.median(np.diff(self.time)))


def read_log(path: str | os.PathLike[str]) -> Log:
    """Read a CSV file with a header: ``time`` (s), optionally ``reference`` and ``episode``, else probes.

    Raises:
        DataFileNotFoundError: the file is missing.
    """
    name = Path(path).name
    header, table = read_columns(path, "log")
    probes = [cell for cell in header if cell.lower() not in ("time", "reference", "episode")]
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
    time = columns["time"]
    gaps = np.diff(time)[np.diff(episode) == 0] if episode is not None else np.diff(time)
    if not len(gaps) or gaps.min() <= 0 or gaps.max() > 1.5 * gaps.min():
        raise DataError(
            f"{name}: times must rise in equal steps within an episode; found "
            f"{f'{gaps.min():g}…{gaps.max():g} s' if len(gaps) else 'no two rows of one episode'}."
        )
    return Log(time, readings, columns.get("reference"), episode, tuple(probes))


def segments(log: Log) -> list[Episode]:
    """Split a log into its episodes, without those of fewer than :data:`SHORTEST` readings."""
    x = np.zeros(len(log.time)) if log.reference is None else log.reference
    numbers = np.zeros(len(x), int) if log.episode is None else log.episode
    edges = np.flatnonzero(np.diff(numbers)) + 1
    parts = zip(np.split(x, edges), np.split(log.readings, edges), strict=True)
    long = [(a, b) for a, b in parts if len(a) >= SHORTEST]
    if not long:
        raise DataError(f"Every episode of the log has fewer than {SHORTEST} readings; record longer ones.")
    return long


def find_dead(parts: list[Episode]) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.float64]]]:
    """Return per episode which probes [N] never change, and their values."""
    # Exactly equal: a living probe has noise, or moves by a quantisation step now and then.
    stuck = [np.ptp(y, axis=0) == 0 for _x, y in parts]
    return stuck, [y[0] for _x, y in parts]


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
