"""Factories of records with numbers that a test can look for."""

from __future__ import annotations

import math
from itertools import combinations

from jsonschema import Draft202012Validator

from brainbench.core.records import Ceiling, Interval, LayerScore, ModelCard, ResultRecord, Score, SubjectScore
from leaderboards.schema import record_schema

VALIDATOR = Draft202012Validator(record_schema())
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
