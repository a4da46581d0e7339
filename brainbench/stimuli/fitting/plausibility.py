"""Whether measured wrenches can be those of a trial at all: their clock, unit and sign, before anything is fitted.

A wrong unit or sign leads least squares to a bound and not to a sentence; a wrong clock makes it simulate for minutes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, listing

if TYPE_CHECKING:
    from brainbench.stimuli.fitting.trials import Trial
    from brainbench.stimuli.motion.jobs import Trace

UNITS = 100.0
"""Size of the wrenches over that at the start, or its inverse, from which the unit is wrong and not the start."""
OPPOSITE = -0.8
"""Correlation with the wrenches at the start from which the sign is wrong."""
RARE = 10.0
"""Periods of the first mode between two readings from which the clock is wrong."""
SHORT = 0.02
"""Share of a period of the first mode that the readings last from which the clock or the whisker is wrong."""
SPENT = 25.0
"""Decay times of the first mode after which nothing is left of a swing: e⁻²⁵."""
MULTIPLE = 1.5
"""Size of the forces (moments) over that of the fitted whisker, or its inverse, from which one of the kinds has another
unit: where they disagree, a fit follows the one and takes the other for noise."""
SURE = 5.0
"""Standard deviations by which such a size is known to differ."""
DEAD = 0.05
"""Share of the largest predicted component of its kind from which one that reads zero throughout is doubtful."""


def check_clock(times: NDArray[np.float64], frequency: float, damping_ratio: float) -> None:
    """Refuse times [n] (s) at which a whisker of this frequency (Hz) cannot be followed as it rings down."""
    gap, period = float(np.median(np.diff(times))), 1 / frequency
    if gap > RARE * period:
        raise DataError(
            f"Readings are {gap:.3g} s apart, and this whisker swings with a period of {period:.3g} s; times are in "
            "seconds: call a column of milliseconds time_ms, or correct the frame rate."
        )
    if times[-1] < SHORT * period:
        raise DataError(
            f"The readings end {times[-1]:.3g} s after the release, and this whisker swings with a period of "
            f"{period:.3g} s; times are in seconds and properties of the whisker in SI units (lengths in m)."
        )
    spent = SPENT / (2 * math.pi * frequency * max(damping_ratio, 0.02))
    if times[0] > spent:
        raise DataError(
            f"The first reading is {times[0]:.3g} s after the release, and nothing is left of the swing after "
            f"{spent:.2g} s; times count from the release: subtract its time, or give --zero-frame."
        )


def check_wrenches(trials: Sequence[Trial], traces: Sequence[Trace]) -> None:
    """Refuse wrenches that are no wrenches of these trials, whose ``traces`` were simulated at the start of a fit."""
    for trial, trace in zip(trials, traces, strict=True):
        for kind, unit, small in (("F", "N", "mN"), ("M", "N·m", "µN·m")):
            measured, expected = _of_kind(trial, trace, kind)
            sizes = [float(np.sqrt(np.mean(part**2))) if part.size else 0.0 for part in (measured, expected)]
            if not min(sizes) > 0:
                continue
            what, ratio = "forces" if kind == "F" else "moments", sizes[0] / sizes[1]
            if not 1 / UNITS < ratio < UNITS:
                raise DataError(
                    f"The measured {what} are {ratio:.2g} times those of the whisker at the start of the fit "
                    f"({sizes[1]:.2g} {unit}); numbers without a unit are in {unit}: name it in the column, as in "
                    f"{kind}y_{small.replace('µ', 'u').replace('·', '')}, or start nearer to the truth."
                )
            alike = float(np.mean(measured * expected)) / (sizes[0] * sizes[1])
            if alike < OPPOSITE:
                raise DataError(
                    f"The measured {what} are the opposite of those of the whisker at the start of the fit "
                    f"(correlation {alike:.2f}); they are the action of the whisker on its base: "
                    "change the sign, or the side to which the whisker was plucked or pushed."
                )


def dead_channels(trials: Sequence[Trial], traces: Sequence[Trace]) -> tuple[str, ...]:
    """Return one sentence where components that read zero throughout, and are left out, should not be zero."""
    doubtful: list[str] = []
    for trial, trace in zip(trials, traces, strict=True):
        if trial.of_shapes:
            continue
        size = np.sqrt(np.mean(trace.wrench**2, axis=0))
        largest = np.repeat([size[:3].max(), size[3:].max()], 3)
        silent = ~np.any(np.nan_to_num(trial.measured["wrench"].values) != 0, axis=0)
        places = [CHANNELS.index(name) for name, zero in zip(trial.channels, silent, strict=True) if zero]
        doubtful += [CHANNELS[place] for place in places if size[place] > DEAD * largest[place]]
    if not doubtful:
        return ()
    return (
        f"{listing(dict.fromkeys(doubtful))} is zero throughout and was left out, although the fitted whisker acts "
        "there: leave out the column if it was not measured.",
    )


def other_sizes(trials: Sequence[Trial], traces: Sequence[Trace]) -> tuple[str, ...]:
    """Return one sentence where forces, or moments, are a multiple of those of the fitted whisker."""
    for trial, trace in zip(trials, traces, strict=True):
        for kind, what in (("F", "forces"), ("M", "moments")):
            measured, expected = _of_kind(trial, trace, kind)
            square = float(expected @ expected)
            if measured.size < 3 or not square > 0:
                continue
            ratio = float(measured @ expected) / square
            spread = float(np.sqrt(np.sum((measured - ratio * expected) ** 2) / (measured.size - 1) / square))
            if not 1 / MULTIPLE < ratio < MULTIPLE and abs(ratio - 1) > SURE * spread:
                return (
                    f"The measured {what} are {ratio:.2g} times those of the fitted whisker: forces and moments do not "
                    "belong together; check their units and about which point moments are taken.",
                )
    return ()


def _of_kind(trial: Trial, trace: Trace, kind: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the measured and the predicted forces (``F``) or moments (``M``) of a trial where both are known."""
    if trial.of_shapes:
        return np.zeros(0), np.zeros(0)
    columns = [place for place, name in enumerate(trial.channels) if name.startswith(kind)]
    measured: Any = trial.measured["wrench"].values[:, columns]
    expected = trace.wrench[:, [CHANNELS.index(trial.channels[place]) for place in columns]]
    known = np.isfinite(measured) & np.isfinite(expected)
    return measured[known], expected[known]
