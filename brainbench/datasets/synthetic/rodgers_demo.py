"""Demo recordings: real NWB files with synthetic spikes, made once per machine from simulated stimuli.

They exist to try the toolkit and to test it: the true geometry is known (``truth.json`` beside the
files). Everything is labelled synthetic; **ranks of models on them say nothing about brains**.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import DataError, UsageError, listing
from brainbench.core.progress import Progress
from brainbench.datasets.layouts import rodgers
from brainbench.datasets.synthetic.cache import ensure_recordings
from brainbench.datasets.synthetic.rodgers_task import CHOICE, COLUMNS, SessionPlan, draw_session, tracked_contacts
from brainbench.datasets.synthetic.truth import SyntheticSession, correlation_rdm, write_synthetic_nwb, write_with_truth
from brainbench.datasets.synthetic.wrench_encoding import Afferents, draw_population, make_afferents, window_rates

if TYPE_CHECKING:
    import xarray as xr

VERSION = 2
"""Raised when the same stimuli give other spikes, so that old caches are not reused."""

_ANIMALS = (
    (SessionPlan("demo01", "01", 34, 170, detection=True), SessionPlan("demo01", "02", 30, 140)),
    (SessionPlan("demo02", "01", 56, 270, lost_whisker="C0"),),
    (SessionPlan("demo03", "01", 30, 140, spans=True), SessionPlan("demo03", "02", 28, 150)),
    (SessionPlan("demo04", "01", 40, 220, depth=0.36),),
)
"""The animals; the last is hard to read on purpose."""
_INDIVIDUAL = 0.4
"""Standard deviation over animals of the logarithm of an afferent's weight."""
_MANY = 4000
"""Units that stand for the shared geometry in the truth."""
_SUFFIX = "_behavior+ecephys.nwb"


