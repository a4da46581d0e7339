"""Synthetic recordings as sessions of spike times, and as NWB or HDF5 files: the counts of ``draw_animals``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import check_name
from brainbench.core.progress import Progress
from brainbench.datasets.hdf5 import write_recordings
from brainbench.datasets.sessions import Session, make_session
from brainbench.datasets.synthetic.populations import DrawnSession, PopulationDesign, ResponseGeometry, draw_sessions
from brainbench.datasets.synthetic.truth import correlation_rdm, write_synthetic_nwb, write_with_truth

_LATENCY, _JITTER = 0.012, 0.003
"""Onset response after contact, s."""
_ONSET = 0.15
"""Share of the spikes in a window that belong to the onset response."""
_DEAD = 0.002
"""Refractory time, s."""


def spike_trains(
    random: np.random.Generator,
    counts: NDArray[np.int64],
    begin: NDArray[np.float64],
    length: float | NDArray[np.float64],
    rest: NDArray[np.float64],
    span: tuple[float, float],
) -> list[NDArray[np.float64]]:
    """Place the spikes of a session: counted ones in the trials' windows, and others at a constant rate between them.

    ``counts`` [R, U] are the spikes in windows that do not overlap, with ``begin`` [R] (ascending, s) and ``length`` of
    all or of each [R], s; ``rest`` [U] are the rates outside of them, Hz, and ``span`` the first and last second.
    Returns spike times of each unit [U], s; 15 % of those in a window come about 12 ms after its begin.
    """
    # The margins keep the refractory time between the spikes of a window and those around it.
    opened = np.concatenate([[span[0]], begin + length]) + _DEAD
    pause = np.concatenate([begin, [span[1]]]) - _DEAD - opened
    trains = []
    for unit in range(counts.shape[1]):
        window = _place_spikes(random, counts[:, unit], begin, length, _ONSET)
        idle = _place_spikes(random, random.poisson(rest[unit] * pause), opened, pause, 0.0)
        trains.append(np.sort(np.concatenate([window, idle])))
    return trains


def _place_spikes(
    random: np.random.Generator,
    counts: NDArray[np.int64],
    begin: NDArray[np.float64],
    length: float | NDArray[np.float64],
    onset: float,
) -> NDArray[np.float64]:
    """Place counted spikes [R] in windows, none within the refractory time of another.

    Positions are drawn in the window shortened by all refractory times, sorted, and spread apart by them: exactly
    ``counts`` spikes, at least the refractory time between any two. ``onset`` is the share of the spikes at the latency
    after the begin of their window. Returns spike times, s, window after window.
    """
    long = np.broadcast_to(np.asarray(length, dtype=np.float64), counts.shape)
    # At high counts the refractory time shrinks, so that it fills at most half of any window.
    dead = min(_DEAD, float(np.min(0.5 * long / np.maximum(counts, 1))))
    which = np.repeat(np.arange(len(counts)), counts)
    # A hair less than the window, which is half open and must hold the last spike after rounding.
    free = (long[which] - counts[which] * dead) * (1 - 1e-9)
    # Given their number, Poisson spikes lie evenly in the window; an onset response is moved to its latency below.
    position = random.random(len(which)) * free
    early = random.random(len(which)) < onset
    latency = _LATENCY + _JITTER * random.standard_normal(int(early.sum()))
    position[early] = np.clip(latency, 0.0, free[early])
    order = np.lexsort((position, which))
    # The i-th spike of a window moves by i refractory times, which keeps the order and makes the gaps.
    rank = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return begin[which] + position[order] + rank * dead


_BEFORE = 0.5
"""From trial start to contact, s."""
_AFTER = (0.25, 1.25)
"""Least and most time from the end of the window to the end of the trial, s: no two trials are alike in
length, so that a shifted clock cannot hide behind a regular rhythm."""
REST = 0.5
"""Rate between windows, as a share of a unit's mean rate."""
_TOUCH = 0.05
"""Duration of a contact, s."""


