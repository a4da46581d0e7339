"""Result of a fit: estimates with intervals, combinations that the data tell, and whether any of it can be trusted."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, check_name, listing
from brainbench.core.figures import COLORS, INK, PALE, panels, save_figure
from brainbench.core.records import Interval, Status
from brainbench.stimuli.fitting.contacts import PER_LINK
from brainbench.stimuli.fitting.model import Readings
from brainbench.stimuli.fitting.parameters import PARAMETERS, Prior
from brainbench.stimuli.fitting.trials import Trial
from brainbench.stimuli.motion.jobs import Trace
from brainbench.stimuli.whiskers.whisker import Whisker, build_chain

if TYPE_CHECKING:
    from scipy.sparse import coo_array

UNITS = 100.0
"""Size of the wrenches over that at the start, or its inverse, from which the unit is wrong and not the start."""
OPPOSITE = -0.8  # correlation with the wrenches at the start from which the sign is wrong
MULTIPLE = 1.5
"""Size of the forces (moments) over that of the fitted whisker, or its inverse, from which one of the kinds has another
unit: where they disagree, a fit follows the one and takes the other for noise."""
SURE = 5.0  # standard deviations by which such a size is known to differ
DEAD = 0.05
"""Share of the largest predicted component of its kind from which one that reads zero throughout is doubtful."""


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
    finite = np.isfinite(measured) & np.isfinite(expected)
    return measured[finite], expected[finite]


Array = NDArray[np.float64]
LAGS = 3  # places up to which readings are neighbours
SWING_LAGS = 4  # places up to which residuals that swing are looked for
ALPHA = 0.01  # chance that noise alone fails any of the tests of a fit
FEWEST = 20  # pairs from which an ordering is tested


@dataclass(frozen=True)
class ResidualTest:
    """One test of the residuals."""

    what: str
    """``time``, ``arc`` (serial correlation over time, along the whisker), ``swing`` (of any sign, over time) or
    ``size`` (against repeat noise)."""
    statistic: float
    """Deviation from what noise alone gives, in standard deviations."""
    p: float
    """Chance of a larger one under noise alone."""
    readings: int
    passed: bool


# A model that is wrong leaves residuals whose neighbours agree. The statistic of an ordering is S = Σ rᵢ rⱼ over pairs
# of readings at most three places apart. After a fit the residuals are (1 − Q Qᵀ) ε, with an orthonormal basis Q [m, p]
# of the Jacobian's columns, so mean and variance of S = rᵀ W r under white noise are known exactly (Durbin & Watson
# 1950, Biometrika 37, 409-428, for the lag of one):
#
#     E S = −σ² tr(QᵀWQ),   var S = 2 σ⁴ (tr W² − 2 tr(QᵀW²Q) + tr((QᵀWQ)²))
#
# The test is one-sided: agreement counts, and a normal law is taken for S. Residuals that swing have no sum S where
# eight readings make a swing, and a negative one below. So the squares of the deviates of single lags over time are
# also added up, as by Ljung & Box (1978, Biometrika 65, 297-303), and compared with the chi-square law.
def check_residuals(residual: Array, jacobian: Array, readings: Readings) -> tuple[ResidualTest, ...]:
    """Return the tests of whitened residuals [m] with their Jacobian [m, p]; each at its share of :data:`ALPHA`."""
    from scipy.special import chdtrc, ndtr

    # Residuals of a fit lie across the columns of the Jacobian; what is left of white noise there is correlated.
    basis, _ = np.linalg.qr(jacobian)
    free = len(residual) - jacobian.shape[1]
    variance = float(residual @ residual) / free
    results: list[tuple[str, float, float, int]] = []
    for what, column in (("time", 0), ("arc", 1)):
        weights = _neighbours(readings, column, range(1, LAGS + 1))
        pairs = weights.nnz // 2
        if pairs >= FEWEST:
            z = _deviate(residual, basis, weights, variance)
            results.append((what, z, float(ndtr(-z)), pairs))
    lags = [_neighbours(readings, 0, [lag]) for lag in range(1, SWING_LAGS + 1)]
    if min(one.nnz // 2 for one in lags) >= FEWEST:
        square = sum(_deviate(residual, basis, one, variance) ** 2 for one in lags)
        p = float(chdtrc(SWING_LAGS, square))
        results.append(("swing", (square - SWING_LAGS) / math.sqrt(2 * SWING_LAGS), p, len(residual)))
    stated = np.isfinite(readings.noise[readings.group])
    if stated.sum() > jacobian.shape[1] + 1:
        # Sum of squares over repeat noise is chi-square with n − p degrees of freedom.
        degrees = int(stated.sum()) - jacobian.shape[1]
        size = float(np.sum(residual[stated] ** 2))
        p = float(chdtrc(degrees, size))
        results.append(("size", (size - degrees) / math.sqrt(2 * degrees), p, int(stated.sum())))
    level = ALPHA / max(len(results), 1)
    return tuple(ResidualTest(what, z, p, count, p >= level) for what, z, p, count in results)


def _deviate(residual: Array, basis: Array, weights: coo_array, variance: float) -> float:
    moved = weights @ basis
    inner = basis.T @ moved
    mean = -variance * float(np.trace(inner))
    spread = float(weights.power(2).sum()) - 2 * float(np.sum(moved**2)) + float(np.sum(inner * inner.T))
    return (float(residual @ (weights @ residual)) - mean) / max(variance * math.sqrt(2 * max(spread, 0.0)), 1e-300)


def _neighbours(readings: Readings, column: int, lags: Sequence[int]) -> coo_array:
    """Return W [m, m], ½ where two readings differ by one of some lags in one place and agree in all else."""
    from scipy.sparse import coo_array

    count = len(readings)
    fixed = [readings.trial, *(readings.place[:, other] for other in range(3) if other != column)]
    # Sorted, readings of one series stand together in order of the place.
    order = np.lexsort((readings.place[:, column], *fixed[::-1]))
    rows: list[NDArray[np.int_]] = []
    columns: list[NDArray[np.int_]] = []
    for lag in lags:
        first, second = order[:-lag], order[lag:]
        near = readings.place[second, column] - readings.place[first, column] == lag
        for values in fixed:
            near &= values[first] == values[second]
        rows += [first[near], second[near]]
        columns += [second[near], first[near]]
    row, col = np.concatenate(rows), np.concatenate(columns)
    return coo_array((np.full(len(row), 0.5), (row, col)), shape=(count, count))


def failed_words(tests: Sequence[ResidualTest]) -> tuple[str, ...]:
    """Return one sentence for each test that failed."""
    faults = {
        "time": "neighbouring instants leave residuals of the same sign",
        "arc": "neighbouring points along the whisker leave residuals of the same sign",
        "swing": "the residuals swing",
        "size": "the residuals are larger than the noise of repeats",
    }
    return tuple(
        f"The model does not fit: {faults[test.what]} ({test.statistic:.1f} standard deviations beyond noise, "
        f"p = {test.p:.2g}); the shape, the motion or the contact that was assumed is wrong, or the noise is not white."
        for test in tests
        if not test.passed
    )


UNKNOWN = 0.7
"""Standard deviation along a direction, in coordinates (a factor of 2), from which it counts as not identified."""
MEMBER = 0.1  # share of the largest component of a direction from which a parameter belongs to it


# With whitened residuals of Jacobian J [m, p] the Fisher information is JᵀJ (Seber & Wild 2003, Nonlinear Regression,
# chapter 2). A direction v with singular value s is known with a standard deviation of 1/s: along it, coordinates may
# change by that much without the data noticing.
@dataclass(frozen=True, eq=False)
class Direction:
    """A combination of parameters that the data tell to a known precision."""

    deviation: float
    """Standard deviation along it, in coordinates: relative for positive parameters; inf when nothing is known."""
    members: tuple[str, ...]
    """Parameters that take part, the most first."""
    components: tuple[float, ...]
    """Their components, the largest 1 or −1."""
    identified: bool
    words: str
    """What it means."""


def directions(jacobian: Array, names: Sequence[str], noise: float = 1.0) -> tuple[Direction, ...]:
    """Return the singular directions of a whitened Jacobian [m, p], the worst known first.

    ``noise`` multiplies the standard deviations: the residuals' own, where whitening took another.
    """
    _, singular, rows = np.linalg.svd(np.nan_to_num(jacobian), full_matrices=False)
    least = singular.max(initial=0.0) * 1e-10
    combinations = []
    for value, row in zip(singular[::-1], rows[::-1], strict=True):
        deviation = noise / value if value > max(least, 1e-300) else math.inf
        combinations.append(_direction(deviation, row, names))
    return tuple(combinations)


def _direction(deviation: float, row: Array, names: Sequence[str]) -> Direction:
    order = np.argsort(-np.abs(row))
    order = order[np.abs(row[order]) > MEMBER * np.abs(row).max()]
    components = row[order] / row[order[0]]
    members = tuple(names[int(index)] for index in order)
    identified = deviation < UNKNOWN
    return Direction(deviation, members, tuple(components.tolist()), identified, _words(deviation, members, components))


def _words(deviation: float, members: Sequence[str], components: Array) -> str:
    identified = deviation < UNKNOWN
    if len(members) == 1:
        if not identified:
            return f"The data hardly depend on {members[0]}."
        return f"{members[0]} is known to {_size(members[0], deviation)}."
    # An example that one can check: the first parameter grows by a tenth, or by one unit of its scale.
    ratio = math.log(1.1) if PARAMETERS[members[0]].kind == "log" else 1.0
    changes = [
        f"{name} × {math.exp(ratio * share):.3g}"
        if PARAMETERS[name].kind == "log"
        else f"{name} {ratio * share:+.2g} of its scale"
        for name, share in zip(members, components, strict=True)
    ]
    together = ", ".join(changes[:-1]) + f" together with {changes[-1]}"
    if not identified:
        listed = ", ".join(members[:-1])
        return f"The data cannot tell {listed} and {members[-1]} apart: {together} leaves them as they are."
    return f"The combination {together} is known to {_size(members[0], deviation * abs(components[0]))}."


def _size(name: str, deviation: float) -> str:
    return f"{100 * deviation:.2g} %" if PARAMETERS[name].kind == "log" else f"{deviation:.2g} of its scale"


def unknown_parameters(combinations: Sequence[Direction]) -> dict[str, Direction]:
    """Return the parameters that take part in a direction that is not identified, each with the worst such one."""
    worst: dict[str, Direction] = {}
    for direction in combinations:
        if not direction.identified:
            for name, share in zip(direction.members, direction.components, strict=True):
                norm = math.sqrt(sum(one**2 for one in direction.components))
                if not math.isfinite(direction.deviation) or abs(share) / norm * direction.deviation > UNKNOWN / 2:
                    worst.setdefault(name, direction)
    return worst


@dataclass(frozen=True)
class FittedParameter:
    """One fitted parameter."""

    name: str
    unit: str
    value: float
    start: float
    """Value that the fit began with."""
    relative_deviation: float
    """Standard deviation of its coordinate by noise: relative for positive parameters; inf when the data do not tell
    it."""
    relative_error: float
    """Standard deviation of its coordinate by links and steps: how far finer simulations move the estimate."""
    laplace: Interval
    """From the curvature of the likelihood at the best fit, and the error of the simulation."""
    profile: Interval | None = None
    """Where the likelihood, maximised over the other parameters, falls, and the error of the simulation; None when it
    was not asked for."""
    prior: Prior | None = None
    status: Status = "ok"
    """``undefined``: the data do not tell this parameter; ``unreliable``: at a bound, known by its prior only, or
    far from any whisker."""
    reason: str = ""

    @property
    def interval(self) -> Interval:
        """The profile interval, or Laplace's without one."""
        return self.profile or self.laplace