def make_rodgers_demo(
    folder: str | os.PathLike[str],
    stimuli: xr.Dataset,
    *,
    seed: int = 0,
    animals: int = 4,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the demo recordings and their truth into ``folder``.

    Args:
        folder: created if needed; files of the same names are replaced.
        stimuli: stimulus set (:func:`brainbench.core.contracts.check_stimulus_set`) with the six labels of the
            Rodgers experiment and ``contact`` [stimulus, time, whisker] (bool).
        seed: other seeds give other animals.
        animals: number of animals; from the fifth on their sessions repeat the first ones' design.
        progress: called as ``progress(done, total, what)`` after each session.

    Returns:
        The NWB files. ``truth.json`` beside them holds, as upper triangles over ``labels``, the
        noiseless correlation-distance RDM of the shared tuning (``shared``) and of each animal's units.

    Raises:
        DataError: the stimuli lack a label or ``contact``, or one never touches a tracked whisker.
        UsageError: fewer than one animal is asked for.
    """
    if animals < 1:
        raise UsageError(f"The demo needs at least one animal; received {animals}.")
    stimuli = _in_vocabulary_order(check_stimulus_set(stimuli))
    afferents = make_afferents(stimuli)
    contact = stimuli["contact"].transpose("stimulus", "time", "whisker").values.astype(bool)
    contacts = tracked_contacts(afferents.whiskers, contact, afferents.frame)
    plans = [
        [replace(plan, subject=f"demo{index + 1:02d}") for plan in _ANIMALS[index % len(_ANIMALS)]]
        for index in range(animals)
    ]
    # Stimuli that do not suit are told before a folder is made.
    lost = dict.fromkeys([None, *(plan.lost_whisker for own in plans for plan in own)])
    first = {whisker: _first_contacts(contacts, whisker) for whisker in lost}

    def draw() -> Iterator[SyntheticSession]:
        done, total = 0, sum(map(len, plans))
        for index, own in enumerate(plans):
            random = np.random.default_rng([seed, VERSION, index])
            # Animals weigh afferents log-normally around the shared tuning, so they agree in part.
            emphasis = np.exp(_INDIVIDUAL * random.standard_normal(afferents.values.shape[2:]))
            for number, plan in enumerate(own):
                random = np.random.default_rng([seed, VERSION, index, number])
                # Units are drawn anew for each session from the animal's own weighting of afferents.
                population = draw_population(random, afferents, plan.units, emphasis, plan.depth)
                rates = population.rates(afferents)
                session = draw_session(
                    random, plan, rodgers.LABELS, rates, population.baseline, contacts, afferents.frame
                )
                yield SyntheticSession(session, _expected(rates, afferents, first[plan.lost_whisker]))
                done += 1
                if progress is not None:
                    progress(done, total, f"demo recordings {plan.subject}")

    return write_with_truth(
        folder,
        draw(),
        write=partial(write_synthetic_nwb, columns=COLUMNS),
        suffix=_SUFFIX,
        distance=correlation_rdm,
        version=VERSION,
        seed=seed,
        stimuli=str(stimuli.attrs["content_hash"]),
        labels=rodgers.LABELS,
        shared=_shared(afferents, first[None], seed),
    )


def ensure_rodgers_demo(
    stimuli: xr.Dataset | Callable[[], xr.Dataset],
    *,
    key: str | None = None,
    seed: int = 0,
    animals: int = 4,
    progress: Progress | None = None,
) -> Path:
    """Return the folder of the demo recordings, making them if this machine has none.

    Two processes may ask at once and either may be killed: every file is written whole, the truth comes last, and
    a folder without it, or with files missing or of another size, is made again.

    Args:
        stimuli: the stimulus set, or a function that makes it and is called only if needed.
        key: name of the stimuli (such as a hash of what they were made from), needed with a function.
        seed: as in :func:`make_rodgers_demo`.
        animals: as in :func:`make_rodgers_demo`.
        progress: as in :func:`make_rodgers_demo`.

    Raises:
        UsageError: a function without a ``key``.
        DataError: as in :func:`make_rodgers_demo`.
    """
    if key is None:
        if callable(stimuli):
            raise UsageError("ensure_rodgers_demo needs a key beside a function that makes the stimuli; pass key='…'.")
        key = str(check_stimulus_set(stimuli).attrs["content_hash"])

    def make(folder: Path) -> None:
        made = stimuli() if callable(stimuli) else stimuli
        make_rodgers_demo(folder, made, seed=seed, animals=animals, progress=progress)

    return ensure_recordings("demo-rodgers", key, seed, animals, VERSION, make=make)


def _in_vocabulary_order(stimuli: xr.Dataset) -> xr.Dataset:
    have = [str(label) for label in stimuli["stimulus"].values]
    if sorted(have) != sorted(rodgers.LABELS):
        raise DataError(f"The demo recordings need the stimuli {listing(rodgers.LABELS)}; these are {listing(have)}.")
    if "contact" not in stimuli:
        raise DataError("The demo recordings need the stimuli's contact [stimulus, time, whisker]; these have none.")
    return stimuli.isel(stimulus=[have.index(label) for label in rodgers.LABELS])


def _first_contacts(contacts: dict[str, list[NDArray[np.float64]]], lost: str | None) -> NDArray[np.float64]:
    """Return the first contact [K] (s after onset) of each stimulus with the whiskers whose contacts are known."""
    known = {name: items for name, items in contacts.items() if name != lost}
    first = np.full(len(rodgers.LABELS), np.inf)
    for stimulus, label in enumerate(rodgers.LABELS):
        first[stimulus] = min((runs[stimulus][0, 0] for runs in known.values() if len(runs[stimulus])), default=np.inf)
        if first[stimulus] >= CHOICE[0]:
            raise DataError(f"The stimulus {label!r} touches none of {listing(known)} in time for the demo's choices.")
    return first


def _expected(rates: NDArray[np.float64], afferents: Afferents, first: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the expected response [K, U] in the layout's window, first contact to choice."""
    return window_rates(rates, afferents.frame, first, np.linspace(*CHOICE, 18))


def _shared(afferents: Afferents, first: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    plain = np.ones(afferents.values.shape[2:])
    random = np.random.default_rng([seed, VERSION, 10_000])
    # In portions: the rates of all units at once would take a gigabyte.
    portions = [draw_population(random, afferents, _MANY // 8, plain) for _ in range(8)]
    return correlation_rdm(np.concatenate([_expected(item.rates(afferents), afferents, first) for item in portions], 1))
