"""Layout of the recordings that Chung et al. (2025) publish as ``.npz``, such as ``rodgers6_data.npz``.

One array per animal: rates (spikes/s) [trials, 6 slots, units]. The rates of a trial stand in the slot of its
stimulus, and the other five slots are 0. Units of all sessions stand side by side; shorter sessions are padded with
NaN. Slots are numbered anew in every session, by the first appearance of their stimulus, and the names of the stimuli
are not stored.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, permutations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, listing
from brainbench.core.reading.tensors import read_npz
from brainbench.datasets.checks.findings import Finding, share
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.trials.counting import UNIT_COLUMNS, ReadingOptions, SessionCounts, missing_column
from brainbench.datasets.trials.selection import FIRST_CONTACT, Conditions, Selection, Window
from brainbench.datasets.trials.session_trials import join_sessions

if TYPE_CHECKING:
    import xarray as xr

STRAY = "allow_pickle"  # entry without meaning: numpy before 2.2 stored this keyword of `savez` as an array
SLOTS = tuple(f"slot-{number}" for number in range(1, 7))  # places along axis 1, in the order of the file
MOST_RATE = 1e6  # spikes per second beyond those of any neuron, even in the shortest window
RATES = f"rates [trials, {len(SLOTS)}, units]"
SILENT = "no rate above 0 in any slot, so the stimulus cannot be known"


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
    ledger = Ledger()
    ledger.find("trials", len(session.slots), len(recorded))
    ledger.find("units", session.units, session.units)
    ledger.leave("trials", SILENT, len(session.slots) - len(recorded))
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
        ledger=ledger,
        synthetic=False,
        stimuli=LAYOUT.stimuli,
    )


_FEW = 4  # trials of every stimulus that unbiased distances need
_DRAWS = 100  # draws of each kind of chance that agreement is held against
_FEWEST_UNITS = 3  # units from which a correlation distance says anything
_ORDERS = np.array(list(permutations(range(len(SLOTS)))))


def check_published(path: Path, names: list[str]) -> Iterator[Finding]:
    """Yield the findings about a file, and add its sessions to ``names``."""
    arrays, stray = read_arrays(path)
    sessions_of = {name: recover_sessions(name, array) for name, array in arrays.items()}
    sessions = [item for items in sessions_of.values() for item in items]
    names += [f"{item.subject} / {item.session}" for item in sessions]
    for finding in _of_file(arrays, sessions_of, sessions, stray=stray):
        yield replace(finding, where=path.name)
    for name, items in sessions_of.items():
        for finding in _of_animal(arrays[name], items):
            yield replace(finding, where=name)


def _of_file(
    arrays: dict[str, NDArray[np.float64]],
    sessions_of: dict[str, list[ZeroFilledSession]],
    sessions: Sequence[ZeroFilledSession],
    *,
    stray: bool,
) -> Iterator[Finding]:
    if stray:
        message = "the entry 'allow_pickle' is a keyword that numpy before 2.2 stored by mistake"
        yield Finding("note", "file", message, "It is skipped; code that takes every entry for an animal fails.")
    split = sum(len(a.slots) == len(b.slots) for items in sessions_of.values() for a, b in pairwise(items))
    message = (
        f"{len(sessions) - len(sessions_of) - split} borders between sessions are changes of the number of trials, "
        f"{split} are contradicting slots of sessions of equal length; where those never contradict, "
        "two sessions look like one"
    )
    yield Finding("note", "sessions", message, "Only the original files tell all borders.")
    recorded = sum(int(np.isfinite(array).sum()) for array in arrays.values())
    filled = sum((len(SLOTS) - 1) * item.rates.size for item in sessions)
    # A mean over all trials of a session is the mean over the slot's own trials times the share of those trials.
    parts = np.concatenate([_trials_of_slots(item) / len(item.slots) for item in sessions])
    message = (
        f"{share(filled, recorded)} values are zeros in slots that the trial did not show, so a mean over trials "
        f"is only {parts.min():.2f} to {parts.max():.2f} of a stimulus' true rate"
    )
    advice = (
        "Scores treat them as missing. `--estimator thesis` keeps them, as published: distances then also tell how "
        "often each stimulus was shown."
    )
    yield Finding("warning", "zeros", message, advice, {"zeros": filled, "least": parts.min(), "most": parts.max()})
    seen = [list(dict.fromkeys(item.slots[item.slots >= 0].tolist())) for item in sessions]
    ordered = sum(slots == sorted(slots) for slots in seen)
    message = (
        f"in {share(ordered, len(sessions))} sessions the slots first appear in the order 1 to {len(SLOTS)}: a slot's "
        "number says when its stimulus came first, not which stimulus it is, and no names are stored"
    )
    advice = "No score on it can be trusted. The original files have names: `brainbench recordings fetch rodgers`."
    yield Finding("error", "labels", message, advice, {"by_first_appearance": ordered})
    yield from _agreement(sessions)


def _of_animal(array: NDArray[np.float64], sessions: Sequence[ZeroFilledSession]) -> Iterator[Finding]:
    """Yield the trials, borders and silent trials of one animal."""
    listing = "; ".join(
        f"{session.session}: {session.units} units, {len(session.slots)} trials, "
        f"{'/'.join(map(str, _trials_of_slots(session)))} per slot"
        for session in sessions
    )
    yield Finding("note", "sessions", f"{len(sessions)} session{'s' * (len(sessions) > 1)} found ({listing})")
    if silent := sum(int((item.slots < 0).sum()) for item in sessions):
        message = f"{share(silent, sum(len(item.slots) for item in sessions))} trials are 0 in all slots"
        yield Finding("warning", "silent", message, "Their stimulus cannot be known; scores leave them out.")
    if few := [item.session for item in sessions if _trials_of_slots(item).min() < _FEW]:
        message = f"fewer than {_FEW} trials of some slot in session {', '.join(few)}"
        yield Finding("warning", "labels", message, "The metric 'rsa' leaves them out; 'rsa-correlation' needs two.")
    if padded := int(np.isnan(array[-1, 0]).sum()):
        message = f"{share(padded, array.shape[2])} units are padded with NaN to {len(array)} trials"
        yield Finding(
            "note", "padding", message, "Rows of different sessions share a number without belonging together."
        )


def _trials_of_slots(session: ZeroFilledSession) -> NDArray[np.int64]:
    return np.bincount(session.slots[session.slots >= 0], minlength=len(SLOTS))


def _agreement(sessions: Sequence[ZeroFilledSession]) -> Iterator[Finding]:
    """Yield whether animals could share labels: agreement of sessions' RDMs as stored, at best, and by chance."""
    full = [item for item in sessions if item.units >= _FEWEST_UNITS and _trials_of_slots(item).all()]
    usable = [item for item in full if np.isfinite(_distances(_means(item))).all()]
    subjects = np.array([item.subject for item in usable])
    pairs = subjects[:, None] < subjects[None]
    if not pairs.any():
        return
    rng = np.random.default_rng(0)
    means = [_means(item) for item in usable]
    stored, best = _agree(means, pairs)
    # Orders drawn anew for every session: what the file's order would reach if it meant nothing.
    by_chance = [_agree([rng.permutation(item) for item in means], pairs)[0] for _ in range(_DRAWS)]
    # The best of 720 orders agrees well even where nothing is shared. Two ways to share nothing: trials without tuning
    # (their slots shuffled), and units that are tuned, each to slots of its own (its means shuffled).
    untuned = [_agree([_means(item, rng) for item in usable], pairs)[1] for _ in range(_DRAWS)]
    unshared = [_agree([rng.permuted(item, axis=0) for item in means], pairs)[1] for _ in range(_DRAWS)]
    high = float(np.nanquantile(by_chance, 0.95))
    reached = float(np.nanquantile([untuned, unshared], 0.95, axis=1).max())
    message = (
        f"RDMs of {len(usable)} sessions of different animals agree by r = {stored:.2f} as stored (random orders: "
        f"up to {high:.2f} in 95 %) and by {best:.2f} when every pair takes the best of {len(_ORDERS)} orders "
        f"(nothing shared: up to {reached:.2f})"
    )
    advice = (
        "The slots' numbers carry stimuli across animals to some degree."
        if stored > high
        else "The geometry is shared, but nothing says which slots belong together."
        if best > reached
        else "Neither the stored order nor any other makes these animals share labels beyond chance."
    )
    values = {"stored": stored, "stored_chance": high, "best": best, "best_chance": reached}
    yield Finding("warning", "labels", message, advice, values)