@dataclass(frozen=True, eq=False)
class FitResult:
    """Everything that a fit found."""

    status: Status
    """``ok``; ``unreliable``: the model does not fit, or a parameter is at a bound, known by its prior only or far
    from any whisker;
    ``undefined``: it did not converge, or a parameter cannot be told."""
    reasons: tuple[str, ...]
    """One sentence for each thing that is wrong."""
    estimates: tuple[FittedParameter, ...]
    noise: Mapping[str, float]
    """Standard deviation of a reading of each kind (N, N·m, m)."""
    directions: tuple[Direction, ...]
    """Combinations of parameters, the worst known first."""
    tests: tuple[ResidualTest, ...]
    whisker: Whisker
    """The fitted whisker."""
    residuals: tuple[NDArray[np.float64], ...]
    """Predicted minus measured of each trial: [n, c] (N, N·m) or [n, k, d] (m); NaN where nothing was measured."""
    predicted: tuple[NDArray[np.float64], ...]
    """Prediction of each trial: wrenches [n, c] (N, N·m) or joints and tip [n, N + 1, 3] (m)."""
    covariance: NDArray[np.float64]
    """[p, p] of the coordinates of the parameters."""
    iterations: int = 0
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """How derivatives were computed, with what simulation, how often, versions and machine."""

    def __getitem__(self, name: str) -> FittedParameter:
        """Return the estimate of a parameter."""
        by_name = {one.name: one for one in self.estimates}
        check_name("fitted parameter", name, by_name)
        return by_name[name]

    def summary(self) -> dict[str, Any]:
        """Return everything but the arrays, for JSON."""
        return {
            "status": self.status,
            "reasons": list(self.reasons),
            "estimates": [vars(one) for one in self.estimates],
            "noise": dict(self.noise),
            "directions": [
                {"words": direction.words, "deviation": direction.deviation, "identified": direction.identified}
                for direction in self.directions
            ],
            "residual_tests": [vars(one) for one in self.tests],
            "whisker": self.whisker,
            "iterations": self.iterations,
            "provenance": dict(self.provenance),
        }


