"""Quantities of networks, ours and the study's: accuracy on the test sweeps, fit on a board, order of the layers."""

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

from benchmarks.reproduction.campaign import Accuracy, Campaign, NetworkKey
from benchmarks.reproduction.contrasts import Observed
from brainbench.core.records import ResultRecord, Score
from leaderboards.ranking import Sample

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
    """Return the content of ``published.json``, and as ``networks`` its runs by network."""

    def key(run: dict[str, Any]) -> NetworkKey:
        return NetworkKey.of(run["model"], run["objective"])._replace(full=False)

    found = json.loads(Path(__file__).with_name("published.json").read_text(encoding="utf-8"))
    return {**found, "networks": {key(run): run for run in found["runs"]}}


def published_accuracy() -> Measured:
    """Return the published top-5 accuracies, one run of each network."""
    runs, sweeps = published()["networks"].items(), published()["test_sweeps"]
    return Measured(
        {key: Observed(key.name, {0: run["top5"]}, key.objective, sweeps) for key, run in runs if run["top5"]}
    )


def published_parameters() -> dict[NetworkKey, float]:
    """Return log10 of the published numbers of parameters."""
    return {key: math.log10(run["parameters"]) for key, run in published()["networks"].items() if run["parameters"]}


def accuracies(campaign: Campaign, name: str = "top5") -> Measured:
    """Return the top-5 (or ``top1``) accuracies of networks and baselines."""
    networks = {}
    for key, network in campaign.networks.items():
        if values := {seed: line.result for seed, line in network.trainings.items() if line.result}:
            networks[key] = observed(key.name, values, name, key.objective)
    lines = {re.sub("[-_]", " ", title): line.result for title, line in campaign.baselines.items()}
    return Measured(networks, {title: observed(title, {0: told}, name) for title, told in lines.items() if told})


def observed(name: str, results: Mapping[int, Accuracy], which: str, objective: str = "") -> Observed:
    """Return one of the accuracies of a network by seed."""
    values = {seed: getattr(found, which) for seed, found in results.items()}
    return Observed(name, values, objective, min(found.count for found in results.values()))


def parameters(campaign: Campaign) -> dict[NetworkKey, float]:
    """Return log10 of the parameters of the networks."""
    counts = {key: [line.parameters for line in one.trainings.values()] for key, one in campaign.networks.items()}
    return {key: math.log10(found[0]) for key, found in counts.items() if found and found[0]}


def fits(campaign: Campaign, place: int) -> Measured:
    """Return the fits on one board, scaled between chance (0) and all that is reliable (1); reliable ones only."""
    networks = {}
    for key, network in campaign.networks.items():
        lost = {seed for seed, line in network.trainings.items() if not line.result}
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


def _fit(name: str, scores: Mapping[int, Score], objective: str = "") -> Observed | None:
    good = {seed: one for seed, one in sorted(scores.items()) if one.status == "ok" and math.isfinite(one.scaled)}
    values = {seed: score.scaled for seed, score in good.items()}
    return Observed(name, values, objective, sample=Sample.of(list(good.values()))) if good else None


def _order(record: ResultRecord, part: str) -> float:
    from scipy.stats import kendalltau

    values = [item.value for item in record.score.layers if item.layer.startswith(part) and math.isfinite(item.value)]
    return float(np.array(kendalltau(range(len(values)), values))[0]) if len(values) > 2 else math.nan
