"""Populations of synthetic neurons: tuning from features or a geometry, trials, and spike counts around expected rates.

Every unit has a mean rate b (log-normal over units) and Gaussian weights w on the axes of a geometry
(:class:`ResponseGeometry`). Its expected rate for stimulus k is b · max(0, 1 + m (√(1−ι) x_k·w + √ι y_k·w′)): x_k is
the shared direction of the stimulus, y_k the animal's own random one, m the ``modulation``, ι the ``individual`` share.
Each animal multiplies the axes by its own log-normal ``emphasis``. Squared Euclidean distances over many units are then
proportional to those between directions; rectification touches less than 0.7 % of the rates at the largest modulation.

Counts are Poisson around that rate, times a gamma gain per unit and trial (``dispersion`` φ: variance =
mean + φ mean², the negative binomial), times one gain common to all units of a trial (``shared_gain``).

Letters: K stimulus, F feature, R trial, U unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.core.trials import Trials
from brainbench.datasets.synthetic.design import PopulationDesign
from brainbench.datasets.synthetic.geometry import ResponseGeometry


@dataclass(frozen=True)
class DrawnSession:
    """One session as drawn: counts around expected rates."""

    subject: str
    session: str
    stream: tuple[int, ...]
    """Seed of this session's random numbers."""
    counts: NDArray[np.int64]
    """[R, U] spikes in the window."""
    labels: NDArray[np.int64]
    """[R] stimulus of each trial."""
    expected: NDArray[np.float64]
    """[K, U] expected rate, Hz."""
    window: float
    """Duration in which spikes are counted, s."""

    @property
    def trials(self) -> Trials:
        """Firing rates [R, 1, U] in Hz, with their labels and keys."""
        keys = tuple(f"{self.subject}/{self.session}/{row}" for row in range(len(self.labels)))
        return Trials(self.counts[:, None] / self.window, self.labels, keys)


def draw_animals(
    features: ArrayLike | ResponseGeometry, design: PopulationDesign | None = None, seed: int | Sequence[int] = 0
) -> dict[str, tuple[Trials, ...]]:
    """Draw animals whose units mix features linearly, such as the activations of a network.

    Every animal and session has its own random stream, so the first animals of a larger design are those of a smaller
    one. Features [K, F] are each standardised over stimuli (:meth:`ResponseGeometry.from_activations`). The seed is one
    integer, or several (such as study and simulation). Returns subject → its sessions: ``responses`` [R, 1, U] Hz,
    ``labels`` [R], ``keys``.
    """
    geometry = features if isinstance(features, ResponseGeometry) else ResponseGeometry.from_activations(features)
    animals: dict[str, tuple[Trials, ...]] = {}
    for drawn in draw_sessions(geometry, design, seed):
        animals[drawn.subject] = (*animals.get(drawn.subject, ()), drawn.trials)
    return animals


def draw_sessions(
    geometry: ResponseGeometry, design: PopulationDesign | None, seed: int | Sequence[int]
) -> Iterator[DrawnSession]:
    """Draw the sessions of every animal; each is a pure function of geometry, design, seed, animal and session."""
    design = design or PopulationDesign()
    for animal in range(design.animals):
        for session in range(design.sessions):
            yield _draw_session(geometry, design, animal, session, entropy(seed))


def _draw_session(
    geometry: ResponseGeometry, design: PopulationDesign, animal: int, session: int, seed: tuple[int, ...]
) -> DrawnSession:
    stimuli = len(geometry.labels)
    absent = [which for owner, which in design.missing if owner == animal]
    if any(not 0 <= which < stimuli for which in absent):
        raise UsageError(f"Missing stimuli are numbered 0 to {stimuli - 1}; received {absent} for animal {animal}.")
    # One stream for each animal and each session: a larger design begins with the animals of a smaller one.
    own = np.random.default_rng([*seed, animal])
    random = np.random.default_rng([*seed, animal, session])
    expected = expected_rates(geometry, design, own, random)
    labels = _labels(design, stimuli, absent, random)
    counts = draw_counts(random, design, expected[labels], design.window)
    names = {"subject": f"synthetic{animal + 1:02d}", "session": f"{session + 1:02d}"}
    drawn = {"counts": counts, "labels": labels, "expected": expected}
    return DrawnSession(**names, **drawn, stream=(*seed, animal, session), window=design.window)