_SHOWN = 6  # shapes that are drawn of a trial


def draw_fit(trial: Trial, result: FitResult, path: str | os.PathLike[str]) -> Path:
    """Draw measured and predicted values of the first trial above, and residuals in standard deviations below."""
    figure, axes = panels(2, 2 if trial.of_shapes else 1, (9.5, 6.2))
    if trial.of_shapes:
        _draw_shapes(axes, trial, result)
    else:
        _draw_wrenches(axes[:, 0], trial, result)
    words = ", ".join(f"{one.name} {one.value:.3g} {one.unit}".strip() for one in result.estimates)
    figure.suptitle(f"{words}  ({result.status})", fontsize=10, color=INK)
    return save_figure(figure, Path(path), dpi=150)


def _draw_wrenches(axes: Any, trial: Trial, result: FitResult) -> None:
    """Draw the channels that were measured, each over its largest value."""
    times = 1e3 * trial.job.times
    values, predicted = trial.measured["wrench"].values, result.predicted[0]
    for column, name in enumerate(trial.channels):
        if not np.nan_to_num(values[:, column]).any():
            continue
        size = float(np.nanmax(np.abs(values[:, column])))
        unit = f"{1e6 * size:.3g} µN" if name.startswith("F") else f"{1e9 * size:.3g} nN·m"
        colour = COLORS[column % len(COLORS)]
        axes[0].plot(times, values[:, column] / size, ".", ms=3.5, color=colour, alpha=0.6, label=f"{name} / {unit}")
        axes[0].plot(times, predicted[:, column] / size, color=colour, lw=1.1)
        axes[1].plot(times, result.residuals[0][:, column] / result.noise[name], ".", ms=3.5, color=colour)
    axes[0].set(ylabel="measured (dots) and fitted", xlabel="time (ms)")
    axes[0].legend(frameon=False, fontsize=8.5, ncol=3)
    _noise_band(axes[1], "time (ms)")


