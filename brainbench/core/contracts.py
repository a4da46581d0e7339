"""What the packages exchange: data sets of xarray, trials of one session, and pairs of labels.

Letters used everywhere: B batch, T time step, S sub-step, C channel, H×W whisker grid, N taxel,
K stimulus, R trial, U unit, A animal, P = K(K−1)/2 RDM pair.

A **stimulus set** is an :class:`xarray.Dataset` with ``wrench`` [stimulus, time, whisker, channel]
(float32; N and N·m; the action of the whisker on its base, about the base point, world axes).
A **recordings** data set is an :class:`xarray.Dataset` with ``counts`` [trial, time, unit], where
NaN means "not recorded". :func:`check_stimulus_set` and :func:`check_recordings` state the rest.
"""

from __future__ import annotations

import csv
import math
import os
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, check_once, listing, repeats
from brainbench.core.reading.regular import readable
from brainbench.core.reading.texts import read_mapping, read_text

if TYPE_CHECKING:
    import xarray as xr

CHANNELS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
"""Order of the six channels of a base wrench: forces in N, then moments in N·m."""

BY_TRIAL = "trial"
"""Value of ``match`` that joins each trial to a stimulus of its own."""
GRID_SHAPE = (5, 7)  # rows A–E and columns 0–6 of the whisker grid; whisker (row, col) sits at flat index row·7 + col

SUB_STEPS, SUB_STEP_SECONDS = 5, 0.009  # frames within a time step of the networks, and the time between frames [s]

LONGEST_LABEL = 200  # characters of the name of a stimulus or whisker; names become those of files

SWEEPS_FORMAT = "brainbench-sweeps"
"""Attribute ``format`` of every shard and manifest of a data set of sweeps (``docs/datasets.md``)."""
SWEEPS_SCHEMA = 1  # version of that layout


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
        if dataset[name].dims != ("whisker",):
            raise DataError(f"{name!r} of a stimulus set is one number per whisker; this one has {cells.size} numbers.")
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
    least = 0 if dataset.attrs.get("measure", "spikes") == "spikes" else -np.inf
    if counts.size and not (np.fmin.reduce(counts, None) >= least and np.fmax.reduce(counts, None) < np.inf):
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


@dataclass(frozen=True)
class Trials:
    """Trials of one session, whose units were recorded together. Letters: R trials, T time bins, U units."""

    responses: Any
    """[R, T, U] or [R, U] responses, such as firing rates in Hz; NaN where a unit was not recorded."""
    labels: Any
    """[R] stimulus of each trial: its place 0 … K−1 in the ordered vocabulary."""
    keys: Sequence[str] | None = None
    """[R] name of each trial, unique and independent of its place, from which random splits are drawn; without
    names they are drawn from the trials' content. Either way the order of trials, sessions and units is irrelevant."""
    covariates: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Further measurements of every trial, such as contacts or licks: name → [R], NaN where unknown."""
    times: Any = None
    """[R] begin of each trial on its session's clock [s]; None where it is not known."""
    session: str = ""
    """Name of the session. Sessions are in the natural order of their names, where it matters."""
    columns: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """What is known of every unit, such as its area: name → [U] texts, empty where unknown."""

    def take(self, rows: Any) -> Trials:
        """Return the trials that an index or mask [R] names, in its order."""
        index = np.arange(len(self.labels))[rows]
        if np.array_equal(index, np.arange(len(self.labels))):
            # Long recordings in narrow bins are not copied for nothing.
            return self
        return replace(
            self,
            responses=np.asarray(self.responses)[index],
            labels=np.asarray(self.labels)[index],
            keys=None if self.keys is None else tuple(self.keys[int(row)] for row in index),
            covariates={name: np.asarray(values)[index] for name, values in self.covariates.items()},
            times=None if self.times is None else np.asarray(self.times)[index],
        )

    def choose(self, units: Any) -> Self:
        """Return the trials with the units that an index or mask [U] names."""
        columns = {name: np.asarray(values)[units] for name, values in self.columns.items()}
        return replace(self, responses=np.asarray(self.responses)[..., units], columns=columns)


