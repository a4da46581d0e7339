"""Delays of readings: the range of lags that explains a log, then the lag of each reading by itself.

Letters: T reading, N probe.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError
from robotics_bridge.sensors.calibration.likelihood import Aligned, Fit, begins_loaded
from robotics_bridge.sensors.calibration.log import Episode

_SURE = 25.0
"""Difference of the misfit, in units of the noise's variance, at which one lag beats the next."""
_WINDOW = 40
"""Readings to either side over which drift counts as a level."""


def blur(x: NDArray[np.float64], first: int, last: int) -> NDArray[np.float64]:
    """Return the mean of ``x`` over lags of ``first`` to ``last`` readings; before, it had its first value."""
    # Running mean as a difference of two sums: its cost does not depend on the range of lags.
    total = np.cumsum(np.pad(x, (last + 1, 0), mode="edge"))
    end = np.arange(len(x)) + last + 1
    return (total[end - first] - total[end - last - 1]) / (last - first + 1)


def find_delays(parts: list[Episode], longest: int) -> tuple[int, int]:
    """Return the range of lags over which the blurred signal explains the differences of the readings best.

    Lags that vary blur a signal in the mean. The best single lag is found first and its range then grown.
    """
    longest = min(longest, min(len(x) for x, _y in parts) // 2)
    steps = [np.diff(y[longest:], axis=0) for _x, y in parts]
    powers = [np.maximum((step * step).sum(axis=0), 1e-300) for step in steps]

    def explained(first: int, last: int) -> float:
        score = 0.0
        for (x, _y), step, power in zip(parts, steps, powers, strict=True):
            # Squared correlation of differences: gain, bias and drift of the readings do not enter.
            a = np.diff(blur(x, first, last)[longest:])
            own = float(a @ a)
            score += float(((a @ step) ** 2 / own / power).mean()) if own > 0 else 0.0
        return score

    best = max(((lag, lag) for lag in range(longest + 1)), key=lambda lags: explained(*lags))
    while True:
        first, last = best
        steps_of = [(-1, 0), (1, 0), (0, -1), (0, 1)]
        near = [(first + a, last + b) for a, b in steps_of if 0 <= first + a <= last + b <= longest]
        found = max(near, key=lambda lags: explained(*lags), default=best)
        if explained(*found) <= explained(*best):
            return best
        best = found


def unknown_past(x: NDArray[np.float64], longest: int) -> int:
    """Return how many readings of an episode may show what came before it: ``longest``, or none if that was no load."""
    return min(longest, len(x) // 2) if begins_loaded(x) else 0


def align(parts: list[Episode], first: int, last: int, longest: int) -> list[Aligned]:
    """Return the parts with the signal blurred over a range of lags, from where their past is known."""
    starts = [unknown_past(x, longest) for x, _y in parts]
    return [(blur(x, first, last), y[at:], np.arange(at, len(x))) for (x, y), at in zip(parts, starts, strict=True)]


def find_lags(
    parts: list[Episode], guess: tuple[int, int], dt: float, fit: Fit, longest: int
) -> tuple[list[Aligned], NDArray[np.int64]]:
    """Return the parts with each reading aligned by itself, and the lags [n] that could be told, in readings.

    All probes of an update are equally late, so that together they show by how much wherever the signal moves.
    """
    dynamics = fit.dynamics
    middle = sum(guess) // 2
    lags = np.arange(2 * guess[1] + 1)
    found, told, place = [], [], 0
    for (x, y), creep in zip(parts, fit.creep, strict=True):
        n = y.shape[1]
        model = dynamics.response(x, dt, creep)
        gain = fit.gains[place : place + n]
        place += n
        rows = np.arange(max(lags[-1], unknown_past(x, longest)), len(x))
        if not len(rows):
            raise DataError(
                f"An episode of the log has {len(x)} readings, no more than twice the delay that would explain it "
                f"({guess[1]} readings); record longer ones, or allow shorter delays."
            )
        shown = model[rows[:, None] - lags]
        # Dynamics that were fitted to misplaced readings call noise what is late.
        noise = min(dynamics.white**2 + dynamics.walk**2, 4 * calm(model, y, int(lags[-1])))
        level = _level(y[rows] - np.outer(model[rows - middle], gain), np.ptp(shown, axis=1), noise)
        rest = y[rows] - level
        # Σ (rest − gain · shown)² for every lag, from its three terms.
        misfit = (rest**2).sum(axis=1)[:, None] - 2 * shown * (rest @ gain)[:, None] + shown**2 * (gain @ gain)
        order = np.argsort(misfit, axis=1)
        best, second = (np.take_along_axis(misfit, order[:, [k]], axis=1)[:, 0] for k in (0, 1))
        sure = second - best > _SURE * noise
        told.append(order[sure, 0])
        found.append((x, y[rows], rows, misfit))
    lags = np.concatenate(told)
    first, last = extent(lags, guess)
    return [(x, y, rows - first - misfit[:, first : last + 1].argmin(axis=1)) for x, y, rows, misfit in found], lags


def extent(lags: NDArray[np.int64], guess: tuple[int, int]) -> tuple[int, int]:
    """Return the smallest and largest lag that occur more often than mistakes do (2 % of the certain ones)."""
    values, counts = np.unique(lags, return_counts=True)
    kept = values[counts > 0.02 * max(len(lags), 1)]
    return (int(kept.min()), int(kept.max())) if len(kept) and len(lags) >= 8 else guess


def calm(model: NDArray[np.float64], y: NDArray[np.float64], longest: int) -> float:
    """Return the noise's variance in the quarter of readings [T, N] that lags of up to ``longest`` move least."""
    rows = np.arange(longest, len(model))
    if len(rows) < 2:
        return np.inf
    moves = np.ptp(model[rows[:, None] - np.arange(longest + 1)], axis=1)
    either = np.maximum(moves[1:], moves[:-1])
    return float(np.mean(np.diff(y[rows], axis=0)[either <= np.quantile(either, 0.25)] ** 2)) / 2


def _level(rest: NDArray, moves: NDArray, noise: float) -> NDArray:
    """Return what drifts slowly under ``rest`` [T, N], told where no lag matters: ``moves`` [T] is how much one can."""
    # Readings at which the lag matters would pull the level towards a wrong lag, so they count little.
    weight = 1 / (1 + moves**2 / noise) ** 2
    window = np.ones(2 * _WINDOW + 1)
    total = np.convolve(weight, window)[_WINDOW:-_WINDOW]
    mixed = np.cumsum(np.pad(weight[:, None] * rest, ((_WINDOW + 1, _WINDOW), (0, 0))), axis=0)
    return (mixed[len(window) :] - mixed[: -len(window)]) / np.maximum(total, 1e-12)[:, None]
