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
from leaderboards.reproduction.trainings import Accuracy

ANIMALS = "animal-to-animal"
RANDOM_FEATURES = "random features"


@dataclass(frozen=True)
class Measured:
    """One quantity of all networks."""

    networks: Mapping[NetworkKey, Observed]
    baselines: Mapping[str, Observed] = field(default_factory=dict)

    def find(
        self, *, attender: str | None = None, objective: str | None = None, variant: str = ""
    ) -> dict[NetworkKey, Observed]:
        """Return the networks with these properties; None allows any, and of objectives any but untrained."""
        return {
            key: item
            for key, item in self.networks.items()
            if key.variant == variant
            and attender in (None, key.attender)
            and (key.objective == objective if objective else key.objective != "untrained")
        }


@cache
def published() -> dict[str, Any]:
    """Return the content of ``published.json``."""
    return json.loads(Path(__file__).with_name("published.json").read_text(encoding="utf-8"))


def published_accuracy() -> Measured:
    """Return the published top-5 accuracies, one run of each network."""
    runs = [(NetworkKey.of(run["model"], run["objective"]), run["top5"]) for run in published()["runs"]]
    sweeps = published()["test_sweeps"]
    return Measured({key: Observed(key.name, {0: top5}, key.objective, sweeps) for key, top5 in runs if top5})


def accuracies(campaign: Campaign, name: str = "top5") -> Measured:
    """Return the top-5 (or ``top1``) accuracies, those of untrained twins and of the baselines among them."""
    values: dict[NetworkKey, dict[int, Accuracy]] = {}
    for key, network in campaign.networks.items():
        for seed, training in network.trainings.items():
            twin = NetworkKey(key.encoder, key.attender, "untrained")
            own = training.evaluation if training.finished else None
            for owner, result in ((key, own), (twin, training.twin_evaluation)):
                # An untrained network's own line comes before what trainings say of their twin.
                first = owner == key and key.objective == "untrained"
                if result is not None and (first or seed not in values.get(owner, {})):
                    values.setdefault(owner, {})[seed] = result
    networks = {key: observed(key.name, told, name, key.objective) for key, told in values.items()}
    lines = {re.sub("[-_]", " ", title): line.evaluation for title, line in campaign.baselines.items()}
    return Measured(networks, {title: observed(title, {0: told}, name) for title, told in lines.items() if told})


def observed(name: str, results: Mapping[int, Accuracy], which: str, objective: str = "") -> Observed:
    """Return one of the accuracies of a network by seed."""
    values = {seed: getattr(found, which) for seed, found in results.items()}
    return Observed(name, values, objective, min(found.count for found in results.values()))


def fits(campaign: Campaign, place: int) -> Measured:
    """Return the fits on one board, scaled between chance (0) and all that is reliable (1); reliable ones only."""
    networks = {}
    for key, network in campaign.networks.items():
        lost = {seed for seed, line in network.trainings.items() if not line.finished}
        scores = {seed: one.score for seed, one in network.records.get(place, {}).items() if seed not in lost}
        networks[key] = _fit(key.name, scores, key.objective)
    baselines = {item.name: _fit(item.name, {0: item.score}) for item in campaign.boards[place].baselines}
    return Measured(
        {key: item for key, item in networks.items() if item}, {name: item for name, item in baselines.items() if item}
    )


def layer_orders(campaign: Campaign, place: int, part: str = "") -> Measured:
    """Return Kendall's τ of the depth of layers with their fit, of the layers whose name begins with ``part``."""
    found = {}
    for key, network in campaign.networks.items():
        taus = {seed: _order(record, part) for seed, record in network.records.get(place, {}).items()}
        if taus := {seed: tau for seed, tau in taus.items() if math.isfinite(tau)}:
            found[key] = Observed(key.name, taus, key.objective)
    return Measured(found)


def parameters(campaign: Campaign, place: int | None = None) -> dict[NetworkKey, float]:
    """Return log10 of the parameters of the networks, from trainings or else from the cards of a board's records."""
    found = {}
    for key, network in campaign.networks.items():
        records = network.records.get(place, {}) if place is not None else {}
        counts = [line.parameters for line in network.trainings.values()]
        counts += [record.card.parameters for record in records.values() if record.card]
        if count := next(filter(None, counts), None):
            found[key] = math.log10(count)
    return found


def published_parameters() -> dict[NetworkKey, float]:
    """Return log10 of the published numbers of parameters."""
    runs = [(NetworkKey.of(run["model"], run["objective"]), run["parameters"]) for run in published()["runs"]]
    return {key: math.log10(count) for key, count in runs if count}


def _fit(name: str, scores: Mapping[int, Score], objective: str = "") -> Observed | None:
    good = {seed: one for seed, one in sorted(scores.items()) if one.status == "ok" and math.isfinite(one.scaled)}
    values = {seed: score.scaled for seed, score in good.items()}
    return Observed(name, values, objective, sample=Sample.of(list(good.values()))) if good else None


def _order(record: ResultRecord, part: str) -> float:
    from scipy.stats import kendalltau

    values = [item.value for item in record.score.layers if item.layer.startswith(part) and math.isfinite(item.value)]
    return float(np.array(kendalltau(range(len(values)), values))[0]) if len(values) > 2 else math.nan
