"""The animals behind a score: which of them count, and how much each one's noise is corrected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from brainbench.core.errors import UsageError, check_name, repeats
from brainbench.core.records import Ceiling, Interval
from brainbench.core.statistics import t_interval
from brainbench.metrics.hooks import MetricHooks
from brainbench.metrics.inference.permutation import canonical_order
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE, Corrected, noise_ceiling
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat


@dataclass(frozen=True)
class Animals:
    """Subjects in the order of their names, and the indices of those that can be used."""

    subjects: tuple[SubjectRDM, ...]
    corrections: tuple[Corrected, ...]
    """Correction of a raw comparison of 1: the factor for each subject."""
    usable: tuple[int, ...]
    """Subjects with a factor."""
    scored: tuple[int, ...]
    """Subjects that the score averages: the reliable ones, else (unreliable score) all usable ones."""
    reliable: bool
    reasons: tuple[str, ...]

    def rdms(self, index: Sequence[int]) -> Floats:
        """Return RDMs [len(index), P]."""
        return np.stack([self.subjects[i].rdm for i in index])

    def factors(self, index: Sequence[int]) -> Floats:
        """Return correction factors [len(index)]."""
        return np.array([self.corrections[i].value for i in index])

    @cached_property
    def order(self) -> Ints:
        """An order of the stimuli [K] that depends on the scored animals alone, not on how stimuli were listed."""
        return canonical_order(self.rdms(self.scored))

    @cached_property
    def sorted(self) -> tuple[SubjectRDM, ...]:
        """The scored subjects, their stimuli in :attr:`order`."""
        return tuple(self.subjects[i].take(self.order) for i in self.scored)


def gather(metric: MetricHooks, subjects: Sequence[SubjectRDM], stimuli: int, *, estimator: str = "default") -> Animals:
    """Sort subjects by name, correct each for noise as the metric does and decide who is scored."""
    check_name(f"estimator of the metric {metric.name!r}", estimator, metric.estimators)
    if not subjects:
        raise UsageError("There are no animals to score against; give at least one SubjectRDM.")
    ordered = tuple(sorted(subjects, key=lambda subject: subject.subject))
    names = [subject.subject for subject in ordered]
    if twice := repeats(names):
        raise UsageError(f"Subject {twice[0]!r} appears twice; join the sessions of an animal in one SubjectRDM.")
    for subject in ordered:
        if subject.count != stimuli:
            raise UsageError(f"{subject.subject!r} has an RDM of {subject.count} stimuli; {stimuli} are scored.")
    corrections = tuple(_correction(metric, subject, estimator) for subject in ordered)
    usable = tuple(i for i, found in enumerate(corrections) if found.status != "undefined")
    good = tuple(i for i in usable if corrections[i].status == "ok")
    # The published estimators knew no gate: they average whatever has a value.
    scored = good if good and estimator == "default" else usable
    # Whoever is not averaged is named, so no animal disappears in silence.
    left_out = [i for i in range(len(ordered)) if i not in scored]
    reasons = [f"animal {names[i]} left out: {corrections[i].reason}" for i in left_out]
    # The study is gated, not the animal: see ``ANIMAL_GATE``.
    if estimator == "default" and good:
        # The mean of those that pass is too high where most do not: the median of all counts as well.
        every = np.array([each.reliability for each in corrections])
        measured = [subject.problem is None for subject in ordered]
        reliability = min(float(every[list(good)].mean()), float(np.median(np.nan_to_num(every[measured]))))
        if not reliability >= RELIABILITY_GATE:
            why = f"the animals' reliability, {reliability:.2f}, is below {RELIABILITY_GATE}: no correction holds"
            corrections = tuple(
                replace(each, status="unreliable", reason=why) if i in good else each
                for i, each in enumerate(corrections)
            )
    reliable = bool(scored) and all(corrections[i].status == "ok" for i in scored)
    if scored and not reliable:
        single = [f"{names[i]}: {corrections[i].reason}" for i in scored if corrections[i].status != "ok"]
        reasons += [corrections[scored[0]].reason] if good and estimator == "default" else single
    reasons += [f"{ordered[i].subject}: {note}" for i in usable for note in ordered[i].notes]
    return Animals(ordered, corrections, usable, scored, reliable, tuple(reasons))


def _correction(metric: MetricHooks, subject: SubjectRDM, estimator: str) -> Corrected:
    if subject.problem is not None:
        return Corrected(math.nan, "undefined", subject.problem)
    if is_flat(subject.rdm):
        return Corrected(math.nan, "undefined", "its RDM has missing pairs or no differences between pairs")
    return metric.correction(subject, estimator)


def mean_reliability(animals: Animals) -> tuple[float, Interval | None]:
    """Return the mean reliability over the scored animals with its interval (one animal: its spread)."""
    values = np.array([animals.corrections[i].reliability for i in animals.scored])
    if not values.size:
        return math.nan, None
    # One animal has no interval over animals; the spread over its splits stands in and says so.
    if len(values) == 1:
        return float(values[0]), animals.subjects[animals.scored[0]].spread
    return float(values.mean()), t_interval(values, over="animals")


def ceiling_of(animals: Animals, comparison: str) -> Ceiling | None:
    """Return the raw noise ceiling of the scored animals, or None for fewer than two."""
    if len(animals.scored) < 2:
        return None
    bounds = noise_ceiling(animals.rdms(animals.scored), method=comparison)
    return None if bounds.reason else Ceiling(bounds.lower, bounds.upper)


def mean_rdm(animals: Animals) -> tuple[float, ...]:
    """Return the mean RDM of the scored animals [P]; empty without any."""
    return recorded_rdm(animals.rdms(animals.scored).mean(axis=0)) if animals.scored else ()


def recorded_rdm(values: Floats) -> tuple[float, ...]:
    """Return an RDM [P] as records hold it, to show and to compare: seven digits, half the size of all."""
    return tuple(float(f"{value:.7g}") for value in values.tolist())
