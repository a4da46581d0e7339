"""Animals as arrays with their truth: the instrument by which statistics are validated.

:func:`simulate` draws animals and may repeat the faults of the released analysis; :func:`measure_ceiling` and
:func:`calibrate` relate a design to the noise ceiling that it has. Letters: K stimulus, R trial, U unit, P pair.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_each
from brainbench.core.reading.ranges import check_number
from brainbench.core.trials import Trials
from brainbench.datasets.synthetic.design import MODULATION, PopulationDesign
from brainbench.datasets.synthetic.geometry import ResponseGeometry
from brainbench.datasets.synthetic.populations import draw_sessions, entropy, stimulus_means
from brainbench.datasets.synthetic.truth import correlation_rdm

_EXACT = 2e-4
"""Largest error of the modulation that calibration leaves, on the studies it draws."""


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
    """Draw animals that share a geometry.

    Every animal and session has its own random stream, so the first animals of a larger design are those of a smaller
    one. The seed is one integer, or several (such as study and simulation). ``faults`` names those of :data:`FAULTS`,
    to show what they cost.

    Raises:
        UsageError: an unknown fault, or a missing stimulus that does not exist.
    """
    check_each("fault", faults, FAULTS)
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


def measure_ceiling(
    geometry: ResponseGeometry, design: PopulationDesign, *, simulations: int = 50, seed: int | Sequence[int] = 0
) -> tuple[float, float]:
    """Measure the noise ceiling of a design: what the true geometry itself scores.

    That is the mean Pearson correlation between the true RDM and the RDM measured in one animal (correlation distance
    of mean responses, sessions joined). Animals without an RDM, because they lack a stimulus or did not answer one at
    all, are left out. ``simulations`` studies are drawn, each of ``design.animals`` animals. Returns the ceiling and
    its Monte-Carlo standard error; NaN if no animal has all stimuli, an RDM is flat (two stimuli), or there is one
    animal only for the error.

    Raises:
        UsageError: no positive number of simulations.
    """
    check_number("simulations", simulations, least=1, whole=True)
    truth, stimuli = geometry.rdm, len(geometry.labels)
    scores: list[float] = []
    for number in range(simulations):
        for animal in simulate(geometry, design, seed=(*entropy(seed), number)):
            means = np.concatenate([stimulus_means(block, stimuli) for block in animal.sessions], axis=1)
            scores.append(_pearson(correlation_rdm(means), truth))
    known = np.array([score for score in scores if np.isfinite(score)])
    if not len(known):
        return float("nan"), float("nan")
    # Animals are drawn independently around a fixed geometry, so their comparisons have a standard error.
    error = known.std(ddof=1) / np.sqrt(len(known)) if len(known) > 1 else np.nan
    return float(known.mean()), float(error)


def calibrate(
    geometry: ResponseGeometry,
    design: PopulationDesign,
    *,
    ceiling: float,
    simulations: int = 50,
    seed: int | Sequence[int] = 0,
) -> PopulationDesign:
    """Return the design with the modulation at which it has a given noise ceiling.

    Found by Brent's method with common random numbers: the same animals are drawn at every step. ``ceiling`` is the
    wanted value of :func:`measure_ceiling`; the result is as exact as the Monte-Carlo error of so many ``simulations``.

    Raises:
        UsageError: even the largest modulation stays below the ceiling; what is reached is said.
    """

    from scipy.optimize import root_scalar

    check_number("ceiling", ceiling, above=0, most=1)

    def excess(modulation: float) -> float:
        """Return by how much the ceiling at a modulation exceeds the wanted one."""
        tried = replace(design, modulation=modulation)
        return measure_ceiling(geometry, tried, simulations=simulations, seed=seed)[0] - ceiling

    highest = excess(MODULATION)
    if not highest >= 0:
        raise UsageError(
            f"A noise ceiling of {ceiling:g} is out of reach: this design has up to {highest + ceiling:.3f}. "
            f"More units or trials, a higher rate, less dispersion or a smaller individual share raise it."
        )
    # Both ends are known: without modulation the expected comparison is zero.
    known = {0.0: -ceiling, MODULATION: highest}
    # With the same seed at every step the ceiling depends on the modulation alone, as a root finder needs.
    found = root_scalar(
        lambda modulation: known.get(modulation) or excess(modulation), bracket=(0.0, MODULATION), xtol=_EXACT
    )
    return replace(design, modulation=float(found.root))


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


def _pearson(one: NDArray[np.float64], two: NDArray[np.float64]) -> float:
    a, b = one - one.mean(), two - two.mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0 else float("nan")
