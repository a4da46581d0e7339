"""One synthetic session in the layout of Rodgers 2022, quirks included."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.files import atomic_path
from brainbench.datasets.synthetic.demo_neurons import LATENCY, TRACKED
from brainbench.datasets.synthetic.nwb_writer import NwbWriter

CHOICE = (0.80, 0.97)
"""Earliest and latest choice, s after the shape comes into reach."""
_REACH = 1.0
"""From trial start to the first frame of the stimulus, s."""
_LAYERS = ((130, "1"), (450, "2/3"), (600, "4"), (950, "5"), (1300, "6"))
_CLOCK = 30000.0
"""Spike times are multiples of one sample of a 30 kHz recording."""


@dataclass(frozen=True)
class SessionPlan:
    """What makes one session different from the others."""

    subject: str
    session: str
    units: int
    trials: int
    depth: float = 1.0
    """Strength of the tuning; below one the animal is hard to read."""
    lost_whisker: str | None = None
    """Whisker without a contact table."""
    detection: bool = False
    """Contains trials without a shape."""
    spans: bool = False
    """Carries obs_intervals, and some units were lost before the end."""


@dataclass(frozen=True)
class Behaviour:
    """Trials of a session; arrays of length R (rows), times in s on the session clock."""

    columns: Mapping[str, tuple[str, Any]]
    ids: NDArray[np.int64]
    stimulus: NDArray[np.int64]
    """Index of the stimulus; −1 for ``nothing``."""
    onset: NDArray[np.float64]
    """First frame of the stimulus."""
    recorded: tuple[float, float]
    """Span in which spikes were recorded."""
    length: float
    """Duration of the session."""


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
    choice_time = np.round(onset + random.uniform(*CHOICE, number), 4)
    choice_time[spoiled] = opened[spoiled] + 45.0
    shape, place = zip(*(label.split("-") for label in labels), strict=True)
    side = np.where(np.array([(*shape, "nothing")[index] == "convex" for index in stimulus]), "left", "right")
    right = random.random(number) < 0.78
    other = np.where(side == "left", "right", "left")
    nowhere = np.array(["close", "medium", "far"])[random.integers(3, size=number)]
    columns: dict[str, tuple[str, Any]] = {
        "start_time": ("Start of the trial, s.", start),
        "stop_time": ("End of the trial, s.", stop),
        "direct_delivery": ("Water was given regardless of the choice.", direct),
        "stim_is_random": ("The stimulus was drawn at random.", ~shaped),
        "optogenetic": ("A laser was on.", laser),
        "outcome": ("correct, error or spoil.", np.where(spoiled, "spoil", np.where(right, "correct", "error"))),
        "choice": ("left, right or nogo.", np.where(spoiled, "nogo", np.where(right, side, other))),
        "rewarded_side": ("left or right.", side),
        "servo_position": (
            "close, medium or far.",
            np.array([place[index] if index >= 0 else nowhere[row] for row, index in enumerate(stimulus)]),
        ),
        "stimulus": ("convex, concave or nothing.", np.array([(*shape, "nothing")[index] for index in stimulus])),
        "ignore_trial": ("Not to be analysed.", direct | shaped | spoiled | laser | ruined),
        "choice_time": ("Time of the choice lick, s.", choice_time),
        "response_window_open_time": ("From when licks counted, s.", opened),
    }
    ids = np.cumsum(random.choice([1, 1, 1, 2, 3], size=number)) + 3
    recorded = (float(start[5]) + 0.2, float(stop[-7]))
    return Behaviour(columns, ids.astype(np.int64), stimulus, onset, recorded, float(stop[-1]))


def draw_spikes(
    random: np.random.Generator,
    behaviour: Behaviour,
    rates: NDArray[np.float64],
    rest: NDArray[np.float64],
    frame: float,
) -> list[NDArray[np.float64]]:
    """Draw the spike times (s) of every unit: gamma-Poisson counts, Fano factor about 1.5 to 2.

    Args:
        random: source of the draws.
        behaviour: the trials.
        rates: [K, T, U] expected rates during the stimuli, Hz.
        rest: [U] rate at all other times, Hz.
        frame: duration of a frame, s.
    """
    low, high = behaviour.recorded
    frames, units = rates.shape[1:]
    first = np.floor((behaviour.onset + LATENCY - low) / frame).astype(int)
    total = int((high - low) / frame)
    expected = np.broadcast_to(rest, (total, units)).copy()
    shared = random.gamma(40.0, 1 / 40.0, len(first))
    own = random.gamma(9.0, 1 / 9.0, (len(first), units))
    fraction = (behaviour.onset + LATENCY - low) / frame - first
    for trial, stimulus in enumerate(behaviour.stimulus):
        begin, end = first[trial], first[trial] + frames + 1
        if stimulus < 0 or begin < 0 or end > total:
            continue
        # The stimulus starts inside a frame of the session's grid; share its rate between neighbours.
        padded = np.concatenate([rest[None], rates[stimulus], rest[None]])
        shift = fraction[trial]
        expected[begin:end] = (1 - shift) * padded[1:] + shift * padded[:-1]
        expected[begin:end] *= shared[trial] * own[trial]
    numbers = random.poisson(expected * frame)
    spikes = []
    for unit in range(units):
        bins = np.repeat(np.arange(total), numbers[:, unit])
        times = np.sort(low + (bins + random.random(len(bins))) * frame)
        times = np.round(times * _CLOCK) / _CLOCK
        spikes.append(times[np.diff(times, prepend=-1.0) > 0.001])
    return spikes


def draw_contacts(
    random: np.random.Generator, behaviour: Behaviour, runs: Mapping[str, list[NDArray[np.float64]]]
) -> dict[str, NDArray[np.float64]]:
    """Place the simulated contacts in the session and add single-frame (zero-duration) ones.

    Args:
        random: source of the draws.
        behaviour: the trials.
        runs: whisker → per stimulus the contacts [n, 2] (s after onset).

    Returns:
        whisker → contacts [n, 2] in the order of time, s.
    """
    placed = {}
    for whisker, per_stimulus in runs.items():
        rows = [np.zeros((0, 2))]
        for onset, stimulus in zip(behaviour.onset, behaviour.stimulus, strict=True):
            if stimulus >= 0:
                jitter = random.normal(0.0, 0.001, (len(per_stimulus[stimulus]), 1))
                rows.append(per_stimulus[stimulus] + onset + jitter)
            if random.random() < 0.15:
                rows.append(np.full((1, 2), onset + random.uniform(-0.3, 0.9)))
        contacts = np.round(np.concatenate(rows), 4)
        placed[whisker] = contacts[np.argsort(contacts[:, 0], kind="stable")]
    return placed


def contact_runs(contact: NDArray[np.bool_], frame: float) -> list[NDArray[np.float64]]:
    """Turn contact per frame [K, T] into contacts [n, 2] (s after onset) for each stimulus."""
    runs = []
    for row in contact:
        change = np.diff(row.astype(np.int8), prepend=0, append=0)
        runs.append(np.stack([np.flatnonzero(change == 1), np.flatnonzero(change == -1)], axis=1) * frame)
    return runs


def write_session(
    path: Path,
    random: np.random.Generator,
    plan: SessionPlan,
    behaviour: Behaviour,
    spikes: list[NDArray[np.float64]],
    contacts: Mapping[str, NDArray[np.float64]],
) -> None:
    """Write one session as NWB 2.x, atomically."""
    import h5py

    units = len(spikes)
    depth = np.round(np.sort(random.uniform(40, 1250, units)), 1)
    columns: dict[str, tuple[str, Any]] = {
        "spike_times": ("Spike times, s.", spikes),
        "depth": ("Depth below the pia, µm.", depth),
        "layer": (
            "Cortical layer.",
            np.array([next(name for limit, name in _LAYERS if item < limit) for item in depth]),
        ),
        "inhibitory": ("Narrow-spiking, putatively inhibitory.", random.random(units) < 0.2),
    }
    if plan.spans:
        low, high = behaviour.recorded
        lost = np.arange(units) % 9 == 4
        ends = np.where(lost, low + 0.6 * (high - low), high)
        columns["spike_times"] = (
            "Spike times, s.",
            [times[times < end] for times, end in zip(spikes, ends, strict=True)],
        )
        columns["obs_intervals"] = ("Recorded span of each unit, s.", [np.array([[low, end]]) for end in ends])
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        writer = NwbWriter(
            file,
            identifier=f"brainbench-demo-{plan.subject}-{plan.session}",
            description="SYNTHETIC session made by brainbench: simulated contacts encoded by simulated neurons.",
            start="2025-01-01T12:00:00+00:00",
            general={
                "experimenter": ["Simulation, A"],
                "institution": "none (synthetic data)",
                "lab": "none (synthetic data)",
                "session_id": plan.session,
                "experiment_description": "SYNTHETIC demo recordings; ranks on them say nothing about brains.",
                "keywords": ["synthetic", "whisker", "barrel cortex", "demo"],
            },
            subject={
                "subject_id": plan.subject,
                "species": "Mus musculus",
                "sex": "U",
                "age": "P90D",
                "description": "SYNTHETIC subject: no animal was recorded.",
            },
        )
        writer.table("intervals/trials", "TimeIntervals", "SYNTHETIC trials.", behaviour.ids, behaviour.columns)
        ids = np.sort(random.choice(np.arange(2, 600), size=units, replace=False)).astype(np.int64)
        writer.table("units", "Units", "SYNTHETIC units.", ids, columns)
        file["units/spike_times"].attrs["resolution"] = 1 / _CLOCK
        writer.module("behavior", "SYNTHETIC contacts and licks.")
        for whisker, times in contacts.items():
            if whisker != plan.lost_whisker:
                writer.table(
                    f"processing/behavior/contacts_by_whisker_{whisker}",
                    "TimeIntervals",
                    f"SYNTHETIC contacts of whisker {whisker}; single-frame contacts have zero duration.",
                    np.arange(len(times)),
                    {"start_time": ("Begin, s.", times[:, 0]), "stop_time": ("End, s.", times[:, 1])},
                )
        licked = behaviour.columns["choice"][1] != "nogo"
        licks = behaviour.columns["choice_time"][1][licked]
        side = np.where(behaviour.columns["choice"][1][licked] == "left", 1, 2).astype(np.int8)
        writer.events("processing/behavior/licks", "SYNTHETIC choice licks: 1 left, 2 right.", licks, side)


def tracked_runs(whiskers: tuple[str, ...], contact: NDArray[np.bool_], frame: float) -> dict[str, list[NDArray[Any]]]:
    """Contacts of the tracked whiskers that the stimuli have; ``contact`` is [K, T, W]."""
    return {name: contact_runs(contact[:, :, whiskers.index(name)], frame) for name in TRACKED if name in whiskers}
