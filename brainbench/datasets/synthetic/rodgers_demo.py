"""Recordings in the task and files of Rodgers (2022), with synthetic spikes: the second demo.

Neurons mix what the whiskers feel: forces and moments of every whisker, half-wave rectified in both directions,
compressed, divided by the mean of the tracked whiskers and averaged until the choice. Six stimuli and features so
near to the raw input tell no network apart from it; what the files are for is their layout with its quirks.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import DataError, listing
from brainbench.core.files import content_hash
from brainbench.core.progress import Progress
from brainbench.core.reading.ranges import check_number
from brainbench.datasets.layouts import rodgers
from brainbench.datasets.sessions import Session
from brainbench.datasets.synthetic.geometry import ResponseGeometry
from brainbench.datasets.synthetic.populations import expected_rates
from brainbench.datasets.synthetic.rodgers_task import (
    CHOICE,
    COLUMNS,
    SessionPlan,
    draw_session,
    first_contacts,
    tracked_contacts,
)
from brainbench.datasets.synthetic.truth import (
    correlation_rdm,
    ensure_recordings,
    write_synthetic_nwb,
    write_with_truth,
)

if TYPE_CHECKING:
    import xarray as xr

VERSION = 3
"""Raised when the same stimuli give other spikes, so that old caches are not reused."""

_ANIMALS = (
    (SessionPlan("demo01", "01", 34, 170, detection=True), SessionPlan("demo01", "02", 30, 140)),
    (SessionPlan("demo02", "01", 56, 270, lost_whisker="C0"),),
    (SessionPlan("demo03", "01", 30, 140, spans=True), SessionPlan("demo03", "02", 28, 150)),
    (SessionPlan("demo04", "01", 40, 220, modulation=0.12),),
)
"""The animals; the last is hard to read on purpose."""
_COMPRESSION = 1.0
"""Half-saturation of an afferent, in root mean squares of its channel."""


def make_rodgers_demo(
    folder: str | os.PathLike[str],
    stimuli: xr.Dataset,
    *,
    seed: int = 0,
    animals: int = 4,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the recordings and their truth into ``folder``.

    The stimulus set has the six labels of the Rodgers experiment and ``contact`` [stimulus, time, whisker] (bool). From
    the fifth animal on their sessions repeat the first ones' design. Files of the same names are replaced. Returns the
    NWB files. ``truth.json`` beside them holds, over ``labels``, the distances [P] of the geometry that all share
    (``shared``) and the noiseless correlation-distance RDM of each animal's units.
    """
    check_number("The number of animals of the demo", animals, least=1, whole=True)
    stimuli = _in_vocabulary_order(check_stimulus_set(stimuli))
    geometry = ResponseGeometry.from_activations(wrench_features(stimuli), rodgers.LABELS)
    contact = stimuli["contact"].transpose("stimulus", "time", "whisker").values.astype(bool)
    names = tuple(str(name) for name in stimuli["whisker"].values)
    contacts = tracked_contacts(names, contact, float(np.median(np.diff(stimuli["time"].values))))
    turns = ((f"demo{index + 1:02d}", _ANIMALS[index % len(_ANIMALS)]) for index in range(animals))
    plans = [[replace(plan, subject=subject) for plan in own] for subject, own in turns]
    # Stimuli that do not suit are told before a folder is made.
    for plan in (plan for own in plans for plan in own):
        first_contacts(contacts, rodgers.LABELS, plan.lost_whisker)

    def draw() -> Iterator[tuple[Session, NDArray[np.float64]]]:
        done, total = 0, sum(map(len, plans))
        for index, own in enumerate(plans):
            for number, plan in enumerate(own):
                random = np.random.default_rng([seed, VERSION, index, number])
                # Begun anew for every session: all sessions of an animal draw the same traits (expected_rates).
                animal = np.random.default_rng([seed, VERSION, index])
                expected = expected_rates(geometry, plan.design, animal, random)
                yield draw_session(random, plan, geometry, expected, contacts), expected
                done += 1
                if progress is not None:
                    progress(done, total, f"demo recordings {plan.subject}")

    return write_with_truth(
        folder,
        draw(),
        write=partial(write_synthetic_nwb, columns=COLUMNS),
        suffix="_behavior+ecephys.nwb",
        distance=correlation_rdm,
        version=VERSION,
        seed=seed,
        stimuli="rodgers",
        stimuli_hash=str(stimuli.attrs["content_hash"]),
        config_hash=_definition(stimuli, seed, animals),
        labels=geometry.labels,
        shared=geometry.rdm,
    )


