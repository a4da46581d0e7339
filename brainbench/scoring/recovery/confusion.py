"""Summary of the boards of a recovery: how often the true candidate wins, ties and loses, and a picture of it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from brainbench.core.figures import INK, PALE, check_format, new_figure, save_figure
from brainbench.core.records import Interval
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, wilson_interval
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.scoring.recovery.boards import RecoveryBoard, RecoveryDesign

WANTED = 0.8  # share of boards that the true candidate is to win


@dataclass(frozen=True)
class Recovery:
    """Boards of every candidate, counted."""

    names: tuple[str, ...]
    """[C] candidates."""
    design: RecoveryDesign
    stimuli: int
    """Stimuli of one board."""
    boards: tuple[RecoveryBoard, ...]

    @cached_property
    def firsts(self) -> Ints:
        """[C, C] boards in which the animals were drawn from one candidate (row) and another came first (column)."""
        count = np.zeros((len(self.names),) * 2, dtype=np.int64)
        for board in self.boards:
            if board.first is not None:
                count[board.true, board.first] += 1
        return count

    @cached_property
    def counts(self) -> Ints:
        """[C] boards of each candidate."""
        return np.bincount([board.true for board in self.boards], minlength=len(self.names))

    @cached_property
    def won(self) -> Floats:
        """[C, C] share of the boards of a candidate (row) in which it is told apart above another (column)."""
        return self._share(1)

    @cached_property
    def lost(self) -> Floats:
        """[C, C] share of the boards of a candidate (row) in which another (column) is told apart above it."""
        return self._share(-1)

    def _share(self, sign: int) -> Floats:
        count = np.zeros((len(self.names),) * 2)
        for board in self.boards:
            count[board.true] += np.array(board.verdicts) == sign
        return count / np.maximum(self.counts[:, None], 1)

    def wins(self, candidate: int | None = None) -> Interval:
        """Return Wilson's interval of the share of boards in which the true candidate comes first."""
        firsts = np.diag(self.firsts)
        if candidate is None:
            return wilson_interval(int(firsts.sum()), int(self.counts.sum()), over="boards")
        return wilson_interval(int(firsts[candidate]), int(self.counts[candidate]), over="boards")

    @property
    def win_rate(self) -> float:
        """Share of all boards in which the true candidate comes first."""
        return float(np.diag(self.firsts).sum() / len(self.boards))

    @property
    def outcomes(self) -> dict[str, float]:
        """Shares of pairs (true candidate, another): win, tie and loss by the test of a board."""
        rivals = ~np.eye(len(self.names), dtype=bool)
        win, loss = float(self.won[rivals].mean()), float(self.lost[rivals].mean())
        return {"win": win, "tie": 1 - win - loss, "loss": loss}

    @property
    def reliability(self) -> float:
        """Mean split-half reliability of the animals."""
        values = [board.reliability for board in self.boards if np.isfinite(board.reliability)]
        return float(np.mean(values)) if values else float("nan")

    def answer(self, wanted: float = WANTED) -> str:
        """Say in one sentence whether the design can tell the candidates apart.

        Yes or no where the interval of the win rate lies above or below ``wanted``. Yes also needs that as many$
        of the pairs with the true network are told apart: a tied pair may stand in another order for other stimuli.
        """
        interval = self.wins()
        said = f"the true network comes first in {self.win_rate:.0%} of {len(self.boards)} boards"
        said += f" [{interval.low:.0%}, {interval.high:.0%}]; by chance it would in {1 / len(self.names):.0%}"
        tie = self.outcomes["tie"]
        if interval.low >= wanted and self.outcomes["win"] < wanted:
            return f"Not beyond these stimuli: {said}, but {tie:.0%} of the pairs with it tie."
        if interval.low >= wanted:
            return f"Yes, this design finds the true network: {said}."
        if interval.high < wanted:
            return f"No, not in the {wanted:.0%} of boards that are wanted: {said}."
        return f"Undecided beside the {wanted:.0%} that are wanted, more boards would tell: {said}."

    def hardest(self, count: int = 3) -> list[tuple[str, str, float]]:
        """Return the pairs (true, mistaken for, share of the true one's boards) that are confused most often."""
        share = self.firsts / np.maximum(self.counts[:, None], 1)
        np.fill_diagonal(share, 0)
        order = np.argsort(-share, axis=None, kind="stable")[:count]
        pairs = [np.unravel_index(place, share.shape) for place in order.tolist()]
        return [(self.names[i], self.names[j], float(share[i, j])) for i, j in pairs if share[i, j] > 0]

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for a reader, beside the numbers."""
        notes = []
        if self.design.population.animals < FEWEST_ANIMALS or self.stimuli < FEWEST_STIMULI:
            notes.append(f"All pairs tie: tests need {FEWEST_ANIMALS} animals and {FEWEST_STIMULI} stimuli.")
        undefined = sum(board.first is None for board in self.boards)
        if undefined:
            notes.append(f"{undefined} boards have no score: their animals cannot be compared.")
        return tuple(notes)


FORMATS = (".png", ".svg", ".pdf")


def plot_confusion(recovery: Recovery, path: str | os.PathLike[str]) -> Path:
    """Draw, for every true candidate (row), the share of its boards in which each candidate (column) came first.

    The suffix of the path is the format.
    """
    target = Path(path)
    check_format(target, FORMATS)
    count = len(recovery.names)
    share = recovery.firsts / np.maximum(recovery.counts[:, None], 1)
    size = 260 + 42 * count
    figure = new_figure(size + 160, size)
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    image = axes.imshow(share, cmap="BuGn", vmin=0, vmax=1)
    figure.colorbar(image, ax=axes, label="share of the boards in which it came first", shrink=0.6)
    for row, column in np.argwhere(share > 0).tolist():
        value = share[row, column]
        ink = "white" if value > 0.6 else INK
        axes.text(column, row, f"{value:.0%}", ha="center", va="center", fontsize=7, color=ink)
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
