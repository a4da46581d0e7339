"""Sessions of synthetic mice in the task and the file layout of Rodgers 2022, quirks included."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, listing
from brainbench.datasets.layouts.rodgers import TRACKED
from brainbench.datasets.sessions import Series, Session, make_session
from brainbench.datasets.synthetic.design import PopulationDesign
from brainbench.datasets.synthetic.geometry import ResponseGeometry
from brainbench.datasets.synthetic.populations import draw_counts
from brainbench.datasets.synthetic.sessions import REST
from brainbench.datasets.synthetic.spikes import spike_trains

CHOICE = (0.80, 0.97)
"""Earliest and latest choice, s after the shape comes into reach."""
_REACH = 1.0
"""From trial start to the first frame of the stimulus, s."""
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
    def design(self) -> PopulationDesign:
        """Units, rates and noise of this session."""
        # Fano factors of about 1.5: windows are longer than in the default design.
        return PopulationDesign(1, units=self.units, modulation=self.modulation, dispersion=0.1, shared_gain=0.1)


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
    geometry: ResponseGeometry,
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
    shown = behaviour.stimulus[answered]
    begin = behaviour.onset[answered] + first[shown]
    length = behaviour.lick[answered] - begin
    counts = draw_counts(random, plan.design, expected[shown], length[:, None])
    rest = REST * expected.mean(axis=0)
    spikes = spike_trains(random, counts, begin, length, rest, behaviour.recorded)
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
    named = (plan.subject, plan.session)
    session = make_session(*named, spikes, tables, unit_columns=units, observed=observed, **about)
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
    other = np.where(side == "left", "right", "left")
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
        "choice": np.where(spoiled, "nogo", np.where(right, side, other)),
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
    found = {}
    for name in TRACKED:
        if name in whiskers:
            # Rows of a change lie before their frame, so begin and end come out in pairs.
            change = np.diff(contact[:, :, whiskers.index(name)].astype(np.int8), axis=1, prepend=0, append=0)
            ends = ((np.flatnonzero(row == 1), np.flatnonzero(row == -1)) for row in change)
            found[name] = [np.stack(pair, axis=1) * frame for pair in ends]
    return found


def first_contacts(
    runs: Mapping[str, list[NDArray[np.float64]]], labels: tuple[str, ...], lost: str | None
) -> NDArray[np.float64]:
    """Return the first contact [K] (s after onset) of each stimulus with the whiskers whose contacts are told."""
    known = {name: items for name, items in runs.items() if name != lost}
    first = np.full(len(labels), np.inf)
    for stimulus, label in enumerate(labels):
        begins = (items[stimulus][0, 0] for items in known.values() if len(items[stimulus]))
        first[stimulus] = min(begins, default=np.inf)
        if first[stimulus] >= CHOICE[0]:
            raise DataError(f"The stimulus {label!r} touches none of {listing(known)} in time for the demo's choices.")
    return first
