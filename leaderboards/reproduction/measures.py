"""Quantities of a campaign's networks: accuracy on the test sweeps, fit on a board, order of the layers."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.core.records import ResultRecord, Score
from leaderboards.ranking import Sample
from leaderboards.reproduction.campaign import Campaign, NetworkKey
from leaderboards.reproduction.contrasts import Observed
from leaderboards.reproduction.trainings import Training

ANIMALS = "animal-to-animal"
RANDOM_FEATURES = "random features"


@dataclass(frozen=True)
class Measured:
    """One quantity of all networks."""

    networks: Mapping[NetworkKey, Observed]
    baselines: Mapping[str, Observed] = field(default_factory=dict)

    def find(
        self,
        *,
        encoder: str | None = None,
        attender: str | None = None,
        objective: str | None = None,
        variant: str = "",
    ) -> dict[NetworkKey, Observed]:
        """Return the networks with these properties; None allows any, and of objectives any but untrained."""
        return {
            key: item
            for key, item in self.networks.items()
            if key.variant == variant
            and encoder in (None, key.encoder)
            and attender in (None, key.attender)
            and (key.objective == objective if objective else key.objective != "untrained")
        }


@cache
def published() -> dict[str, Any]:
    """Return the content of ``published.json``."""
    return json.loads(Path(__file__).with_name("published.json").read_text(encoding="utf-8"))


def published_accuracy() -> Measured:
    """Return the published top-5 accuracies, one run of each network."""
    found = {}
    for run in published()["runs"]:
        if run["top5"] is None:
            continue
        key = NetworkKey.of(run["model"], run["objective"])
        found[key] = Observed(key.name, {0: run["top5"]}, run["objective"], published()["test_sweeps"])
    return Measured(found)


def accuracies(campaign: Campaign, *, top1: bool = False) -> Measured:
    """Return the top-5 (or top-1) accuracies, those of untrained twins and of the baselines among them."""
    values: dict[NetworkKey, dict[int, tuple[float, int]]] = {}
    for key, network in campaign.networks.items():
        for seed, training in network.trainings.items():
            twin = NetworkKey(key.encoder, key.attender, "untrained")
            own = training.evaluation if training.finished else None
            for name, result in ((key, own), (twin, training.twin_evaluation)):
                if result is not None:
                    # An untrained network's own line comes before what trainings say of their twin.
                    first = name == key and key.objective == "untrained"
                    told = values.setdefault(name, {})
                    if first or seed not in told:
                        told[seed] = (result.top1 if top1 else result.top5, result.count)
    networks = {
        key: Observed(key.name, {seed: value for seed, (value, _) in told.items()}, key.objective, _sweeps(told))
        for key, told in values.items()
    }
    lines = {re.sub("[-_]", " ", name): line for name, line in campaign.baselines.items()}
    return Measured(networks, {name: _baseline(name, line, top1) for name, line in lines.items() if line.evaluation})


def fits(campaign: Campaign, place: int) -> Measured:
    """Return the fits on one board, scaled between chance (0) and all that is reliable (1); reliable ones only."""
    networks = {}
    for key, network in campaign.networks.items():
        lost = {seed for seed, line in network.trainings.items() if not line.finished}
        scores = {seed: one.score for seed, one in network.records.get(place, {}).items() if seed not in lost}
        if item := _fit(key.name, scores, key.objective):
            networks[key] = item
    baselines = {item.name: item.score for item in campaign.boards[place].baselines}
    found = {name: _fit(name, {0: score}) for name, score in baselines.items()}
    return Measured(networks, {name: item for name, item in found.items() if item is not None})


def layer_orders(campaign: Campaign, place: int, part: str = "") -> Measured:
    """Return Kendall's τ of the depth of layers with their fit, of the layers whose name begins with ``part``."""
    found = {}
    for key, network in campaign.networks.items():
        taus = {seed: _order(record, part) for seed, record in network.records.get(place, {}).items()}
        if taus := {seed: tau for seed, tau in taus.items() if math.isfinite(tau)}:
            found[key] = Observed(key.name, taus, key.objective)
    return Measured(found)


def parameters(campaign: Campaign, place: int | None = None) -> dict[NetworkKey, int]:
    """Return the parameters of the networks, from trainings or else from the cards of the records of a board."""
    found = {}
    for key, network in campaign.networks.items():
        counts = [line.parameters for line in network.trainings.values()]
        records = network.records.get(place, {}) if place is not None else {}
        counts += [record.card.parameters for record in records.values() if record.card]
        if count := next(filter(None, counts), None):
            found[key] = count
    return found


def _sweeps(told: Mapping[int, tuple[float, int]]) -> int:
    return min(count for _, count in told.values())


def _baseline(name: str, line: Training, top1: bool) -> Observed:
    assert line.evaluation is not None  # the caller's filter
    return Observed(name, {0: line.evaluation.top1 if top1 else line.evaluation.top5}, "", line.evaluation.count)


def _fit(name: str, scores: Mapping[int, Score], objective: str = "") -> Observed | None:
    good = {
        seed: score for seed, score in sorted(scores.items()) if score.status == "ok" and math.isfinite(score.scaled)
    }
    if not good:
        return None
    return Observed(
        name, {seed: score.scaled for seed, score in good.items()}, objective, sample=Sample.of(list(good.values()))
    )


def _order(record: ResultRecord, part: str) -> float:
    from scipy.stats import kendalltau

    values = [item.value for item in record.score.layers if item.layer.startswith(part) and math.isfinite(item.value)]
    return float(np.array(kendalltau(range(len(values)), values))[0]) if len(values) > 2 else math.nan