def _draw_shapes(axes: Any, trial: Trial, result: FitResult) -> None:
    """Draw some shapes, residuals over time and along the whisker, and their distribution."""
    from scipy.interpolate import CubicSpline

    points, joints = 1e3 * trial.measured["shape"].values, 1e3 * result.predicted[0]
    nodes = build_chain(result.whisker, joints.shape[1] - 1).nodes
    s = np.linspace(0, nodes[-1], PER_LINK * joints.shape[1])
    picked = np.unique(np.linspace(0, len(points) - 1, _SHOWN).round().astype(int))
    for number, frame in enumerate(picked):
        colour, curve = COLORS[number % len(COLORS)], CubicSpline(nodes, joints[frame])(s)
        axes[0, 0].plot(points[frame, :, 0], points[frame, :, 1], ".", ms=3.5, color=colour, alpha=0.7)
        axes[0, 0].plot(curve[:, 0], curve[:, 1], color=colour, lw=1, label=f"{1e3 * trial.job.times[frame]:.1f} ms")
    axes[0, 0].set(xlabel="x (mm)", ylabel="y (mm)", title="traced (dots) and fitted shapes")
    axes[0, 0].legend(frameon=False, fontsize=8)
    scaled = result.residuals[0] / result.noise["shape"]
    finite = scaled[np.isfinite(scaled)]
    axes[0, 1].hist(finite, bins=40, density=True, color=COLORS[0], alpha=0.5)
    x = np.linspace(-4, 4, 200)
    axes[0, 1].plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=INK, lw=1)
    axes[0, 1].set(xlabel="residual / noise", title=f"noise {1e6 * result.noise['shape']:.1f} µm; line: normal law")
    times = np.broadcast_to(1e3 * trial.job.times[:, None, None], scaled.shape)
    arcs = np.broadcast_to(np.arange(scaled.shape[1])[None, :, None], scaled.shape)
    axes[1, 0].plot(times.ravel(), scaled.ravel(), ".", ms=2, color=COLORS[0], alpha=0.4)
    axes[1, 1].plot(arcs.ravel(), scaled.ravel(), ".", ms=2, color=COLORS[0], alpha=0.4)
    _noise_band(axes[1, 0], "time (ms)")
    _noise_band(axes[1, 1], "traced point, from the base")


def _noise_band(axes: Any, label: str) -> None:
    axes.axhspan(-2, 2, color=PALE, alpha=0.15, lw=0)
    axes.axhline(0, color=PALE, lw=0.8)
    axes.set(xlabel=label, ylabel="residual / noise")
