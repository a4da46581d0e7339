"""Hand trials to the metrics: one :class:`Trials` per session, because units differ between sessions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_recordings
from brainbench.core.trials import Trials
from brainbench.datasets.trials.covariates import COVARIATES

if TYPE_CHECKING:
    import xarray as xr


def blocks(dataset: xr.Dataset) -> dict[str, tuple[Trials, ...]]:
    """Return firing rates [R, T, U] in Hz of every session by subject, both in the order of the data set.

    Covariates are those of :mod:`brainbench.datasets.trials.covariates` that the data set holds. Trials and units
    without any recorded value are left out, and so are sessions and subjects without a trial left.

    Raises:
        DataError: ``dataset`` is not a recordings data set.
    """
    check_recordings(dataset)
    duration = dataset["duration"].values
    position = {label: index for index, label in enumerate(dataset.attrs["vocabulary"])}
    labels = np.array([position[label] for label in dataset["stimulus"].values.astype(str).tolist()], dtype=np.int64)
    ids = dataset["trial_id"].values.astype(str)
    known = [name for name in COVARIATES if name in dataset.coords]
    found: dict[str, list[Trials]] = {}
    for subject, session, rows, counts in _sessions(dataset):
        seconds = np.where(duration[rows] > 0, duration[rows], np.nan)
        found.setdefault(subject, []).append(
            Trials(
                responses=counts / seconds[:, :, None],
                labels=labels[rows],
                keys=_unique([f"{subject}/{session}/{ids[row]}" for row in rows]),
                covariates={name: dataset[name].values[rows].astype(np.float64) for name in known},
            )
        )
    return {subject: tuple(items) for subject, items in found.items()}


def _sessions(dataset: xr.Dataset) -> Iterator[tuple[str, str, NDArray[np.int64], NDArray[np.float32]]]:
    """Yield subject, session, its trials [R] with any recorded value, and the counts [R, T, U] of its units."""
    counts = dataset["counts"].values
    subjects, sessions = dataset["subject"].values.astype(str), dataset["session"].values.astype(str)
    unit_subjects, unit_sessions = (dataset[name].values.astype(str) for name in ("unit_subject", "unit_session"))
    for subject, session in dict.fromkeys(zip(subjects.tolist(), sessions.tolist(), strict=True)):
        rows = np.flatnonzero((subjects == subject) & (sessions == session))
        columns = np.flatnonzero((unit_subjects == subject) & (unit_sessions == session))
        own = counts[np.ix_(rows, np.arange(counts.shape[1]), columns)]
        recorded = np.isfinite(own)
        keep, units = recorded.any(axis=(1, 2)), recorded.any(axis=(0, 1))
        if keep.any():
            yield subject, session, rows[keep], own[keep][:, :, units]


def _unique(keys: list[str]) -> tuple[str, ...]:
    """Number repeated keys, in the canonical (time) order of the trials."""
    seen: dict[str, int] = {}
    result = []
    for key in keys:
        seen[key] = seen.get(key, 0) + 1
        result.append(key if seen[key] == 1 else f"{key}#{seen[key]}")
    return tuple(result)
