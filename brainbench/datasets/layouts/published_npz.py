"""Layout of the recordings that Chung et al. (2025) publish as ``.npz``, such as ``rodgers6_data.npz``.

One array per animal: rates (spikes/s) [trials, 6 slots, units]. The rates of a trial stand in the slot of its
stimulus, and the other five slots are 0. Units of all sessions stand side by side; shorter sessions are padded with
NaN. Slots are numbered anew in every session, by the first appearance of their stimulus, and the names of the stimuli
are not stored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, listing
from brainbench.core.reading.archives import read_npz
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.trials.conditions import Conditions
from brainbench.datasets.trials.counting import UNIT_COLUMNS, ReadingOptions, SessionCounts, missing_column
from brainbench.datasets.trials.selection import Selection, Tally
from brainbench.datasets.trials.session_trials import join_sessions
from brainbench.datasets.trials.windows import FIRST_CONTACT, Window

if TYPE_CHECKING:
    import xarray as xr

STRAY = "allow_pickle"
"""Entry without meaning: numpy before 2.2 stored this keyword of ``savez`` as an array."""
SLOTS = tuple(f"slot-{number}" for number in range(1, 7))
"""Places along axis 1, in the order of the file."""
MOST_RATE = 1e6
"""Spikes per second beyond those of any neuron, even in the shortest window."""
RATES = f"rates [trials, {len(SLOTS)}, units]"
SILENT = "trials: no rate above 0 in any slot, so the stimulus cannot be known"

LAYOUT = RecordingLayout(
    name="published-npz",
    title="preprocessed recordings of the published study, rates in slots without names",
    citation="Chung et al. (2025), neuroagents-lab/2025-tactile-whisking; data as of the layout rodgers",
    conditions=Conditions("trials", ("slot",)),
    orders={"slot": SLOTS},
    selection=Selection(name="published-npz", min_spikes=0),
    window=Window("start", stop="choice"),
    columns=(),
    stimuli="rodgers",
    remarks=(
        SILENT,
        "labels: slots, in the file's order; they cannot be trusted, because every session numbers its stimuli anew",
        "sessions: neighbouring units with other numbers of trials, or with rates in other slots of the same trial",
        "rates: spikes/s over windows of unequal length, which the file does not state, in whole bins of 45 ms, "
        "so up to one bin too low; the authors' code shifted spikes, but not trials, by the recording's starting time",
        "trials: chosen by the authors (correct, not ignored, with a shape)",
    ),
)


@dataclass(frozen=True)
class ZeroFilledSession:
    """One session of an animal, as far as the file tells."""

    subject: str
    session: str
    first: int
    """Its first unit in the animal's array."""
    slots: NDArray[np.int64] = field(repr=False)
    """[R] slot of each trial, from 0; −1 where no unit fired (or, in a window of no length, none has a rate)."""
    rates: NDArray[np.float64] = field(repr=False)
    """[R, U] spikes/s."""

    @property
    def units(self) -> int:
        """Number of units."""
        return self.rates.shape[1]


def is_published(path: Path, layout: RecordingLayout | None = None) -> bool:
    """Return whether a file is one of these, by its ending or by the layout that was named."""
    return layout is LAYOUT or (layout is None and path.suffix.lower() == ".npz")


def read_arrays(path: Path) -> tuple[dict[str, NDArray[np.float64]], bool]:
    """Return rates [trials, 6, units] by animal, as the file holds them, and whether :data:`STRAY` is there."""
    arrays = read_npz(path, "file of published recordings (.npz)")
    if {"data", "label"} <= arrays.keys():
        raise DataError(
            f"{path} is a whisker sweep (arrays {listing(sorted(arrays))}), not recordings of neurons; a "
            "folder of sweeps is what `brainbench train MODEL --data FOLDER` takes."
        )
    if {"r_xy", "r_yy"} <= arrays.keys():
        raise DataError(f"{path} holds split halves, no recordings; try `brainbench score {path} --explain-estimator`.")
    stray = STRAY in arrays and not arrays[STRAY].ndim
    animals = {name: array for name, array in arrays.items() if not (stray and name == STRAY)}
    if not animals:
        raise DataError(f"{path} holds no animal: expected one array of {RATES} for each.")
    for name, array in animals.items():
        if fault := _fault(array):
            raise DataError(f"The array {name!r} of {path} {fault}.")
    return {name: array.astype(np.float64) for name, array in animals.items()}, stray


