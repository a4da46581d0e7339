"""Animals as arrays with their truth, and with the faults of the released analysis of the study.

Letters: K stimulus, R trial, U unit, P pair.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import Trials
from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry
from brainbench.datasets.synthetic.populations import correlation_rdm, draw_sessions


@dataclass(frozen=True)
class SyntheticAnimal:
    """One animal's trials, and the truth about it."""

    subject: str
    sessions: tuple[Trials, ...]
    """Every session: ``responses`` [R, 1, U] Hz, ``labels`` [R], ``keys``."""
    truth: NDArray[np.float64] = field(repr=False)
    """[P] correlation-distance RDM of its units' expected rates, free of noise."""


def simulate(
    geometry: ResponseGeometry,
    design: PopulationDesign | None = None,
    *,
    seed: int | Sequence[int] = 0,
    faults: Sequence[str] = (),
) -> tuple[SyntheticAnimal, ...]:
    """Draw the animals of ``draw_animals`` with their truth; ``faults`` names those of :data:`FAULTS`."""
    animals = []
    for subject, group in groupby(draw_sessions(geometry, design, seed), key=lambda item: item.subject):
        drawn = list(group)
        sessions = [item.trials for item in drawn]
        # The order of the stimuli goes wrong before trials are filled up.
        for name in sorted(faults):
            sessions = [FAULTS[name](trials, len(geometry.labels)) for trials in sessions]
        truth = correlation_rdm(np.concatenate([item.expected for item in drawn], axis=1))
        animals.append(SyntheticAnimal(subject, tuple(sessions), truth))
    return tuple(animals)


def _zero_fill(block: Trials, stimuli: int) -> Trials:
    """Give every trial a response of zero to each stimulus that it did not show."""
    trials, bins, units = block.responses.shape
    # What was not shown counts as a response of zero, as in the released analysis, and pulls all means together.
    filled = np.zeros((trials, stimuli, bins, units))
    filled[np.arange(trials), block.labels] = block.responses
    keys = tuple(f"{key}/{stimulus}" for key in block.keys or () for stimulus in range(stimuli))
    labels = np.tile(np.arange(stimuli), trials)
    return Trials(filled.reshape(trials * stimuli, bins, units), labels, keys)


def _first_appearance(block: Trials, stimuli: int) -> Trials:
    """Renumber the stimuli in the order in which the session shows them."""
    _, first = np.unique(block.labels, return_index=True)
    order = block.labels[np.sort(first)]
    number = np.full(stimuli, -1)
    number[order] = np.arange(len(order))
    return replace(block, labels=number[block.labels])


FAULTS: dict[str, Callable[[Trials, int], Trials]] = {"first-appearance": _first_appearance, "zero-fill": _zero_fill}
"""Faults of the released analysis, as functions of a session and the number of stimuli: stimuli
numbered by first appearance (so that sessions and animals disagree about the axes), and zeros in
place of what a trial did not show."""
