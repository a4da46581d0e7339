"""Synthetic recordings as a data set, as sessions of spike times, and as NWB or HDF5 files.

All three hold the same counts as :func:`brainbench.datasets.synthetic.animals.simulate` with the same seed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import unknown_name
from brainbench.core.files import write_json
from brainbench.datasets.exports import write_nwb
from brainbench.datasets.hdf5 import write_recordings
from brainbench.datasets.sessions import Session, make_session
from brainbench.datasets.synthetic.design import Design, draw_session, entropy, session_name, subject_name
from brainbench.datasets.synthetic.geometry import ResponseGeometry
from brainbench.datasets.synthetic.truth import TRUTH, correlation_rdm
from brainbench.datasets.trials.conditions import Conditions
from brainbench.datasets.trials.counting import ReadingOptions, SessionCounts
from brainbench.datasets.trials.joining import join_sessions
from brainbench.datasets.trials.selection import EVERYTHING, Tally
from brainbench.datasets.trials.windows import Window

if TYPE_CHECKING:
    import xarray as xr

CONDITIONS = Conditions("trials", ("stimulus",))
_BEFORE = 0.5
"""From trial start to contact, s."""
_AFTER = (0.25, 1.25)
"""Least and most time from the end of the window to the end of the trial, s: no two trials are alike in
length, so that a shifted clock cannot hide behind a regular rhythm."""
_LATENCY, _JITTER = 0.012, 0.003
"""Onset response after contact, s."""
_ONSET = 0.15
"""Share of the spikes in a window that belong to the onset response."""
_DEAD = 0.002
"""Refractory time, s."""
_REST = 0.5
"""Rate between windows, as a share of a unit's mean rate."""
_TOUCH = 0.05
"""Duration of a contact, s."""


def as_recordings(
    geometry: ResponseGeometry, design: Design | None = None, *, seed: int | Sequence[int] = 0
) -> xr.Dataset:
    """Draw synthetic animals as a recordings data set, ready for ``trials_by_subject`` and ``score``.

    Raises:
        DataError: the design leaves no trial or one condition only.
    """
    design = design or Design()
    plan = ReadingOptions(
        CONDITIONS, geometry.labels, EVERYTHING, Window("choice", offset=-design.window, length=design.window), None
    )
    parts = []
    for animal in range(design.animals):
        for number in range(design.sessions):
            drawn = draw_session(geometry, design, animal, number, seed)
            begin, _ = _times(design, len(drawn.labels), (*entropy(seed), animal, number))
            labels = tuple(geometry.labels[index] for index in drawn.labels)
            parts.append(
                SessionCounts(
                    subject=subject_name(animal),
                    session=session_name(number),
                    source=f"{subject_name(animal)}-{session_name(number)}",
                    values=tuple((label,) for label in labels),
                    labels=labels,
                    trial_ids=tuple(map(str, range(len(labels)))),
                    unit_ids=tuple(map(str, range(drawn.counts.shape[1]))),
                    edges=np.stack([begin, begin + design.window], axis=1),
                    counts=drawn.counts[:, None].astype(np.float32),
                    duration=np.full((len(labels), 1), design.window),
                    columns={
                        "depth": np.full(drawn.counts.shape[1], np.nan),
                        "layer": np.full(drawn.counts.shape[1], "", dtype="U1"),
                        "inhibitory": np.full(drawn.counts.shape[1], np.nan),
                    },
                    covariates={},
                    tally=Tally(),
                    trials=len(labels),
                    units=drawn.counts.shape[1],
                    synthetic=True,
                )
            )
    return join_sessions(parts, plan, source="synthetic", layout="", notes=[])


def make_sessions(
    geometry: ResponseGeometry, design: Design | None = None, *, seed: int | Sequence[int] = 0
) -> list[Session]:
    """Draw synthetic animals as sessions of spike times.

    A trial begins 0.5 s before a whisker touches (table ``contacts_by_whisker_C1``); 15 % of the spikes
    that are counted come about 12 ms after that touch, the others anywhere in the window; between
    windows units fire at half their mean rate, and never twice within 2 ms (less at rates above
    250 Hz). The window is ``first-contact..choice``.
    """
    design = design or Design()
    return [
        _session(geometry, design, animal, number, seed)
        for animal in range(design.animals)
        for number in range(design.sessions)
    ]


