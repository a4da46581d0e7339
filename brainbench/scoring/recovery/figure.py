"""Picture of a confusion matrix."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from brainbench.core.figures.style import INK, PALE, check_format, new_figure, save_figure
from brainbench.scoring.recovery.confusion import Recovery

FORMATS = (".png", ".svg", ".pdf")


def plot_confusion(recovery: Recovery, path: str | os.PathLike[str]) -> Path:
    """Draw, for every true candidate (row), the share of its boards in which each candidate (column) came first.

    The suffix of the path is the format.

    Raises:
        UsageError: another format.
        MissingDependencyError: matplotlib is not installed (extra ``report``).
    """
    target = Path(path)
    check_format(target, FORMATS)
    count = len(recovery.names)
    share = recovery.firsts / np.maximum(recovery.made[:, None], 1)
    size = 260 + 42 * count
    figure = new_figure(size + 160, size)
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    shown = axes.imshow(share, cmap="BuGn", vmin=0, vmax=1)
    figure.colorbar(shown, ax=axes, label="share of the boards in which it came first", shrink=0.6)
    for row, column in np.argwhere(share > 0).tolist():
        value = share[row, column]
        axes.text(
            column, row, f"{value:.0%}", ha="center", va="center", fontsize=7, color="white" if value > 0.6 else INK
        )
    axes.set_xticks(range(count), recovery.names, rotation=90, fontsize=8, color=INK)
    axes.set_yticks(range(count), recovery.names, fontsize=8, color=INK)
    axes.set_xlabel("network that came first", color=PALE)
    axes.set_ylabel("network that made the data", color=PALE)
    interval = recovery.wins()
    population = recovery.design.population
    axes.set_title(
        f"true network first in {recovery.win_rate:.0%} of {len(recovery.boards)} boards "
        f"[{interval.low:.0%}, {interval.high:.0%}]\n{recovery.stimuli} stimuli, {population.animals} animals of "
        f"{population.units} units",
        fontsize=9,
        color=INK,
    )
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    return save_figure(figure, target, dpi=150)
