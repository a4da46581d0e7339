"""The xarray data sets that the packages exchange.

Letters used everywhere: B batch, T time step, S sub-step, C channel, H×W whisker grid, N taxel,
K stimulus, R trial, U unit, A animal, P = K(K−1)/2 RDM pair.

A **stimulus set** is an :class:`xarray.Dataset` with ``wrench`` [stimulus, time, whisker, channel]
(float32; N and N·m; the action of the whisker on its base, about the base point, world axes).
A **recordings** data set is an :class:`xarray.Dataset` with ``counts`` [trial, time, unit], where
NaN means "not recorded". :func:`check_stimulus_set` and :func:`check_recordings` state the rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.errors import DataError, listing, repeats

if TYPE_CHECKING:
    import xarray as xr

CHANNELS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
"""Order of the six channels of a base wrench: forces in N, then moments in N·m."""

GRID_SHAPE = (5, 7)
"""Rows A–E and columns 0–6 of the whisker grid; whisker (row, col) sits at flat index row·7 + col."""

SUB_STEPS, SUB_STEP_SECONDS = 5, 0.009
"""Frames within a time step of the networks, and the time between frames [s]."""

LONGEST_LABEL = 200
"""Characters of the name of a stimulus or whisker; names become those of files."""

SWEEPS_FORMAT = "brainbench-sweeps"
"""Attribute ``format`` of every shard and manifest of a data set of sweeps (``docs/datasets.md``)."""
SWEEPS_SCHEMA = 1
"""Version of that layout."""


def check_stimulus_set(dataset: xr.Dataset) -> xr.Dataset:
    """Return ``dataset`` if it is a valid stimulus set.

    Required: ``wrench`` [stimulus, time, whisker, channel]; coordinates ``stimulus`` (unique labels),
    ``time`` (s, increasing), ``whisker`` (names) with ``row`` and ``col`` (grid position from 0),
    ``channel`` (:data:`CHANNELS`); attributes ``array``, ``scene``, ``fidelity``, ``seed``,
    ``backend``, ``version``, ``content_hash``.
    """
    _check(
        dataset,
        "stimulus set",
        ("wrench", ("stimulus", "time", "whisker", "channel")),
        coordinates=("stimulus", "time", "whisker", "row", "col", "channel"),
        attributes=("array", "scene", "fidelity", "seed", "backend", "version", "content_hash"),
    )
    if tuple(str(name) for name in dataset["channel"].values) != CHANNELS:
        channels = listing(map(str, dataset["channel"].values))
        raise DataError(f"The stimulus set has channels {channels}; expected {list(CHANNELS)}.")
    for name in ("stimulus", "whisker"):
        labels = [str(label) for label in dataset[name].values]
        if not labels or len(set(labels)) < len(labels) or max(map(len, labels)) > LONGEST_LABEL:
            raise DataError(
                f"The coordinate {name!r} of a stimulus set needs at least one name, all different and of at most "
                f"{LONGEST_LABEL} characters; this one has {listing(labels, limit=3)}."
            )
    time = dataset["time"].values
    if time.dtype.kind not in "fiu" or not (time.size and np.isfinite(time).all() and (np.diff(time) > 0).all()):
        raise DataError(f"The times of a stimulus set are numbers in seconds that increase; {time.size} others came.")
    for name, count in zip(("row", "col"), GRID_SHAPE, strict=True):
        cells = dataset[name].values
        if cells.dtype.kind not in "iu" or ((cells < 0) | (cells >= count)).any():
            raise DataError(f"{name!r} of a whisker is a whole number from 0 to {count - 1}; this set has others.")
    return dataset


def check_recordings(dataset: xr.Dataset) -> xr.Dataset:
    """Return ``dataset`` if it is a valid recordings data set.

    Required: ``counts`` [trial, time, unit] (NaN = not recorded, never zero); ``duration`` [trial, time]
    (s, length of each bin); per trial ``stimulus`` (label), ``subject``, ``session``, ``trial_id``;
    per unit ``unit_subject``, ``unit_session``, ``unit_id``; attributes ``vocabulary`` (ordered
    labels), ``window``, ``selection``, ``removed`` (rule → trials or units removed), ``source``,
    ``synthetic``, ``content_hash``.
    """
    _check(
        dataset,
        "recordings data set",
        ("counts", ("trial", "time", "unit")),
        variables=("duration",),
        coordinates=("stimulus", "subject", "session", "trial_id", "unit_subject", "unit_session", "unit_id"),
        attributes=("vocabulary", "window", "selection", "removed", "source", "synthetic", "content_hash"),
    )
    vocabulary = [*map(str, dataset.attrs["vocabulary"])]
    if twice := repeats(vocabulary):
        raise DataError(f"The vocabulary of a recordings data set names {listing(twice, limit=4)} twice.")
    if unlisted := sorted({*map(str, dataset["stimulus"].values.tolist())} - {*vocabulary}):
        raise DataError(
            f"Trials have labels that the vocabulary of the recordings lacks: {listing(unlisted, limit=4)}."
        )
    return dataset


def check_counts(dataset: xr.Dataset, name: str) -> xr.Dataset:
    """Return recordings from outside, called ``name`` in messages, if they are valid and their numbers can be."""
    check_recordings(dataset)
    arrays = [dataset[item].values for item in ("counts", "duration", "time") if item in dataset.variables]
    if any(values.dtype.kind not in "fiu" for values in arrays):
        raise DataError(f"{name} has counts, durations or times that are no numbers.")
    counts, duration, *time = arrays
    # NaN in the counts means that a unit was not recorded; fmin and fmax pass over it without a copy.
    if counts.size and not (np.fmin.reduce(counts, None) >= 0 and np.fmax.reduce(counts, None) < np.inf):
        raise DataError(f"{name} has counts below 0 or without end, or none at all; a count is 0 or more, or NaN.")
    if not all(np.isfinite(values).all() for values in (duration, *time)) or (duration < 0).any():
        raise DataError(f"{name} has times that are not finite or durations below 0.")
    return dataset


def _check(dataset: xr.Dataset, what: str, main: tuple[str, tuple[str, ...]], **needed: tuple[str, ...]) -> None:
    name, dims = main
    if name not in dataset:
        raise DataError(f"A {what} needs the variable {name!r}; this one has {sorted(map(str, dataset))}.")
    if dataset[name].dims != dims:
        raise DataError(f"{name!r} of a {what} has dimensions {dims}; this one has {dataset[name].dims}.")
    places = {"coordinates": dataset.coords, "attributes": dataset.attrs, "variables": dataset.variables}
    for kind, names in needed.items():
        if missing := [item for item in names if item not in places[kind]]:
            raise DataError(f"This {what} lacks the {kind[:-1]} {', '.join(map(repr, missing))}.")