MISSING_WORDS = ("nan", "nat")  # texts, in lower case, that programs write where a value is missing
_DOUBTFUL = ("", "na", "nil", "none", "null", "nv", "missing", "undefined", "unknown")  # without signs
_DECIMAL = re.compile(r"-?(?:0|[1-9]\d{0,11})\.\d{1,12}")
_DIGITS = {2: 3, 4: 7}  # digits that a number of so many bytes keeps through arithmetic; 12 for all others


def as_labels(values: Any) -> NDArray[np.str_]:
    """Settle the label of each value [n]: missing ones become "", and rounding, text numbers and Unicode forms nothing.

    >>> as_labels(np.array([1.0, 2.5, 3 * 0.1, np.nan])).tolist()
    ['1', '2.5', '0.3', '']
    """
    array = np.asarray(values)
    if not len(array):
        return np.zeros(0, "U1")
    unique, inverse = np.unique(array, return_inverse=True)
    digits = _DIGITS.get(array.dtype.itemsize, 12) if array.dtype.kind == "f" else 12
    labels = [as_label(value, digits) for value in unique.tolist()]
    if array.dtype.kind == "U":
        # Texts of one column that differ were meant to differ, such as the sections 1.1 and 1.10.
        plain = [unicodedata.normalize("NFC", text.strip()) for text in unique.tolist()]
        forms: dict[str, set[str]] = {}
        for label, text in zip(labels, plain, strict=True):
            forms.setdefault(label, set()).add(text)
        labels = [text if label and len(forms[label]) > 1 else label for label, text in zip(labels, plain, strict=True)]
    return np.array(labels, dtype=str)[inverse.reshape(array.shape)]


def as_label(value: Any, digits: int = 12) -> str:
    """Write a value as the text a person would use, a number with so many digits; what is missing becomes ""."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        if not np.isfinite(value):
            return ""
        text = f"{value:.{digits}g}"
        return str(int(value)) if value.is_integer() else str(int(float(text))) if float(text).is_integer() else text
    text = unicodedata.normalize("NFC", str(value).strip())
    if text.lower().lstrip("+-") in MISSING_WORDS:
        return ""
    return as_label(float(text)) if _DECIMAL.fullmatch(text) else text


def is_doubtful(label: str) -> bool:
    """Return whether a label may mean a missing value, such as ``None``, ``#N/A``, ``--`` or ``-999``."""
    return label in ("-99", "-999", "-9999") or (bool(label) and re.sub(r"[\W_]", "", label).lower() in _DOUBTFUL)


_SEPARATORS = re.compile(r"(?<=[^\W_])[-_./\s]+(?=[^\W\d_])|(?<=[^\W\d_])[-_./\s]+(?=[^\W_])")
# Between two numbers, and at an end, such signs are meant.


def near_labels(labels: Iterable[str]) -> list[list[str]]:
    """Return the groups of labels that differ in case, blanks, separators, leading zeros or the seventh digit alone."""
    folded: dict[Any, list[str]] = {}
    for label in sorted({*labels} - {""}):
        number = as_number(label.replace(",", "."))
        rounded = number if number.is_integer() or not math.isfinite(number) else float(f"{number:.6g}")
        seen = "".join(sign for sign in unicodedata.normalize("NFKC", label) if unicodedata.category(sign) != "Cf")
        words = "".join(_SEPARATORS.sub("", seen).casefold().split())
        folded.setdefault(words if math.isnan(number) else rounded, []).append(label)
    return [twins for twins in folded.values() if len(twins) > 1]


