"""Check of the published ``.npz`` recordings: what zeros, padding and slots without names do to scores, in numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise, permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainbench.datasets.checks.findings import Finding, share
from brainbench.datasets.layouts.published_npz import SLOTS, ZeroFilledSession, read_arrays, recover_sessions

_FEW = 4
"""Trials of every stimulus that unbiased distances need."""
_DRAWS = 100
"""Draws of each kind of chance that agreement is held against."""
_FEWEST_UNITS = 3
"""Units from which a correlation distance says anything."""
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
        f"{item.session}: {item.units} units, {len(item.slots)} trials, "
        f"{'/'.join(map(str, _trials_of_slots(item)))} per slot"
        for item in sessions
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
