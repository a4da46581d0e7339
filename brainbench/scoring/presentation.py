"""Stimulus against time: the order of presentation in each session, and the times as a control beside the raw input.

Where stimuli were presented in blocks, slow changes of rates tell them apart without any tuning, alike in random halves
of the trials and in all animals that had the same order. So the times of presentation are scored as if they were a
model, with every animal's own times. Where stimulus and time are confounded in some session, a score counts only if
the times explain nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.records import Score
from brainbench.core.statistics import PresentationOrder, presentation_order

if TYPE_CHECKING:
    from brainbench.metrics import Metric
    from brainbench.scoring.neural_responses import NeuralResponses

CONTROL = "presentation time"
"""Name of the control among the baselines of a record."""
CHANCE_LEVEL = 0.05
"""The times explain something where their permutation p is at most this."""


@dataclass(frozen=True)
class Presentation:
    """When the stimuli of a score were presented."""

    orders: dict[str, PresentationOrder] = field(default_factory=dict)
    """By session."""
    control: Score | None = None
    """Score of the times; None where some animal's are not known, or a metric has no layers of single animals."""

    @property
    def doubt(self) -> str:
        """Reason why scores say little of tuning; empty where they do."""
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
        if not self.orders:
            return {}
        worst = max(self.orders.values(), key=lambda order: order.share - order.expected)
        sessions = sum(order.confounded for order in self.orders.values())
        stated = {"sessions": len(self.orders), "confounded": sessions}
        return {"presentation": {**stated, "share": worst.share, "expected": worst.expected, "p": worst.p}}


def presentation_of(
    brain: NeuralResponses, metric: Metric, animals: Sequence[Any], labels: Sequence[str], *, control: bool, seed: int
) -> Presentation:
    """Return the orders of presentation; the control is scored if it is asked for or if they are confounded."""
    from brainbench.metrics.hooks import MetricHooks

    times = dict(_sessions(brain, labels))
    orders = {
        f"{subject} {session}": order
        for (subject, session), (start, codes) in times.items()
        if (order := presentation_order(start, codes)) is not None
    }
    result = Presentation(orders)
    comparable = isinstance(metric, MetricHooks) and not metric.of_model_alone
    if comparable and (control or any(order.confounded for order in orders.values())):
        return replace(result, control=_control(metric, animals, labels, times, seed))
    return result


def _sessions(
    brain: NeuralResponses, labels: Sequence[str]
) -> Iterator[tuple[tuple[str, str], tuple[NDArray[Any], NDArray[Any]]]]:
    """Yield the begin [R] of the trials of every session and the places [R] of their stimuli; only of known times."""
    data = brain.dataset
    if "window_start" not in data.coords:
        return
    start = np.asarray(data["window_start"].values, dtype=np.float64)
    place = {label: index for index, label in enumerate(labels)}
    codes = np.array([place.get(label, -1) for label in data["stimulus"].values.astype(str).tolist()])
    names = list(zip(*(data[name].values.astype(str).tolist() for name in ("subject", "session")), strict=True))
    for name in dict.fromkeys(names):
        rows = np.array([each == name for each in names]) & (codes >= 0) & np.isfinite(start)
        if rows.any():
            yield name, (start[rows], codes[rows])


def _control(
    metric: Metric,
    animals: Sequence[Any],
    labels: Sequence[str],
    times: dict[tuple[str, str], tuple[NDArray[Any], NDArray[Any]]],
    seed: int,
) -> Score | None:
    """Score the mean times of each animal's stimuli, sessions side by side, as its own layer."""
    from brainbench.metrics.score import score_layers

    count = len(labels)
    layers: dict[str, Any] = {}
    for animal in animals:
        columns = [
            _mean_places(*trials, count)
            for (subject, _), trials in times.items()
            if subject == animal.subject and len(np.unique(trials[1])) == count
        ]
        if not columns:
            return None
        layers[animal.subject] = metric.layer(np.stack(columns, axis=1))
    how: dict[str, Any] = {"stimuli": labels, "seed": seed, "each": True}
    return score_layers(metric, layers, animals, name=CONTROL, **how)[0]


def _mean_places(start: NDArray[Any], codes: NDArray[Any], count: int) -> NDArray[np.float64]:
    """Return the mean place [K] of each stimulus' trials in their session, from 0 to 1."""
    places = np.argsort(np.argsort(start, kind="stable")) / max(1, len(start) - 1)
    return np.bincount(codes, weights=places, minlength=count) / np.bincount(codes, minlength=count)
