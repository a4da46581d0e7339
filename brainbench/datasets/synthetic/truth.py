"""Files of synthetic sessions, with ``truth.json`` beside them: the geometry that their units were given.

They are made once per machine and then found in the cache.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError, check_name
from brainbench.core.files import cache_dir, check_folder, content_hash, file_hash, read_json, write_json
from brainbench.core.progress import Progress
from brainbench.core.reading.hdf5 import trust_hdf5
from brainbench.core.reading.ranges import check_number
from brainbench.core.reading.sealed import is_sealed, keeping, seal_file
from brainbench.datasets.hdf5 import write_recordings
from brainbench.datasets.nwb import write_nwb
from brainbench.datasets.sessions import Session, make_session
from brainbench.datasets.synthetic.populations import (
    MODULATION,
    DrawnSession,
    PopulationDesign,
    ResponseGeometry,
    draw_animals,
    draw_sessions,
    entropy,
)

TRUTH = "truth.json"
NOTE = "SYNTHETIC recordings: ranks of models on them say nothing about brains."

write_synthetic_nwb = partial(
    write_nwb,
    description="simulated stimuli encoded by simulated neurons, made by brainbench.",
    general={
        "experimenter": ["Simulation, A"],
        "institution": "none (synthetic data)",
        "lab": "none (synthetic data)",
        "experiment_description": NOTE,
        "keywords": ["synthetic", "whisker", "barrel cortex", "demo"],
    },
    subject={
        "species": "Mus musculus",
        "sex": "U",
        "age": "P90D",
        "description": "SYNTHETIC subject: no animal was recorded.",
    },
)
"""Writes a session as NWB that says in every description that it is synthetic."""


def write_with_truth(
    folder: str | os.PathLike[str],
    sessions: Iterable[tuple[Session, NDArray[np.float64]]],
    *,
    write: Callable[[Path, Session], Path],
    suffix: str,
    distance: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    **about: Any,
) -> list[Path]:
    """Write sessions as files ``sub-…_ses-…SUFFIX``, and last their truth.

    A session comes with its units' expected responses [K, U] (Hz) to each stimulus in the window that is counted, and
    sessions of one subject come together. ``write`` writes one of them atomically, ``distance`` makes the RDM [P] of
    expected responses [K, U], and ``about`` is what else the truth holds: ``labels``, and ``shared``, the RDM [P] of
    the shared geometry. Returns the files of the sessions.
    """
    folder = Path(folder)
    expected: dict[str, list[NDArray[np.float64]]] = {}
    paths = []
    for session, rates in sessions:
        paths.append(write(folder / f"sub-{session.subject}_ses-{session.session}{suffix}", session))
        expected.setdefault(session.subject, []).append(rates)
    write_json(
        folder / TRUTH,
        {
            "note": NOTE,
            "synthetic": True,
            **about,
            "subjects": {name: distance(np.concatenate(own, axis=1)) for name, own in expected.items()},
            "files": {path.name: {"bytes": path.stat().st_size, "hash": file_hash(path)} for path in paths},
        },
    )
    return paths


def read_truth(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the truth of synthetic recordings: labels, and RDMs [P] of ``shared`` and ``subjects``."""
    truth = read_json(Path(folder) / TRUTH)
    truth["shared"] = np.array(truth["shared"])
    truth["subjects"] = {name: np.array(values) for name, values in truth["subjects"].items()}
    return truth