def ensure_rodgers_demo(
    stimuli: xr.Dataset, *, seed: int = 0, animals: int = 4, progress: Progress | None = None
) -> Path:
    """Return the folder of the recordings, making them if this machine has none; see :func:`make_rodgers_demo`."""
    numbers = str(check_stimulus_set(stimuli).attrs["content_hash"])
    make = partial(make_rodgers_demo, stimuli=stimuli, seed=seed, animals=animals, progress=progress)
    return ensure_recordings("demo-rodgers", numbers, _definition(stimuli, seed, animals), make=make)


def _definition(stimuli: xr.Dataset, seed: int, animals: int) -> str:
    """Return the hash of how recordings are made, equal on every machine where that of the stimuli is."""
    made = stimuli.attrs.get("config_hash", stimuli.attrs["content_hash"])
    return content_hash("demo-rodgers", made, seed, animals, VERSION)


def wrench_features(stimuli: xr.Dataset) -> NDArray[np.float64]:
    """Return what whisker afferents tell of each stimulus [K, F] until the earliest choice."""
    names = tuple(str(name) for name in stimuli["whisker"].values)
    wrench = stimuli["wrench"].transpose("stimulus", "time", "whisker", "channel").values.astype(np.float64)
    broken = [name for index, name in enumerate(names) if not np.isfinite(wrench[:, :, index]).all()]
    if broken:
        raise DataError(f"The stimuli hold no finite wrench for {listing(broken)}: simulate with a finer fidelity.")
    tracked = [index for index, name in enumerate(names) if name in rodgers.TRACKED]
    if not tracked:
        raise DataError(f"The stimuli have none of the tracked whiskers {listing(rodgers.TRACKED)}; simulate them too.")
    # Root mean square of each channel: divided by it, forces (N) and moments (N·m) are comparable.
    scale = np.sqrt(np.mean(wrench[:, :, tracked] ** 2, axis=(0, 1, 2)))
    if not np.any(scale > 0):
        raise DataError("The stimuli exert no force on the whiskers, so there is nothing for neurons to encode.")
    # An afferent answers to one direction of a channel (half-wave rectification) and saturates as x/(x + 1).
    signal = wrench / np.where(scale > 0, scale, np.inf)
    halves = np.concatenate([np.maximum(signal, 0.0), np.maximum(-signal, 0.0)], axis=3)
    halves = halves / (halves + _COMPRESSION)
    # Divisive normalisation by all tracked whiskers: contacts are compared instead of forces added up (Rodgers 2021).
    surround = halves[:, :, tracked].mean(axis=(2, 3), keepdims=True)
    answer = (halves / (0.3 + surround))[:, stimuli["time"].values < CHOICE[0]]
    # Rounded, so that machines whose simulations differ in the last bits draw the same spikes.
    return np.round(answer.mean(axis=1).reshape(len(wrench), -1), 4)


def _in_vocabulary_order(stimuli: xr.Dataset) -> xr.Dataset:
    have = [str(label) for label in stimuli["stimulus"].values]
    if sorted(have) != sorted(rodgers.LABELS):
        raise DataError(f"The demo recordings need the stimuli {listing(rodgers.LABELS)}; these are {listing(have)}.")
    if "contact" not in stimuli:
        raise DataError("The demo recordings need the stimuli's contact [stimulus, time, whisker]; these have none.")
    return stimuli.isel(stimulus=[have.index(label) for label in rodgers.LABELS])
