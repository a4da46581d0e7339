"""Picture of a fit: what was measured and predicted, and the residuals over their noise."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.core.figures.style import COLORS, INK, PALE, panels, save_figure
from brainbench.stimuli.fitting.curves import PER_LINK
from brainbench.stimuli.fitting.result import FitResult
from brainbench.stimuli.fitting.trials import Trial
from brainbench.stimuli.whiskers.chain import build_chain

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