def _means(session: ZeroFilledSession, rng: np.random.Generator | None = None) -> NDArray[np.float64]:
    """Return mean rates [6, U] over each slot's own trials; with a generator, over as many random ones."""
    slots = session.slots[session.slots >= 0]
    member = np.eye(len(SLOTS))[slots if rng is None else rng.permutation(slots)]
    return member.T @ session.rates[session.slots >= 0] / member.sum(axis=0)[:, None]


def _distances(means: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return correlation distances [6, 6] of mean rates [6, U]."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(1 - np.corrcoef(means))


def _agree(means: Sequence[NDArray[np.float64]], pairs: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the mean correlation of RDMs over pairs of sessions as given, and at the best order for each pair."""
    rows, columns = np.triu_indices(len(SLOTS), 1)
    every = np.stack([_distances(item) for item in means])[:, _ORDERS[:, rows], _ORDERS[:, columns]]
    every -= every.mean(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        every /= np.linalg.norm(every, axis=-1, keepdims=True)
    r = np.einsum("sop,tp->ost", every, every[:, 0], optimize=True)
    return float(np.nanmean(r[0][pairs])), float(np.nanmean(r.max(axis=0)[pairs]))


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
    endings=(".npz",),
    open_counted=open_published,
    check_counted=check_published,
    remarks=(
        f"trials: {SILENT}",
        "labels: slots, in the file's order; they cannot be trusted, because every session numbers its stimuli anew",
        "sessions: neighbouring units with other numbers of trials, or with rates in other slots of the same trial",
        "rates: spikes/s over windows of unequal length, which the file does not state, in whole bins of 45 ms, "
        "so up to one bin too low; the authors' code shifted spikes, but not trials, by the recording's starting time",
        "trials: chosen by the authors (correct, not ignored, with a shape)",
    ),
)
