"""Recordings in the task and files of Rodgers (2022), with synthetic spikes: the second demo.

Neurons mix what the whiskers feel: forces and moments of every whisker, half-wave rectified in both directions,
compressed, divided by the mean of the tracked whiskers and averaged until the choice. Six stimuli and features so
near to the raw input tell no network apart from it; what the files are for is their layout with its quirks.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import DataError, check_number, listing
from brainbench.core.files import content_hash
from brainbench.core.progress import Progress
from brainbench.datasets.layouts import published
from brainbench.datasets.layouts.published import TRACKED
from brainbench.datasets.sessions import Series, Session, make_session
from brainbench.datasets.synthetic import populations

if TYPE_CHECKING:
    import xarray as xr

CHOICE = (0.80, 0.97)  # earliest and latest choice, s after the shape comes into reach
_REACH = 1.0  # from trial start to the first frame of the stimulus, s
_LAYERS = ((130, "1"), (450, "2/3"), (600, "4"), (950, "5"), (1300, "6"))

COLUMNS = {
    "direct_delivery": "Water was given regardless of the choice.",
    "stim_is_random": "The stimulus was drawn at random.",
    "optogenetic": "A laser was on.",
    "outcome": "correct, error or spoil.",
    "choice": "left, right or nogo.",
    "rewarded_side": "left or right.",
    "servo_position": "close, medium or far.",
    "stimulus": "convex, concave or nothing.",
    "ignore_trial": "Not to be analysed.",
    "choice_time": "Time of the choice lick, s.",
    "response_window_open_time": "From when licks counted, s.",
}


@dataclass(frozen=True)
class SessionPlan:
    """The traits of one session that differ from those of the others."""

    subject: str
    session: str
    units: int
    trials: int
    modulation: float = 0.3
    """Depth of the tuning (:class:`PopulationDesign`); a small one makes the animal hard to read."""
    lost_whisker: str | None = None
    """Whisker without a contact table."""
    detection: bool = False
    """Contains trials without a shape."""
    spans: bool = False
    """Carries obs_intervals, and some units were lost before the end."""

    @property
    def design(self) -> populations.PopulationDesign:
        """Units, rates and noise of this session."""
        # Fano factors of about 1.5: windows are longer than in the default design.
        return populations.PopulationDesign(
            1, units=self.units, modulation=self.modulation, dispersion=0.1, shared_gain=0.1
        )


@dataclass(frozen=True)
class Behaviour:
    """Trials of a session; arrays of length R (rows), times in s on the session clock."""

    columns: Mapping[str, NDArray[Any]]
    stimulus: NDArray[np.int64]
    """Index of the stimulus; −1 for ``nothing``."""
    onset: NDArray[np.float64]
    """First frame of the stimulus."""
    lick: NDArray[np.float64]
    """Choice; where the mouse made none, when it would have."""
    recorded: tuple[float, float]
    """Span in which spikes were recorded."""


def draw_session(
    random: np.random.Generator,
    plan: SessionPlan,
    geometry: populations.ResponseGeometry,
    expected: NDArray[np.float64],
    runs: Mapping[str, list[NDArray[np.float64]]],
) -> Session:
    """Draw one session: neurons answer from the first contact that the files tell to the choice.

    ``expected`` [K, U] are the rates in the window, Hz; ``runs`` has per whisker and stimulus the contacts [n, 2] (s
    after onset).
    """
    behaviour = draw_behaviour(random, plan, geometry.labels)
    first = first_contacts(runs, geometry.labels, plan.lost_whisker)
    low, high = behaviour.recorded
    # Responses need a shape and a window inside the recorded span; in other trials units fire as between windows.
    answered = (behaviour.stimulus >= 0) & (behaviour.onset > low) & (behaviour.lick < high)
    presented = behaviour.stimulus[answered]
    begin = behaviour.onset[answered] + first[presented]
    length = behaviour.lick[answered] - begin
    counts = populations.draw_counts(random, plan.design, expected[presented], length[:, None])
    rest = populations.REST * expected.mean(axis=0)
    spikes = populations.spike_trains(random, counts, begin, length, rest, behaviour.recorded)
    contacts = draw_contacts(random, behaviour, runs)
    number = len(spikes)
    depth = np.round(np.sort(random.uniform(40, 1250, number)), 1)
    units = {
        "depth": depth,
        "layer": [next(name for limit, name in _LAYERS if item < limit) for item in depth],
        "inhibitory": random.random(number) < 0.2,
        # Numbers of clusters with gaps, as in the published files: code that takes an id for a row is found out.
        "id": np.sort(random.choice(np.arange(2, 600), size=number, replace=False)),
    }
    observed = None
    if plan.spans:
        low, high = behaviour.recorded
        # Every ninth unit is lost after 60 % of the recording; its later trials are missing, not silent.
        ends = np.where(np.arange(number) % 9 == 4, low + 0.6 * (high - low), high)
        spikes = [times[times < end] for times, end in zip(spikes, ends, strict=True)]
        observed = [np.array([[low, end]]) for end in ends]
    tables = {"trials": behaviour.columns} | {
        f"behavior/contacts_by_whisker_{whisker}": {"start_time": times[:, 0], "stop_time": times[:, 1]}
        for whisker, times in contacts.items()
        if whisker != plan.lost_whisker
    }
    about = {"start": "2025-01-01T12:00:00+00:00", "synthetic": True}
    names = (plan.subject, plan.session)
    session = make_session(*names, spikes, tables, unit_columns=units, observed=observed, **about)
    choice = behaviour.columns["choice"]
    licked = choice != "nogo"
    # 1 left, 2 right.
    side = np.where(choice[licked] == "left", 1, 2).astype(np.int8)
    licks = Series("processing/behavior/licks", "TimeSeries", side, behaviour.columns["choice_time"][licked])
    return replace(session, identifier=f"brainbench-demo-{plan.subject}-{plan.session}", series={licks.name: licks})


def draw_behaviour(random: np.random.Generator, plan: SessionPlan, labels: tuple[str, ...]) -> Behaviour:
    """Draw the trials table: shaping and spoiled trials, optogenetics, gaps in the numbering."""
    number = plan.trials
    stimulus = np.resize(np.arange(len(labels)), number)
    random.shuffle(stimulus)
    spoiled, ruined, laser = (random.random(number) < share for share in (0.06, 0.03, 0.04))
    direct, shaped = np.arange(number) < 4, np.arange(number) < 7
    if plan.detection:
        stimulus = np.where(random.random(number) < 0.08, -1, stimulus)
    duration = np.round(random.uniform(2.6, 3.4, number), 4)
    start = np.round(11.7 + np.concatenate([[0.0], np.cumsum(duration)[:-1]]), 4)
    stop = np.append(start[1:], start[-1] + duration[-1])
    onset = start + _REACH
    opened = onset + 0.3
    lick = np.round(onset + random.uniform(*CHOICE, number), 4)
    choice_time = lick.copy()
    # A spoiled trial has no lick: its choice_time lies far beyond its own end.
    choice_time[spoiled] = opened[spoiled] + 45.0
    shape, place = zip(*(label.split("-") for label in labels), strict=True)
    side = np.where(np.array([(*shape, "nothing")[index] == "convex" for index in stimulus]), "left", "right")
    right = random.random(number) < 0.78
    opposite = np.where(side == "left", "right", "left")
    nowhere = np.array(["close", "medium", "far"])[random.integers(3, size=number)]
    # Numbers of trials with gaps, as in the published files.
    ids = np.cumsum(random.choice([1, 1, 1, 2, 3], size=number)) + 3
    columns = {
        "start_time": start,
        "stop_time": stop,
        "direct_delivery": direct,
        "stim_is_random": ~shaped,
        "optogenetic": laser,
        "outcome": np.where(spoiled, "spoil", np.where(right, "correct", "error")),
        "choice": np.where(spoiled, "nogo", np.where(right, side, opposite)),
        "rewarded_side": side,
        "servo_position": np.array(
            [place[index] if index >= 0 else nowhere[row] for row, index in enumerate(stimulus)]
        ),
        "stimulus": np.array([(*shape, "nothing")[index] for index in stimulus]),
        "ignore_trial": direct | shaped | spoiled | laser | ruined,
        "choice_time": choice_time,
        "response_window_open_time": opened,
        "id": ids.astype(np.int64),
    }
    # Recording covers neither the first nor the last trials: these must be excluded, not read as silence.
    return Behaviour(columns, stimulus, onset, lick, (float(start[5]) + 0.2, float(stop[-7])))


def draw_contacts(
    random: np.random.Generator, behaviour: Behaviour, runs: Mapping[str, list[NDArray[np.float64]]]
) -> dict[str, NDArray[np.float64]]:
    """Place the simulated contacts in the session and add single-frame (zero-duration) ones.

    ``runs`` are as in :func:`draw_session`. Returns whisker → contacts [n, 2] in the order of time, s.
    """
    placed = {}
    for whisker, per_stimulus in runs.items():
        rows = [np.zeros((0, 2))]
        for onset, stimulus in zip(behaviour.onset, behaviour.stimulus, strict=True):
            if stimulus >= 0:
                # A jitter of 1 ms keeps the contacts of equal trials from being exactly equal.
                jitter = random.normal(0.0, 0.001, (len(per_stimulus[stimulus]), 1))
                rows.append(per_stimulus[stimulus] + onset + jitter)
            if random.random() < 0.15:
                # Begin and end are equal: rows of zero duration are empty intervals and no first contact.
                rows.append(np.full((1, 2), onset + random.uniform(-0.3, 0.9)))
        contacts = np.round(np.concatenate(rows), 4)
        placed[whisker] = contacts[np.argsort(contacts[:, 0], kind="stable")]
    return placed


def tracked_contacts(
    whiskers: tuple[str, ...], contact: NDArray[np.bool_], frame: float
) -> dict[str, list[NDArray[np.float64]]]:
    """Turn contact per frame [K, T, W] into contacts [n, 2] (s after onset) of every tracked whisker and stimulus."""
    contacts = {}
    for name in TRACKED:
        if name in whiskers:
            # Rows of a change lie before their frame, so begin and end come out in pairs.
            change = np.diff(contact[:, :, whiskers.index(name)].astype(np.int8), axis=1, prepend=0, append=0)
            ends = ((np.flatnonzero(row == 1), np.flatnonzero(row == -1)) for row in change)
            contacts[name] = [np.stack(pair, axis=1) * frame for pair in ends]
    return contacts


def first_contacts(
    runs: Mapping[str, list[NDArray[np.float64]]], labels: tuple[str, ...], lost: str | None
) -> NDArray[np.float64]:
    """Return the first contact [K] (s after onset) of each stimulus with the whiskers whose contacts are told."""
    tracked = {name: items for name, items in runs.items() if name != lost}
    first = np.full(len(labels), np.inf)
    for stimulus, label in enumerate(labels):
        begins = (items[stimulus][0, 0] for items in tracked.values() if len(items[stimulus]))
        first[stimulus] = min(begins, default=np.inf)
        if first[stimulus] >= CHOICE[0]:
            raise DataError(
                f"The stimulus {label!r} touches none of {listing(tracked)} in time for the demo's choices."
            )
    return first


VERSION = 3  # raised when the same stimuli give other spikes, so that old caches are not reused

_ANIMALS = (
    (SessionPlan("demo01", "01", 34, 170, detection=True), SessionPlan("demo01", "02", 30, 140)),
    (SessionPlan("demo02", "01", 56, 270, lost_whisker="C0"),),
    (SessionPlan("demo03", "01", 30, 140, spans=True), SessionPlan("demo03", "02", 28, 150)),
    (SessionPlan("demo04", "01", 40, 220, modulation=0.12),),
)
"""The animals; the last is hard to read on purpose."""
_COMPRESSION = 1.0  # half-saturation of an afferent, in root mean squares of its channel


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
    geometry = populations.ResponseGeometry.from_activations(wrench_features(stimuli), published.LABELS)
    contact = stimuli["contact"].transpose("stimulus", "time", "whisker").values.astype(bool)
    names = tuple(str(name) for name in stimuli["whisker"].values)
    contacts = tracked_contacts(names, contact, float(np.median(np.diff(stimuli["time"].values))))
    turns = ((f"demo{index + 1:02d}", _ANIMALS[index % len(_ANIMALS)]) for index in range(animals))
    plans = [[replace(plan, subject=subject) for plan in own] for subject, own in turns]
    # Stimuli that do not suit are told before a folder is made.
    for plan in (plan for own in plans for plan in own):
        first_contacts(contacts, published.LABELS, plan.lost_whisker)

    def draw() -> Iterator[tuple[Session, NDArray[np.float64]]]:
        """Yield each session with its expected rates [K, U] (spikes/s), one in memory at a time."""
        done, total = 0, sum(map(len, plans))
        for index, animal_plans in enumerate(plans):
            for number, plan in enumerate(animal_plans):
                random = np.random.default_rng([seed, VERSION, index, number])
                # Begun anew for every session: all sessions of an animal draw the same traits (expected_rates).
                animal = np.random.default_rng([seed, VERSION, index])
                expected = populations.expected_rates(geometry, plan.design, animal, random)
                yield draw_session(random, plan, geometry, expected, contacts), expected
                done += 1
                if progress is not None:
                    progress(done, total, f"demo recordings {plan.subject}")

    return populations.write_with_truth(
        folder,
        draw(),
        write=partial(populations.write_synthetic_nwb, columns=COLUMNS),
        suffix="_behavior+ecephys.nwb",
        distance=populations.correlation_rdm,
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
    return populations.ensure_recordings("demo-rodgers", numbers, _definition(stimuli, seed, animals), make=make)


def _definition(stimuli: xr.Dataset, seed: int, animals: int) -> str:
    """Return the hash of how recordings are made, equal on every machine where that of the stimuli is."""
    stimuli_hash = stimuli.attrs.get("config_hash", stimuli.attrs["content_hash"])
    return content_hash("demo-rodgers", stimuli_hash, seed, animals, VERSION)


def wrench_features(stimuli: xr.Dataset) -> NDArray[np.float64]:
    """Return what whisker afferents tell of each stimulus [K, F] until the earliest choice."""
    names = tuple(str(name) for name in stimuli["whisker"].values)
    wrench = stimuli["wrench"].transpose("stimulus", "time", "whisker", "channel").values.astype(np.float64)
    broken = [name for index, name in enumerate(names) if not np.isfinite(wrench[:, :, index]).all()]
    if broken:
        raise DataError(f"The stimuli hold no finite wrench for {listing(broken)}: simulate with a finer fidelity.")
    tracked = [index for index, name in enumerate(names) if name in published.TRACKED]
    if not tracked:
        raise DataError(
            f"The stimuli have none of the tracked whiskers {listing(published.TRACKED)}; simulate them too."
        )
    # Root mean square of each channel: divided by it, forces (N) and moments (N·m) are comparable.
    scale = np.sqrt(np.mean(wrench[:, :, tracked] ** 2, axis=(0, 1, 2)))
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
    if sorted(have) != sorted(published.LABELS):
        raise DataError(f"The demo recordings need the stimuli {listing(published.LABELS)}; these are {listing(have)}.")
    if "contact" not in stimuli:
        raise DataError("The demo recordings need the stimuli's contact [stimulus, time, whisker]; these have none.")
    return stimuli.isel(stimulus=[have.index(label) for label in published.LABELS])
