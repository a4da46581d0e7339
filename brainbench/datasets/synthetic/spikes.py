"""Spike times from counts: an onset response, a rate between windows, and a refractory time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