def expected_rates(
    geometry: ResponseGeometry, design: PopulationDesign, own: np.random.Generator, random: np.random.Generator
) -> NDArray[np.float64]:
    """Draw units and return their expected rates [K, U], Hz.

    ``own`` is the random stream of the animal, fresh: all of its sessions draw the same differences from it; ``random``
    is that of the session.
    """
    stimuli = len(geometry.labels)
    # Log-normal weights of the axes; their mean square is one, so that the depth of tuning does not depend on them.
    weight = np.exp(design.emphasis * own.standard_normal(geometry.directions.shape[1]))
    axes = geometry.directions * weight
    axes *= np.sqrt(np.sum(geometry.directions**2) / np.sum(axes**2))
    # Variances add up to one: 1 − ι of the shared geometry and ι of the animal's own.
    tuning = np.sqrt(1 - design.individual) * _project(axes, design.units, random)
    if design.individual:
        private = own.standard_normal((stimuli, stimuli + 1))
        # Length one, the root mean square length of the shared axes: before ι weighs them both parts have variance one.
        private /= np.linalg.norm(private, axis=1, keepdims=True)
        tuning += np.sqrt(design.individual) * _project(private, design.units, random)
    # Log-normal over units with the mean rate kept, since E exp(σz − σ²/2) = 1.
    mean = design.rate * np.exp(design.spread * random.standard_normal(design.units) - design.spread**2 / 2)
    mean *= np.exp(design.session_gain * random.standard_normal())
    # Rectified-linear rates b max(0, 1 + m w·x): their covariance over units follows the cosines of the geometry.
    return mean * np.maximum(0.0, 1.0 + design.modulation * tuning)


def draw_counts(
    random: np.random.Generator,
    design: PopulationDesign,
    rates: NDArray[np.float64],
    window: float | NDArray[np.float64],
) -> NDArray[np.int64]:
    """Draw spike counts [R, U] around expected rates [R, U] (Hz) in windows of one length or one each [R, 1], s."""
    # Drift is linear from the first trial to the last, with a mean of one.
    gain = np.linspace(1 - design.drift / 2, 1 + design.drift / 2, len(rates))[:, None]
    if design.shared_gain:
        # A gamma with shape 1/σ² and scale σ² has mean one and standard deviation σ.
        shape = design.shared_gain**-2
        gain = gain * random.gamma(shape, 1 / shape, (len(rates), 1))
    rates = rates * gain
    if design.dispersion:
        # A Poisson count with a gamma rate is negative binomial: variance = mean + φ mean².
        rates *= random.gamma(1 / design.dispersion, design.dispersion, rates.shape)
    return random.poisson(rates * window)


def _project(directions: NDArray[np.float64], units: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return the tuning [K, U] of units with random preferred directions: normal, covariance over units = cosines."""
    return directions @ random.standard_normal((directions.shape[1], units))


def _labels(
    design: PopulationDesign, stimuli: int, absent: list[int], random: np.random.Generator
) -> NDArray[np.int64]:
    fewest, most = design.trial_range
    number = random.integers(fewest, most + 1, size=stimuli)
    number[absent] = 0
    labels = np.repeat(np.arange(stimuli), number)
    random.shuffle(labels)
    return labels


def entropy(seed: int | Sequence[int]) -> tuple[int, ...]:
    """Return a seed as the beginning of a list of integers; one that is none of 0 or more is a UsageError."""
    several: tuple[Any, ...] = tuple(seed) if isinstance(seed, (tuple, list)) else (seed,)
    for number in several:
        check_number("A seed", number, least=0, whole=True)
    return several
