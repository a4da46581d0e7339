"""Where the fit of a plucked whisker begins: the frequency of its swing is looked for over the whole range allowed.

A swing that begins out of step leads least squares to a wrong number of swings, and readings rarer than two in a period
fit several frequencies equally well. Both are local minima of the likelihood over the one parameter that sets the
frequency, so that parameter is scanned before the fit, finely enough that no minimum lies between two points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.fitting.model import FitModel
from brainbench.stimuli.validation import references

Array = NDArray[np.float64]
SWING = ("young_modulus", "density", "arc_length", "base_radius")
"""Parameters that set the frequency of a swing; the first that is free is scanned."""
MOST, WORSE = 5, 4.0
"""Minima from which a fit is begun, of those whose sum of squares is at most so many times the least."""
PER_SWING = 6
"""Points for each swing that is seen: the nearest to a minimum is then out of step by half a radian at most."""
_FEWEST, _MOST_POINTS = 9, 129


def scanned(model: FitModel) -> int | None:
    """Return the index of the parameter whose range is scanned; None when no trial is a ring-down, or it is known."""
    if not any(trial.pluck for trial in model.trials):
        return None
    return next((model.free.names.index(name) for name in SWING if name in model.free.names), None)


def find_starts(model: FitModel) -> list[Array]:
    """Return coordinates [p] at which fits begin: the lowest minima of the scan, or the start values alone."""
    start, index = np.zeros(len(model.free)), scanned(model)
    if index is None:
        return [start]
    points = np.tile(start, (_count(model, index), 1))
    low, high = (float(limit[index]) for limit in model.limits)
    points[:, index] = np.linspace(low, high, len(points) + 2)[1:-1]
    points = np.insert(points, int(np.searchsorted(points[:, index], 0.0)), start, axis=0)
    values = np.array([float(one @ one) for one in model.scan(list(points))])
    values[~np.isfinite(values)] = math.inf
    walled = np.concatenate([[math.inf], values, [math.inf]])
    least = np.flatnonzero((values <= walled[:-2]) & (values <= walled[2:]) & np.isfinite(values))
    least = least[np.argsort(values[least], kind="stable")[:MOST]]
    return [points[place] for place in least if values[place] <= WORSE * values[least[0]]] or [start]


def _count(model: FitModel, index: int) -> int:
    """Return how many points are scanned, evenly in the logarithm of the frequency."""
    unit = np.eye(len(model.free))[index]
    whiskers = [model.free.condition(float(limit[index]) * unit).whisker for limit in model.limits]
    ends = [float(references.natural_frequencies(one, 1)[0]) for one in whiskers]
    duration = max(float(trial.job.times[-1]) for trial in model.trials if trial.pluck)
    # A swing of damping ratio ζ has fallen to e⁻² after 1 / (π ζ) periods.
    swings = min(duration * max(ends), 1 / (math.pi * max(whiskers[0].damping_ratio, 0.01)))
    wanted = math.ceil(PER_SWING * swings * abs(math.log(ends[1] / ends[0]))) + 1
    return min(max(wanted, _FEWEST), _MOST_POINTS)