def as_number(text: str) -> float:
    """Return the number that a text states; NaN where it states none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def natural_key(label: str) -> tuple[Any, ...]:
    """Return a sort key that puts numbers in numeric order, alone or inside text.

    >>> sorted(["10", "9", "b10", "b2"], key=natural_key)
    ['9', '10', 'b2', 'b10']
    """
    if math.isfinite(number := as_number(label)):
        return (0, number, (), label)
    # The odd parts are the digits; the label itself keeps "01" and "1" apart.
    parts = re.split(r"(\d+)", label)
    return (1, 0.0, tuple((int(part), "") if index % 2 else (-1, part) for index, part in enumerate(parts)), label)


def join_labels(
    vocabulary: tuple[str, ...],
    labels: tuple[str, ...],
    match: str | os.PathLike[str] | Mapping[str, str | None] | None,
) -> dict[str, str]:
    """Pair recording labels with stimulus labels, in the order of the recordings' vocabulary.

    Args:
        vocabulary: condition labels of the recordings.
        labels: stimulus labels of the model side.
        match: recording label → stimulus label (None drops it), or a file of such pairs. Labels it
            does not name are paired with their equals; every label of the recordings must have a partner, while
            stimuli that were not recorded are left out.
    """
    explicit = read_match(match) if isinstance(match, (str, os.PathLike)) else dict(match or {})
    sides = f"recordings: {listing(vocabulary, limit=5)}; stimuli: {listing(labels, limit=5)}"
    # The same number or text in another form is the same label, unless two stimuli share it.
    forms = [as_label(label) for label in labels]
    equals = {form: label for form, label in zip(forms, labels, strict=True) if forms.count(form) == 1}
    equals |= {label: label for label in labels}
    spelled = {as_label(label): label for label in vocabulary}
    explicit = {spelled.get(as_label(label), label): partner for label, partner in explicit.items()}
    for label, partner in explicit.items():
        if label not in vocabulary:
            raise UsageError(
                f"The match names {label!r}, which is no label of the recordings ({sides}). A CSV file has no headings."
            )
        if partner is not None and partner not in labels:
            raise UsageError(f"The match pairs {label!r} with {partner!r}, which is no stimulus ({sides}).")
    pairs = {label: explicit.get(label, equals.get(label, equals.get(as_label(label), label))) for label in vocabulary}
    pairs = {label: partner for label, partner in pairs.items() if partner is not None}
    if alone := [label for label, partner in pairs.items() if partner not in labels]:
        unused = [label for label in labels if label not in pairs.values()]
        lonely = {"without a stimulus": alone, "without recordings": unused}
        words = "; ".join(f"{what}: {listing(names, limit=5)}" for what, names in lonely.items() if names)
        # What may mean a missing value is dropped, and only a label that has no equal is paired.
        partner = "" if is_doubtful(alone[0]) else next(iter(unused), "")
        raise UsageError(
            f"The labels of recordings and stimuli do not match ({words}; equal on both sides: "
            f"{len(pairs) - len(alone)}). Pair them with --match FILE, a line for each label without a stimulus "
            f"as in '{alone[0]},{partner}' (.csv; nothing after the comma drops the label)."
        )
    if twice := repeats(pairs.values()):
        raise UsageError(f"Two recording labels are paired with the stimulus {twice[0]!r}; pairs must be one to one.")
    if len(pairs) < 2:
        raise UsageError(f"The match drops all but {len(pairs)} of {len(vocabulary)} labels; comparing needs two.")
    return {label: str(partner) for label, partner in pairs.items()}


def read_match(path: str | os.PathLike[str]) -> dict[str, str | None]:
    """Read label pairs from JSON or TOML (an object) or CSV (two columns; an empty second one drops)."""
    path = Path(path)
    kind = path.suffix.lower()
    if kind in (".json", ".toml"):
        pairs = read_mapping(path)
    elif kind == ".csv":
        lines = read_text(path, "match file").splitlines()
        with readable(path, "table of labels"):
            rows = [row for row in csv.reader(lines) if row]
        if any(len(row) != 2 for row in rows):
            raise UsageError(f"{str(path)!r} must have two columns: recording label, stimulus label.")
        check_once(repr(str(path)), [row[0] for row in rows])
        pairs = dict(rows)
    else:
        single = f"; {BY_TRIAL!r} joins the single trials of a score, and only that"
        raise UsageError(f"A match file ends in .json, .toml or .csv; received {path.name!r}{single}.")
    if not all(isinstance(value, (str, type(None))) for value in pairs.values()):
        raise UsageError(f"{str(path)!r} must map recording labels to stimulus labels (text, or null to drop one).")
    return {str(key): value or None for key, value in pairs.items()}
