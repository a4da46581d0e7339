"""The noise ceiling that a design of synthetic animals has, and the design that has a given one.

Letters: K stimulus, R trial, U unit, P pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.core.trials import Trials
from brainbench.datasets.synthetic.design import MODULATION, PopulationDesign
from brainbench.datasets.synthetic.geometry import ResponseGeometry
from brainbench.datasets.synthetic.populations import draw_animals, entropy
from brainbench.datasets.synthetic.truth import correlation_rdm

_EXACT = 2e-4
"""Largest error of the modulation that calibration leaves, on the studies it draws."""


def measure_ceiling(
    geometry: ResponseGeometry, design: PopulationDesign, *, simulations: int = 50, seed: int | Sequence[int] = 0
) -> tuple[float, float]:
    """Measure the noise ceiling of a design: what the true geometry itself scores.

    That is the mean Pearson correlation between the true RDM and the RDM measured in one animal (correlation distance
    of mean responses, sessions joined). Animals without an RDM, because they lack a stimulus or did not answer one at
    all, are left out. ``simulations`` studies are drawn, each of ``design.animals`` animals. Returns the ceiling and
    its Monte-Carlo standard error; NaN if no animal has all stimuli, an RDM is flat (two stimuli), or there is one
    animal only for the error.
    """
    check_number("simulations", simulations, least=1, whole=True)
    truth, stimuli = geometry.rdm, len(geometry.labels)
    scores: list[float] = []
    for number in range(simulations):
        for sessions in draw_animals(geometry, design, (*entropy(seed), number)).values():
            means = np.concatenate([stimulus_means(block, stimuli) for block in sessions], axis=1)
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


def stimulus_means(block: Trials, stimuli: int) -> NDArray[np.float64]:
    """Return the mean response [K, U] to every stimulus; NaN where there is no trial."""
    # Indicators [K, R]: one product sums the trials of every stimulus.
    member = np.zeros((stimuli, len(block.labels)))
    member[block.labels, np.arange(len(block.labels))] = 1.0
    number = member.sum(axis=1, keepdims=True)
    total = member @ block.responses.mean(axis=1)
    return np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)


def _pearson(one: NDArray[np.float64], two: NDArray[np.float64]) -> float:
    a, b = one - one.mean(), two - two.mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0 else float("nan")
