"""Stimulus against time: order of presentation, drift, and the times as a control beside the raw input.

Where stimuli were presented in blocks, slow changes of rates tell them apart without any tuning, alike in random halves
of the trials and in all animals that had the same order. So the times of presentation are scored as if they were a
model, with every animal's own times. Where stimulus and time are confounded in some session, a score counts only if
the times explain nothing. Where responses drift within sessions, or noise lasts from trial to trial, random parts agree
better than parts by time do, and a score counts only if the reliability of these reaches the gate too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.records import Score
from brainbench.core.statistics import PresentationOrder, presentation_order, slow_courses

if TYPE_CHECKING:
    from brainbench.metrics import Metric
    from brainbench.metrics.reliability.subject_rdm import Drift, SubjectRDM

CONTROL = "presentation time"  # name of the control among the baselines of a record
CHANCE_LEVEL = 0.05  # the times explain something where their permutation p is at most this


@dataclass(frozen=True)
class Presentation:
    """When the stimuli of a score were presented."""

    orders: dict[str, PresentationOrder] = field(default_factory=dict)
    """By session."""
    control: Score | None = None
    """Score of the times; None where some animal's are not known, or a metric has no layers of single animals."""
    within: Drift | None = None
    """Drift within sessions; None where no times are known."""
    between: Drift | None = None
    """Drift between sessions; None where no animal has enough of them."""

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons why scores say little of tuning."""
        doubts = [self._confounded]
        if self.within is not None and self.within.present and not self.within.reliable:
            doubts.append(f"{self._drifts}: what random halves share is not all tuning")
        return tuple(filter(None, doubts))

    @property
    def remarks(self) -> tuple[str, ...]:
        """Drift that a reader of scores has to know of, where it is no doubt."""
        remarks = []
        if self.within is not None and self.within.present and self.within.reliable:
            remarks.append(self._drifts)
        if self.between is not None and self.between.present:
            share = f"the earlier and the later half of them share {self.between.by_time:.0%} of what any two share"
            remarks.append(f"responses drift between sessions: {share} (p = {self.between.p:.2g})")
        return tuple(remarks)

    @property
    def _drifts(self) -> str:
        assert self.within is not None
        times = f"parts by time have a reliability of {self.within.by_time:.2f}, random ones {self.within.random:.2f}"
        return f"responses drift within sessions: {times} (p = {self.within.p:.2g})"

    @property
    def _confounded(self) -> str:
        blocked = [order for order in self.orders.values() if order.confounded]
        if not blocked or (self.control is not None and self.control.p > CHANCE_LEVEL):
            return ""
        worst = max(blocked, key=lambda order: order.share)
        text = f"stimulus and time are confounded in {len(blocked)} of {len(self.orders)} sessions: {worst}"
        if self.control is None or math.isnan(self.control.scaled):
            return f"{text}, and what time alone explains is not known"
        return f"{text}, and the times alone score {self.control.scaled:.2f} (p = {self.control.p:.2g})"

    @property
    def statistics(self) -> dict[str, Any]:
        """What a record keeps of the orders: the largest share, by session where there are few."""
        drift = {"within": self.within, "between": self.between}
        stated_drift = {name: part.stated for name, part in drift.items() if part is not None}
        drifts = {"drift": stated_drift} if stated_drift else {}
        if not self.orders:
            return drifts
        worst = max(self.orders.values(), key=lambda order: order.share - order.expected)
        sessions = sum(order.confounded for order in self.orders.values())
        stated = {"sessions": len(self.orders), "confounded": sessions}
        stated |= {"share": worst.share, "expected": worst.expected, "p": worst.p}
        return {"presentation": stated, **drifts}


def presentation_of(
    metric: Metric, animals: Sequence[Any], labels: Sequence[str], *, control: bool, seed: int
) -> Presentation:
    """Return the orders of presentation and drift; the control is scored if asked for, or if time is confounded."""
    from brainbench.metrics.hooks import MetricHooks
    from brainbench.metrics.reliability.subject_rdm import SubjectRDM, drift_between, drift_within

    prepared = [animal for animal in animals if isinstance(animal, SubjectRDM) and animal.problem is None]
    orders = {
        f"{animal.subject} {session}": order
        for animal in prepared
        for session, trials in animal.presented.items()
        if (order := presentation_order(*trials)) is not None
    }
    result = Presentation(orders, None, drift_within(prepared), drift_between(prepared, seed=seed))
    comparable = isinstance(metric, MetricHooks) and not metric.of_model_alone
    if comparable and (control or any(order.confounded for order in orders.values())):
        return replace(result, control=_control(metric, animals, labels, seed))
    return result


def _control(metric: Metric, animals: Sequence[SubjectRDM], labels: Sequence[str], seed: int) -> Score | None:
    """Score the mean times of each animal's stimuli, sessions side by side, as its own layer."""
    from brainbench.metrics.score import score_layers

    layers: dict[str, Any] = {}
    for animal in animals:
        if animal.problem is not None:
            continue
        if not animal.presented:
            return None
        places = [_mean_places(*trials, len(labels)) for trials in animal.presented.values()]
        layers[animal.subject] = metric.layer(np.concatenate(places, axis=1))
    how: dict[str, Any] = {"stimuli": labels, "seed": seed, "each": True}
    return score_layers(metric, layers, animals, name=CONTROL, **how)[0] if layers else None


def _mean_places(start: NDArray[Any], codes: NDArray[Any], count: int) -> NDArray[np.float64]:
    """Return the mean place [K, 1 + W] of each stimulus' trials in their session, from 0 to 1.

    Where labels are confounded with slow waves instead, their means follow, of the size that each has in a random walk.
    """
    (_, ranks), *courses = slow_courses(start).items()
    columns, order = [(ranks - 1) / max(1, len(start) - 1)], presentation_order(start, codes)
    if order is not None and order.waves:
        columns += [course * math.sqrt(2) / (math.pi * waves) for waves, course in courses]
    sums = [np.bincount(codes, weights=column, minlength=count) for column in columns]
    return np.stack(sums, axis=1) / np.bincount(codes, minlength=count)[:, None]
