"""Factories of records with numbers that a test can look for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from jsonschema import Draft202012Validator
from scipy.special import stdtrit

from brainbench.core.files import read_json
from brainbench.core.records import (
    Ceiling,
    Interval,
    LayerScore,
    ModelCard,
    ResultRecord,
    Score,
    SubjectScore,
)
from brainbench.core.statistics import two_factor_error
from leaderboards.store import SCHEMA_PATH

VALIDATOR = Draft202012Validator(read_json(SCHEMA_PATH))
STIMULI = tuple(f"{shape}-{distance}" for shape in ("convex", "concave") for distance in ("close", "medium", "far"))
MODEL_RDM = tuple((i * j + 1) / 31 for i, j in combinations(range(6), 2))
BRAIN_RDM = tuple((i + j) / 9 for i, j in combinations(range(6), 2))


def make_score(name: str = "zhuang", value: float = 0.523, *, status: str = "ok", **changes: object) -> Score:
    fields: dict[str, object] = {
        "name": name,
        "value": math.nan if status == "undefined" else value,
        "status": status,
        "reasons": () if status == "ok" else ("two of three animals are noise",),
        "r": 0.411,
        "reliability": 0.734,
        "reliability_interval": Interval(0.612, 0.845, method="bootstrap over animals"),
        "interval": None
        if status == "undefined"
        else Interval(value - 0.1, value + 0.1, method="bootstrap over animals"),
        "p": 0.0127,
        "p_method": "exact, 720 orders",
        "p_smallest": 1 / 720,
        "ceiling": Ceiling(0.601, 0.797),
        "layer": "conv3",
        "layer_rule": "chosen on the other animals",
        "best_layer": "conv4",
        "best_layer_value": 0.688,
        "layers": (LayerScore("conv3", 0.529, 0.4), LayerScore("conv4", 0.688, 0.5), LayerScore("fc7", -0.127, -0.1)),
        "subjects": (
            SubjectScore("mouse-a", 0.551, 0.44, 0.77, "ok", 31, 402, "conv3"),
            SubjectScore("mouse-b", 0.495, 0.38, 0.41, "unreliable", 12, 118, "conv4"),
        ),
        "metric": "correlation distance, Pearson",
        "stimuli": STIMULI,
        "model_rdm": MODEL_RDM,
        "brain_rdm": BRAIN_RDM,
        "chance": 0.0,
        "attainable": 1.0,
        "without_stimulus": tuple(value + 0.01 * (k - 2.5) for k in range(len(STIMULI))),
        "provenance": {
            "version": "0.1.0",
            "time": "2026-11-21T07:50:00+00:00",
            "machine": "Linux x86_64",
            "packages": {"numpy": "2.3.1"},
            "recordings": {"source": "/data/here/demo", "content_hash": "9f3c2a7be1d04455", "removed": {"spoil": 12}},
            "stimuli": {"description": "rodgers, mouse", "content_hash": "77aa10c3de29b6f1"},
            "settings": {"time": "mean", "seed": 0},
            "command": f"brainbench score {name}",
        },
    }
    return Score(**{**fields, **changes})  # type: ignore[arg-type]


def make_record(
    name: str = "zhuang", value: float = 0.523, *, synthetic: bool = True, **changes: object
) -> ResultRecord:
    return ResultRecord(
        make_score(name, value, **changes),
        make_score("animal-to-animal", 0.712, layers=(), layer=None, subjects=()),
        {"raw input": make_score("raw input", 0.223), "random features": make_score("random features", 0.487)},
        ModelCard(name, "recurrent", "SimCLR", parameters=37_988_821, top1=0.352, seed=3, collapsed=False),
        synthetic,
    )


def draw_board(
    truths: Mapping[str, float],
    *,
    animals: int = 10,
    stimuli: int = 40,
    noise: float = 0.1,
    spread: float = 0.5,
    raw: float = 0.1,
    chance: float = 0.0,
    truth: str = "",
    seed: int = 0,
) -> list[ResultRecord]:
    """Return one record per model whose values are drawn around its truth, animals and stimuli both sampled.

    Args:
        truths: Expected scaled value of each model.
        animals, stimuli: Size of the design.
        noise: Standard deviation of an animal's value around its model's.
        spread: Standard deviation over stimuli of what single stimuli add to a model's value, of each model its own.
        raw: Expected scaled value of the raw input.
        chance: Value of a model that knows nothing; 1 is attainable.
        truth: Name of the network that made the recordings.
        seed: Seed of the draw.
    """
    rng = np.random.default_rng(seed)
    labels = tuple(f"object-{k:02d}" for k in range(stimuli))
    shared = rng.normal(0, noise, animals)

    def score(name: str, expected: float) -> Score:
        parts = expected + rng.normal(0, spread, stimuli)
        values = parts.mean() + shared + rng.normal(0, noise, animals)
        value = float(values.mean())
        without = value + (parts.mean() - parts) / (stimuli - 1)

        def unscaled(one: float) -> float:
            return float(chance + (1 - chance) * one)

        error, freedom = two_factor_error(values, without)
        half = float((1 - chance) * error * stdtrit(freedom, 0.975))
        middle = unscaled(value)
        pairs = stimuli * (stimuli - 1) // 2
        subjects = tuple(
            SubjectScore(f"animal-{i}", unscaled(one), unscaled(one), 0.8, "ok", 60, 700, "encoder.conv3")
            for i, one in enumerate(values)
        )
        found = make_score(
            name, middle, subjects=subjects, stimuli=labels, chance=chance, attainable=1.0,
            without_stimulus=tuple(map(unscaled, without)), p=0.001 if value > 0.1 else 0.4,
            p_smallest=0.001, p_method="999 random orders", layer="encoder.conv3",
            interval=Interval(middle - half, middle + half, method=f"t over {animals} animals and {stimuli} stimuli"),
            model_rdm=tuple(rng.random(pairs)), brain_rdm=tuple(rng.random(pairs)),
        )  # fmt: skip
        made = {**found.provenance, "recordings": {"source": "demo", "content_hash": "9f3c2a7b", "truth": truth}}
        return replace(found, provenance={**made, "settings": {**made["settings"], "model": name}})

    base = {"raw input": score("raw input", raw), "random features": score("random features", raw)}
    between = score("animal-to-animal", 0.9)
    return [
        ResultRecord(
            score(name, expected),
            between,
            base,
            ModelCard(name, "recurrent", "untrained", parameters=2_000_000 + i, seed=0, weights=f"{seed}-{i}"),
            True,
        )
        for i, (name, expected) in enumerate(truths.items())
    ]