def write_files(
    folder: str | os.PathLike[str],
    geometry: ResponseGeometry,
    design: Design | None = None,
    *,
    seed: int | Sequence[int] = 0,
    format: str = "nwb",
) -> list[Path]:
    """Write synthetic animals as files, one per session, with ``truth.json`` beside them.

    Opened with ``conditions="trials:stimulus", window="first-contact..choice"`` they give the counts of
    :func:`~brainbench.datasets.synthetic.animals.simulate`; ``read_truth`` of the demo reads the truth.

    Raises:
        UsageError: a format other than ``nwb`` and ``h5``.
    """
    if format not in ("nwb", "h5"):
        raise unknown_name("format", format, ("nwb", "h5"))
    design, folder = design or Design(), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    expected: dict[str, list[NDArray[np.float64]]] = {}
    for animal in range(design.animals):
        for number in range(design.sessions):
            session = _session(geometry, design, animal, number, seed)
            drawn = draw_session(geometry, design, animal, number, seed)
            expected.setdefault(session.subject, []).append(drawn.expected)
            path = folder / f"sub-{session.subject}_ses-{session.session}.{format}"
            paths.append(write_nwb(path, session) if format == "nwb" else write_recordings(path, session))
    write_json(
        folder / TRUTH,
        {
            "note": "SYNTHETIC recordings: ranks of models on them say nothing about brains.",
            "synthetic": True,
            "seed": seed,
            "design": design,
            "labels": geometry.labels,
            "shared": geometry.rdm,
            "subjects": {name: correlation_rdm(np.concatenate(rates, axis=1)) for name, rates in expected.items()},
        },
    )
    return paths


def place_spikes(
    random: np.random.Generator,
    counts: NDArray[np.int64],
    begin: NDArray[np.float64],
    length: float | NDArray[np.float64],
    onset: float,
) -> NDArray[np.float64]:
    """Place counted spikes [R] in windows, none within the refractory time of another.

    Positions are drawn in the window shortened by all refractory times, sorted, and spread apart by
    them: exactly ``counts`` spikes, at least the refractory time between any two.

    Args:
        random: source of the draws.
        counts: spikes of each window.
        begin: begin of each window, s.
        length: length of all windows, or of each [R], s.
        onset: share of the spikes at the latency after the begin.

    Returns:
        spike times, s, window after window.
    """
    long = np.broadcast_to(np.asarray(length, dtype=np.float64), counts.shape)
    dead = min(_DEAD, float(np.min(0.5 * long / np.maximum(counts, 1))))
    which = np.repeat(np.arange(len(counts)), counts)
    # A hair less than the window, which is half open and must hold the last spike after rounding.
    free = (long[which] - counts[which] * dead) * (1 - 1e-9)
    position = random.random(len(which)) * free
    early = random.random(len(which)) < onset
    latency = _LATENCY + _JITTER * random.standard_normal(int(early.sum()))
    position[early] = np.clip(latency, 0.0, free[early])
    order = np.lexsort((position, which))
    rank = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return begin[which] + position[order] + rank * dead


def _times(design: Design, trials: int, stream: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Contact and end of every trial, s."""
    pause = np.round(np.random.default_rng([*stream, 2]).uniform(*_AFTER, trials), 4)
    stop = 1.0 + np.cumsum(_BEFORE + design.window + pause)
    return stop - pause - design.window, stop


def _session(
    geometry: ResponseGeometry, design: Design, animal: int, number: int, seed: int | Sequence[int]
) -> Session:
    drawn = draw_session(geometry, design, animal, number, seed)
    stream = (*entropy(seed), animal, number)
    random = np.random.default_rng([*stream, 1])
    begin, stop = _times(design, len(drawn.labels), stream)
    start = begin - _BEFORE
    end = float(stop[-1])
    # The margins keep the refractory time between the spikes of a window and those around it.
    opened = np.concatenate([[0.0], begin + design.window]) + _DEAD
    pause = np.concatenate([begin, [end]]) - _DEAD - opened
    rest = _REST * drawn.expected.mean(axis=0)
    spikes = []
    for unit in range(drawn.counts.shape[1]):
        window = place_spikes(random, drawn.counts[:, unit], begin, design.window, _ONSET)
        idle = place_spikes(random, random.poisson(rest[unit] * pause), opened, pause, 0.0)
        spikes.append(np.sort(np.concatenate([window, idle])))
    tables: dict[str, dict[str, Any]] = {
        "trials": {
            "id": np.arange(len(begin)),
            "start_time": start,
            "stop_time": stop,
            "stimulus": np.array(geometry.labels, dtype=str)[drawn.labels],
            "choice_time": begin + design.window,
        },
        "contacts_by_whisker_C1": {"start_time": begin, "stop_time": begin + _TOUCH},
    }
    return make_session(
        subject_name(animal),
        session_name(number),
        spikes,
        tables,
        observed=[np.array([[0.0, end]])] * len(spikes),
        start="2025-01-01T12:00:00+00:00",
        synthetic=True,
    )