def squared_euclidean_rdm(responses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared Euclidean distances [P] between rows [K, U], divided by the number of units."""
    rows, columns = np.triu_indices(len(responses), 1)
    # The mean over units, not the sum (as rsatoolbox does), so that populations of different sizes compare.
    return np.mean((responses[rows] - responses[columns]) ** 2, axis=1)


def correlation_rdm(responses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the correlation distances [P] between rows [K, U]; NaN for rows without variance."""
    rows, columns = np.triu_indices(len(responses), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Distance 1 − Pearson r over units, upper triangle row by row, as the metrics compute it.
        return 1.0 - np.atleast_2d(np.corrcoef(responses))[rows, columns]


_log = logging.getLogger(__name__)


def ensure_recordings(name: str, *key: object, make: Callable[[Path], object]) -> Path:
    """Return the folder of synthetic recordings, making them if this machine has none.

    Two processes may ask at once and either may be killed: every file is written whole, the truth comes last, and a
    folder without it, or with files missing or of another size or hash, is made again. The folder's name begins with
    ``name``; ``key`` is everything on which the recordings depend, and ``make`` writes them into a folder, last their
    truth.
    """
    target = cache_dir("recordings") / f"{name}-{content_hash(*key)}"
    if not _complete(target):
        if (target / TRUTH).exists():
            _log.warning("The %s recordings in %s are damaged and are replaced.", name, target)
        # Before the stimuli are simulated, which is slow.
        check_folder(target, "The cache")
        make(target)
        with keeping("recordings"):
            seal_file(target / TRUTH)
    return target


def _complete(folder: Path) -> bool:
    if not is_sealed(folder / TRUTH):
        return False
    try:
        for name, stated in read_json(folder / TRUTH)["files"].items():
            path = folder / name
            if path.stat().st_size != stated["bytes"] or file_hash(path) != stated["hash"]:
                return False
            trust_hdf5(path)
    except (DataError, OSError, KeyError, TypeError, AttributeError):
        return False
    return True


_EXACT = 2e-4  # largest error of the modulation that calibration leaves, on the studies it draws


def measure_ceiling(
    geometry: ResponseGeometry, design: PopulationDesign, *, simulations: int = 50, seed: int | Sequence[int] = 0
) -> tuple[float, float]:
    """Measure the noise ceiling of a design: what the true geometry itself scores.

    That is the mean Pearson correlation between the true RDM and the RDM measured in one animal (correlation distance
    of mean responses, sessions joined). Animals without an RDM, because they lack a stimulus or did not answer one at
    all, are left out. ``simulations`` studies are drawn, each of ``design.animals`` animals. Returns the ceiling and
    its Monte-Carlo standard error; NaN if no animal has all stimuli, an RDM is flat (two stimuli), or there is one
    animal only for the error.
    """
    check_number("simulations", simulations, least=1, whole=True)
    truth, stimuli = geometry.rdm, len(geometry.labels)
    scores: list[float] = []
    for number in range(simulations):
        for sessions in draw_animals(geometry, design, (*entropy(seed), number)).values():
            means = np.concatenate([stimulus_means(block, stimuli) for block in sessions], axis=1)
            scores.append(_pearson(correlation_rdm(means), truth))
    finite = np.array([score for score in scores if np.isfinite(score)])
    if not len(finite):
        return float("nan"), float("nan")
    # Animals are drawn independently around a fixed geometry, so their comparisons have a standard error.
    error = finite.std(ddof=1) / np.sqrt(len(finite)) if len(finite) > 1 else np.nan
    return float(finite.mean()), float(error)


def calibrate(
    geometry: ResponseGeometry,
    design: PopulationDesign,
    *,
    ceiling: float,
    simulations: int = 50,
    seed: int | Sequence[int] = 0,
) -> PopulationDesign:
    """Return the design with the modulation at which it has a given noise ceiling.

    Found by Brent's method with common random numbers: the same animals are drawn at every step. ``ceiling`` is the
    wanted value of :func:`measure_ceiling`; the result is as exact as the Monte-Carlo error of so many ``simulations``.
    """

    from scipy.optimize import root_scalar

    check_number("ceiling", ceiling, above=0, most=1)

    def excess(modulation: float) -> float:
        """Return by how much the ceiling at a modulation exceeds the wanted one."""
        tried = replace(design, modulation=modulation)
        return measure_ceiling(geometry, tried, simulations=simulations, seed=seed)[0] - ceiling

    highest = excess(MODULATION)
    if not highest >= 0:
        raise UsageError(
            f"A noise ceiling of {ceiling:g} is out of reach: this design has up to {highest + ceiling:.3f}. "
            f"More units or trials, a higher rate, less dispersion or a smaller individual share raise it."
        )
    # Both ends are known: without modulation the expected comparison is zero.
    ends = {0.0: -ceiling, MODULATION: highest}
    # With the same seed at every step the ceiling depends on the modulation alone, as a root finder needs.
    root = root_scalar(
        lambda modulation: ends.get(modulation) or excess(modulation), bracket=(0.0, MODULATION), xtol=_EXACT
    )
    return replace(design, modulation=float(root.root))


def stimulus_means(block: Trials, stimuli: int) -> NDArray[np.float64]:
    """Return the mean response [K, U] to every stimulus; NaN where there is no trial."""
    # Indicators [K, R]: one product sums the trials of every stimulus.
    member = np.zeros((stimuli, len(block.labels)))
    member[block.labels, np.arange(len(block.labels))] = 1.0
    number = member.sum(axis=1, keepdims=True)
    total = member @ block.responses.mean(axis=1)
    return np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)


def _pearson(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    a, b = first - first.mean(), second - second.mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0 else float("nan")


_LATENCY, _JITTER = 0.012, 0.003  # onset response after contact, s
_ONSET = 0.15  # share of the spikes in a window that belong to the onset response
_DEAD = 0.002  # refractory time, s


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


_BEFORE = 0.5  # from trial start to contact, s
_AFTER = (0.25, 1.25)
"""Least and most time from the end of the window to the end of the trial, s: no two trials are alike in
length, so that a shifted clock cannot hide behind a regular rhythm."""
REST = 0.5  # rate between windows, as a share of a unit's mean rate
_TOUCH = 0.05  # duration of a contact, s


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
