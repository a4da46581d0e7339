"""Draw one synthetic session: expected rates from a geometry, trials, and spike counts around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError
from brainbench.core.trials import Trials
from brainbench.datasets.synthetic.geometry import ResponseGeometry

MODULATION = 0.4
"""Largest modulation: beyond it too many rates would be cut off at zero for the truth to hold."""


@dataclass(frozen=True)
class Design:
    """What is recorded, and how noisy it is."""

    animals: int = 11
    sessions: int = 1
    """Sessions per animal; each has its own units."""
    units: int = 40
    """Units per session."""
    trials: int = 20
    """Trials of each stimulus in a session."""
    rate: float = 8.0
    """Mean rate of a unit, Hz."""
    window: float = 1.0
    """Duration in which spikes are counted, s."""
    modulation: float = 0.3
    """Standard deviation of a unit's rate over stimuli, as a share of its mean; 0 is the null."""
    individual: float = 0.0
    """Share of the tuning variance that is an animal's own and not the shared geometry."""
    spread: float = 0.4
    """Standard deviation of the logarithm of mean rates over units."""
    dispersion: float = 0.0
    """φ of the negative binomial: variance = mean + φ mean² per unit and trial; 0 is Poisson."""
    shared_gain: float = 0.0
    """Standard deviation of a gain (mean one) that all units of a trial share."""
    session_gain: float = 0.0
    """Standard deviation of the logarithm of each session's overall rate."""
    drift: float = 0.0
    """Relative change of all rates from the first trial of a session to the last, above −1."""
    imbalance: float = 0.0
    """Standard deviation of the logarithm of trial numbers over stimuli; 0 is balanced."""
    missing: tuple[tuple[int, int], ...] = ()
    """Pairs (animal, stimulus) without any trial."""

    def __post_init__(self) -> None:
        for name in ("animals", "sessions", "units", "trials"):
            if getattr(self, name) < 1:
                raise UsageError(f"A design needs at least one of {name}; received {getattr(self, name)}.")
        for name in ("rate", "window"):
            if not getattr(self, name) > 0:
                raise UsageError(f"The {name} of a design is positive; received {getattr(self, name)}.")
        for name in ("spread", "dispersion", "shared_gain", "session_gain", "imbalance"):
            if not getattr(self, name) >= 0:
                raise UsageError(f"The {name} of a design is not negative; received {getattr(self, name)}.")
        if not 0 <= self.modulation <= MODULATION:
            raise UsageError(f"The modulation lies between 0 and {MODULATION}; received {self.modulation}.")
        if not 0 <= self.individual <= 1 or not self.drift > -1:
            raise UsageError(
                f"individual lies between 0 and 1 and drift above -1; received {self.individual} and {self.drift}."
            )


@dataclass(frozen=True)
class DrawnSession:
    """One session as drawn."""

    counts: NDArray[np.int64]
    """[R, U] spikes in the window."""
    labels: NDArray[np.int64]
    """[R] stimulus of each trial."""
    expected: NDArray[np.float64]
    """[K, U] expected rate, Hz."""
    block: Trials


def draw_session(
    geometry: ResponseGeometry, design: Design, animal: int, session: int, seed: int | Sequence[int]
) -> DrawnSession:
    """Draw one session's trials and counts; a pure function of its arguments."""
    stimuli = len(geometry.labels)
    absent = [which for owner, which in design.missing if owner == animal]
    if any(not 0 <= which < stimuli for which in absent):
        raise UsageError(f"Missing stimuli are numbered 0 to {stimuli - 1}; received {absent} for animal {animal}.")
    own = np.random.default_rng([*entropy(seed), animal])
    random = np.random.default_rng([*entropy(seed), animal, session])
    tuning = np.sqrt(1 - design.individual) * _project(geometry.directions, design.units, random)
    if design.individual:
        private = own.standard_normal((stimuli, stimuli + 1))
        private /= np.linalg.norm(private, axis=1, keepdims=True)
        tuning += np.sqrt(design.individual) * _project(private, design.units, random)
    mean = design.rate * np.exp(design.spread * random.standard_normal(design.units) - design.spread**2 / 2)
    mean *= np.exp(design.session_gain * random.standard_normal())
    expected = mean * np.maximum(0.0, 1.0 + design.modulation * tuning)
    labels = _labels(design, stimuli, absent, random)
    gain = np.linspace(1 - design.drift / 2, 1 + design.drift / 2, len(labels))[:, None]
    if design.shared_gain:
        shape = design.shared_gain**-2
        gain = gain * random.gamma(shape, 1 / shape, (len(labels), 1))
    rates = expected[labels] * gain
    if design.dispersion:
        rates *= random.gamma(1 / design.dispersion, design.dispersion, rates.shape)
    counts = random.poisson(rates * design.window)
    keys = tuple(f"{subject_name(animal)}/{session_name(session)}/{row}" for row in range(len(labels)))
    return DrawnSession(counts, labels, expected, Trials(counts[:, None] / design.window, labels, keys))


def stimulus_means(block: Trials, stimuli: int) -> NDArray[np.float64]:
    """Mean response [K, U] to every stimulus; NaN where there is no trial."""
    member = np.zeros((stimuli, len(block.labels)))
    member[block.labels, np.arange(len(block.labels))] = 1.0
    number = member.sum(axis=1, keepdims=True)
    total = member @ block.responses.mean(axis=1)
    return np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)


def subject_name(animal: int) -> str:
    """Name of an animal."""
    return f"synthetic{animal + 1:02d}"


def session_name(session: int) -> str:
    """Name of a session."""
    return f"{session + 1:02d}"


def _project(directions: NDArray[np.float64], units: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Tuning [K, U] of units with random preferred directions: normal, covariance over units = cosines."""
    return directions @ random.standard_normal((directions.shape[1], units))


def _labels(design: Design, stimuli: int, absent: list[int], random: np.random.Generator) -> NDArray[np.int64]:
    number = np.full(stimuli, float(design.trials))
    if design.imbalance:
        share = np.exp(design.imbalance * random.standard_normal(stimuli))
        number = np.maximum(1, np.round(design.trials * share / share.mean()))
    number[absent] = 0
    labels = np.repeat(np.arange(stimuli), number.astype(int))
    random.shuffle(labels)
    return labels


def entropy(seed: int | Sequence[int]) -> tuple[int, ...]:
    """A seed as the beginning of a list of integers."""
    return (seed,) if isinstance(seed, (int, np.integer)) else tuple(seed)