def _fault(array: NDArray[Any]) -> str:
    """Return why an array holds no rates; empty where it does."""
    if array.dtype.kind not in "fiu":
        return f"holds {array.dtype}, not numbers; expected {RATES}"
    if array.ndim != 3 or array.shape[1] != len(SLOTS) or not array.size:
        return f"has shape {list(array.shape)}; expected {RATES} with {len(SLOTS)} stimuli on axis 1"
    missing = np.isnan(array)
    gone: NDArray[np.bool_] = np.asarray(missing.all(axis=1))
    if missing.all():
        return "holds no rate: every value is NaN; leave this animal out"
    if (array > MOST_RATE).any() or (array < 0).any():
        return f"holds infinite, negative or impossible rates; rates are 0 to {MOST_RATE:,.0f} spikes/s"
    if np.any(gone[:-1] & ~gone[1:]) or np.any(gone[0]):
        return "has trials of NaN inside a session; they may only pad a unit's trials at the end"
    if len(several := np.argwhere((array > 0).sum(axis=1) > 1)):
        trial, unit = several[0]
        return f"has rates in several slots of one trial (trial {trial}, unit {unit}); the other slots hold zeros"
    return ""


def recover_sessions(subject: str, array: NDArray[np.float64]) -> list[ZeroFilledSession]:
    """Return the sessions of an animal's checked array [trials, 6, units].

    A trial has one stimulus, so all units of a session that fired in it did so in one slot. A unit begins another
    session when its number of trials differs from that of the unit before, or its slots contradict those of the session
    so far. Sessions of equal length whose slots never contradict each other cannot be told apart.
    """
    fired = array > 0
    slots = np.where(fired.any(axis=1), fired.argmax(axis=1), -1)
    lengths = (~np.isnan(array).all(axis=1)).sum(axis=0)
    # One slot at most is not 0. A rate that is NaN there (a window of no length) stays missing.
    rates = array.sum(axis=1)
    firsts, shared = [0], slots[:, 0]
    for unit in range(1, array.shape[2]):
        slots_of = slots[:, unit]
        if lengths[unit] != lengths[unit - 1] or ((slots_of >= 0) & (shared >= 0) & (slots_of != shared)).any():
            firsts.append(unit)
            shared = slots_of
        shared = np.where(slots_of >= 0, slots_of, shared)
    sessions = []
    for number, (first, last) in enumerate(pairwise([*firsts, array.shape[2]]), 1):
        place = (slice(lengths[first]), slice(first, last))
        sessions.append(ZeroFilledSession(subject, f"{number:02d}", first, slots[place].max(axis=1), rates[place]))
    return sessions


def read_published(path: Path) -> Iterator[ZeroFilledSession]:
    """Yield the sessions of all animals of a file; raises as :func:`read_arrays`."""
    for name, array in read_arrays(path)[0].items():
        yield from recover_sessions(name, array)


def open_published(path: Path, **options: object) -> xr.Dataset:
    """Read the file into the recordings contract; rates stand for counts in bins of one second."""
    if given := [name for name, value in options.items() if value is not None]:
        raise UsageError(
            f"{path} holds rates without spike times or bins, so conditions, select, window, bin and scores over time "
            f"cannot apply (received {', '.join(given)}); leave them out, or open the original files (DANDI 000231)."
        )
    sessions = list(read_published(path))
    start = FIRST_CONTACT if "touch_to_choice" in path.stem else "start"
    reading = ReadingOptions(LAYOUT.conditions, SLOTS, LAYOUT.selection, Window(start, stop="choice"))
    parts = [_session_counts(item, path) for item in sessions]
    dataset = join_sessions(parts, reading, source=str(path), layout=LAYOUT.name, notes=list(LAYOUT.remarks[1:]))
    total, animals = sum(len(item.slots) for item in sessions), len({item.subject for item in sessions})
    dataset.attrs["label_doubt"] = (
        f"labels cannot be trusted: every session of {path.name} numbers its stimuli by their first appearance and "
        "their names are not stored, so slots taken as stimuli in the file's order are a guess (recovered: the slot of "
        f"{dataset.sizes['trial']} of {total} trials; sessions: {len(sessions)}, animals: {animals})"
    )
    return dataset


def _session_counts(session: ZeroFilledSession, path: Path) -> SessionCounts:
    recorded = np.flatnonzero(session.slots >= 0)
    labels = tuple(SLOTS[slot] for slot in session.slots[recorded].tolist())
    return SessionCounts(
        subject=session.subject,
        session=session.session,
        source=f"{path}:{session.subject}/{session.session}",
        values=tuple((label,) for label in labels),
        labels=labels,
        trial_ids=tuple(map(str, recorded.tolist())),
        unit_ids=tuple(map(str, range(session.first, session.first + session.units))),
        edges=np.full((len(recorded), 2), np.nan),
        counts=session.rates[recorded][:, None].astype(np.float32),
        duration=np.ones((len(recorded), 1)),
        columns={name: missing_column(kind, session.units) for name, kind in UNIT_COLUMNS.items()},
        covariates={},
        tally=Tally(removed={SILENT: len(session.slots) - len(recorded)}),
        trials=len(session.slots),
        units=session.units,
        synthetic=False,
        stimuli=LAYOUT.stimuli,
    )
