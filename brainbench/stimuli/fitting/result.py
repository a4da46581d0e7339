"""Result of a fit: estimates with intervals, combinations that the data tell, and whether any of it can be trusted."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.figures.style import COLORS, INK, PALE, panels, save_figure
from brainbench.core.records import Interval, Status
from brainbench.stimuli.fitting.checks import ResidualTest
from brainbench.stimuli.fitting.curves import PER_LINK
from brainbench.stimuli.fitting.parameters import PARAMETERS, Prior
from brainbench.stimuli.fitting.trials import Trial
from brainbench.stimuli.whiskers.chain import build_chain
from brainbench.stimuli.whiskers.whisker import Whisker

Array = NDArray[np.float64]
UNKNOWN = 0.7
"""Standard deviation along a direction, in coordinates (a factor of 2), from which it counts as not identified."""
MEMBER = 0.1
"""Share of the largest component of a direction from which a parameter belongs to it."""


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
        return f"The data cannot tell {_listed(members)} apart: {together} leaves them as they are."
    return f"The combination {together} is known to {_size(members[0], deviation * abs(components[0]))}."


def _size(name: str, deviation: float) -> str:
    return f"{100 * deviation:.2g} %" if PARAMETERS[name].kind == "log" else f"{deviation:.2g} of its scale"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + f" and {names[-1]}"


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
        from brainbench.core.errors import check_name

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


_SHOWN = 6
"""Shapes that are drawn of a trial."""


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