def write_files(
    folder: str | os.PathLike[str],
    geometry: ResponseGeometry,
    design: PopulationDesign | None = None,
    *,
    seed: int | Sequence[int] = 0,
    format: str = "nwb",
    stimuli: str = "",
    distance: Callable[[NDArray[np.float64]], NDArray[np.float64]] = correlation_rdm,
    progress: Progress | None = None,
    **about: Any,
) -> list[Path]:
    """Write synthetic animals as files, one per session, with ``truth.json`` beside them.

    Opened again (layout ``synthetic``) they give the counts of :func:`~brainbench.datasets.synthetic.draw_animals`;
    ``read_truth`` reads the truth. Files of the same names are replaced. The format is ``nwb`` or ``h5``, ``stimuli`` a
    recipe that the files then name. ``distance`` makes the RDM of each animal's expected rates [K, U] for the truth,
    ``about`` is what else that holds.
    """
    writers: dict[str, Callable[[Path, Session], Path]] = {"nwb": write_synthetic_nwb, "h5": write_recordings}
    check_name("format", format, writers)
    design = design or PopulationDesign()

    def draw() -> Iterator[tuple[Session, NDArray[np.float64]]]:
        for done, drawn in enumerate(draw_sessions(geometry, design, seed), start=1):
            yield replace(spike_session(geometry, drawn), stimuli=stimuli), drawn.expected
            if progress is not None:
                progress(done, design.animals * design.sessions, f"synthetic recordings {drawn.subject}")

    return write_with_truth(
        folder,
        draw(),
        write=writers[format],
        suffix=f".{format}",
        distance=distance,
        seed=seed,
        design=design,
        stimuli=stimuli,
        labels=geometry.labels,
        shared=geometry.rdm,
        **about,
    )


def trial_times(drawn: DrawnSession) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the contact and the end of every trial [R], s."""
    # A stream of its own, apart from that of the spikes: data set and files have equal times, whatever else is drawn.
    pause = np.round(np.random.default_rng([*drawn.stream, 2]).uniform(*_AFTER, len(drawn.labels)), 4)
    # A trial is lead, window and pause, and the next one follows at once; the first begins at 1 s.
    stop = 1.0 + np.cumsum(_BEFORE + drawn.window + pause)
    return stop - pause - drawn.window, stop


def spike_session(geometry: ResponseGeometry, drawn: DrawnSession) -> Session:
    """Return the spike times of a session whose counts were drawn.

    A trial begins 0.5 s before a whisker touches (table ``contacts_by_whisker_C1``); 15 % of the spikes that are
    counted come about 12 ms after that touch, the others anywhere in the window; between windows units fire at half
    their mean rate, and never twice within 2 ms (less at rates above 250 Hz). The window is ``first-contact..choice``.
    """
    random = np.random.default_rng([*drawn.stream, 1])
    begin, stop = trial_times(drawn)
    choice, end = begin + drawn.window, float(stop[-1])
    # The rate between windows is the same for all stimuli: a reader that mistakes the window loses the geometry.
    spikes = spike_trains(random, drawn.counts, begin, drawn.window, REST * drawn.expected.mean(axis=0), (0.0, end))
    tables: dict[str, dict[str, Any]] = {
        "trials": {
            "id": np.arange(len(begin)),
            "start_time": begin - _BEFORE,
            "stop_time": stop,
            "stimulus": np.array(geometry.labels, dtype=str)[drawn.labels],
            "choice_time": choice,
        },
        "contacts_by_whisker_C1": {"start_time": begin, "stop_time": begin + _TOUCH},
    }
    observed = [np.array([[0.0, end]])] * len(spikes)
    about = {"start": "2025-01-01T12:00:00+00:00", "synthetic": True}
    return make_session(drawn.subject, drawn.session, spikes, tables, observed=observed, **about)
