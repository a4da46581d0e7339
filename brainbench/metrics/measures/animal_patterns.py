"""Animals' mean responses and their noise, for metrics of patterns, and which animals count."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.core.records import Status, SubjectScore
from brainbench.core.trials import Trials
from brainbench.metrics.rdms.pairs import Floats
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE
from brainbench.metrics.reliability.sessions import usable_sessions
from brainbench.metrics.stimulus_labels import membership, stimulus_means


@dataclass(frozen=True)
class AnimalPatterns:
    """An animal's mean responses."""

    subject: str
    patterns: Floats = field(repr=False)
    """[K, U] mean over trials, units of all sessions joined; units lacking a stimulus are left out."""
    noise: Floats = field(repr=False)
    """[K, U] variance of those means, from the spread over trials."""
    units: int = 0
    trials: int = 0
    problem: str | None = None
    """Reason for not using the animal; None otherwise."""
    notes: tuple[str, ...] = ()
    nuisances: Mapping[str, Floats] = field(default_factory=dict, repr=False)
    """Name → RDM [P] of what else was measured in the trials; see :mod:`brainbench.metrics.measures.nuisance`."""

    @property
    def reliability(self) -> float:
        """Share of the variance between stimuli that is not trial noise, over all units; can be negative."""
        if self.problem is not None:
            return math.nan
        # Means differ by the stimuli and by their own noise, which is taken away.
        between = float(self.patterns.var(axis=0, ddof=1).sum())
        return 1 - float(self.noise.mean(axis=0).sum()) / between if between > 0 else math.nan


def animal_patterns(
    subject: str, blocks: Sequence[Trials], n_stimuli: int, *, stimuli: Sequence[str] | None = None
) -> AnimalPatterns:
    """Average an animal's trials, leaving out by the rules of :mod:`brainbench.metrics.reliability.sessions`.

    Raises:
        UsageError: bad shapes or labels.
        DataError: infinite responses.
    """
    names = [str(name) for name in (range(n_stimuli) if stimuli is None else stimuli)]
    sessions, problem, notes = usable_sessions(blocks, n_stimuli, names, least=2)
    trials = sum(len(session.labels) for session in sessions)
    if problem is not None:
        empty = np.empty((n_stimuli, 0))
        return AnimalPatterns(subject, empty, empty, 0, trials, problem, notes)
    means, noise = [], []
    for session in sessions:
        mean = stimulus_means(session.responses, session.labels, n_stimuli)
        square = stimulus_means((session.responses - mean[session.labels]) ** 2, session.labels, n_stimuli)
        # Trials counted by unit, since a unit may be missing in some of them.
        number = membership(session.labels, n_stimuli) @ np.isfinite(session.responses)
        means.append(mean)
        # Mean square deviation × n/(n − 1) is the variance over trials; over n, that of their mean.
        noise.append(square / (number - 1))
    joined = np.concatenate(means, axis=1)
    return AnimalPatterns(subject, joined, np.concatenate(noise, axis=1), joined.shape[1], trials, None, notes)


@dataclass(frozen=True)
class PatternAnimals:
    """Animals by name, and the indices of those that are scored."""

    animals: tuple[AnimalPatterns, ...]
    scored: tuple[int, ...]
    reliable: bool
    reasons: tuple[str, ...]


def gather_patterns(animals: Sequence[AnimalPatterns], corrected: bool) -> PatternAnimals:
    """Sort animals by name and decide which are scored: the reliable ones where values are corrected."""
    if not animals:
        raise UsageError("There are no animals to score against; give at least one.")
    ordered = tuple(sorted(animals, key=lambda animal: animal.subject))
    # A correction divides by explainable variance, so it needs some; raw values are reported whatever the noise.
    least = 0.0 if corrected else -math.inf
    usable = [i for i, animal in enumerate(ordered) if animal.problem is None and animal.reliability > least]
    good = [i for i in usable if ordered[i].reliability >= RELIABILITY_GATE]
    scored = good if good and corrected else usable
    reasons = []
    for index, animal in enumerate(ordered):
        if index not in scored:
            why = animal.problem or f"reliability {animal.reliability:.2f} is below {RELIABILITY_GATE}"
            reasons.append(f"{animal.subject} left out: {why}")
        reasons += [f"{animal.subject}: {note}" for note in animal.notes if index in scored]
    return PatternAnimals(ordered, tuple(scored), bool(good) or not corrected, tuple(reasons))


def subject_scores(found: PatternAnimals, values: Mapping[str, tuple[float, str | None]]) -> tuple[SubjectScore, ...]:
    """Return what each animal contributed: its value and layer, by name."""
    scores = []
    for animal in found.animals:
        value, layer = values.get(animal.subject, (math.nan, None))
        good = animal.subject in values
        status: Status = "undefined" if not good else "ok" if found.reliable else "unreliable"
        scores.append(
            SubjectScore(animal.subject, value, value, animal.reliability, status, animal.units, animal.trials, layer)
        )
    return tuple(scores)
