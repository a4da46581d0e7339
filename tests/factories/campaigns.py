"""Factories of small campaigns whose truths are known."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from brainbench.core.records import LayerScore, ModelCard, ResultRecord
from leaderboards.store import write_record
from tests.factories.benchmark_programs import benchmark_program
from tests.factories.records import draw_board

CAMPAIGN = benchmark_program("reproduction.campaign")
TEST_SWEEPS = 10_000
_ENCODERS = ("zhuang", "zhuang-gru", "zhuang-intersection-ln", "resnet18", "s4")
_OBJECTIVES = {"simclr": "physical", "simsiam": "physical", "ae": "physical", "untrained": "none"}
"""Objective → usual augmentation."""


def networks() -> list[dict[str, Any]]:
    """Return what tells the trainings of a small campaign apart."""
    found = []
    for encoder in _ENCODERS:
        for attender in ("", "+gpt", "+mamba"):
            found += [(f"{encoder}-small{attender}", "supervised", "none", 0.0, seed) for seed in range(2)]
    for encoder in ("zhuang-gru", "zhuang-intersection-ln", "resnet18"):
        for attender in ("", "+gpt"):
            found += [(f"{encoder}-small{attender}", *trained, 0.0, 0) for trained in _OBJECTIVES.items()]
        found.append((f"{encoder}-small", "simclr", "image", 0.0, 0))
        found.append((f"{encoder}-small", "simclr", "physical", 0.75, 0))
    found += [("zhuang-gru-ln-small", "supervised", "none", 0.0, seed) for seed in range(2)]
    names = ("model", "objective", "augmentation", "masking", "seed")
    return [dict(zip(names, values, strict=True)) for values in found]


def truth(run: dict[str, Any], sign: float, *, fit: bool = False) -> float:
    """Return the expected accuracy (or fit) of a training where every published effect has this sign."""
    encoder, _, attender = run["model"].partition("+")
    value = 0.08 * encoder.startswith("zhuang") + 0.06 * encoder.startswith("zhuang-intersection-ln")
    value += 0.05 * (attender == "gpt") - 0.03 * (attender == "mamba") + 0.04 * encoder.startswith("zhuang-gru-ln")
    objective = {"supervised": 0.12 * (not fit), "simclr": 0.0, "simsiam": -0.06, "ae": -0.09}
    value += objective.get(run["objective"], -0.12)
    value -= 0.1 * (run["augmentation"] == "image") + 0.08 * (fit and run["masking"] > 0)
    hero = ("zhuang-intersection-ln-small", "simclr") if fit else ("zhuang-small+gpt", "supervised")
    value += 0.09 * ((run["model"], run["objective"]) == hero)
    return 0.45 + sign * value


def draw_trainings(sign: float) -> list[dict[str, Any]]:
    """Return the lines of a campaign; the standard deviation over seeds of training is .004."""
    rng = np.random.default_rng(0)
    lines = []
    for place, run in enumerate(networks()):
        top5 = float(np.clip(truth(run, sign) + rng.normal(0, 0.004), 0.01, 0.99))
        variant = f".{run['augmentation']}" if run["augmentation"] == "image" else ""
        variant += ".masked75" if run["masking"] else ""
        lines.append(
            {
                "name": f"{run['model']}.{run['objective']}{variant}.seed{run['seed']}", **run, "epochs": 30,
                "learning_rate": 1e-3, "search": {"0.001": 0.5}, "evaluation": _evaluation(top5),
                "twin_evaluation": None, "parameters": 1_000_000 + 1000 * place, "status": "finished",
                "data": {"hash": "abcd", "classes": 54, "train": 100_000, "validation": 10_000, "test": TEST_SWEEPS},
            }
        )  # fmt: skip
    for name, top5 in (("raw-input", 0.45 - sign * 0.2), ("random-features", 0.45 - sign * 0.25)):
        lines.append({"name": name, "objective": "baseline", "evaluation": _evaluation(top5)})
    return lines


def draw_records(sign: float, *, noise: float = 0.01, synthetic: bool = False, seed: int = 0) -> list[ResultRecord]:
    """Return one record for each training of the campaign, on one board of six animals and twelve stimuli."""
    runs = networks()
    truths = {str(place): truth(run, sign, fit=True) for place, run in enumerate(runs)}
    drawn = draw_board(truths, animals=6, stimuli=12, noise=noise, spread=noise, raw=0.45 - sign * 0.3, seed=seed)
    found = []
    for place, (run, record) in enumerate(zip(runs, drawn, strict=True)):
        trained = run["objective"] != "untrained"
        name = f"{run['model']}.{run['objective']}" if trained else run["model"]
        depth = [record.score.value + sign * 0.01 * i for i in range(4)]
        layers = [LayerScore(f"{part}.block{i + 1}", v, v) for i, v in enumerate(depth) for part in ("attender",)]
        score = replace(record.score, name=name, layers=tuple(layers))
        card = ModelCard(
            name, "zhuang", run["objective"], run["augmentation"] if trained else None, 1_000_000 + 1000 * place,
            top1=truth(run, sign) / 2, top5=truth(run, sign), twin=run["model"], seed=run["seed"],
            weights=str(place), encoder=run["model"].partition("-small")[0],
            training={"masking": run["masking"]} if trained else {},
        )  # fmt: skip
        found.append(replace(record, score=score, card=card, synthetic=synthetic))
    return found


def write_campaign(folder: Path, lines: Iterable[dict[str, Any]] = (), records: Iterable[ResultRecord] = ()) -> Path:
    """Write a campaign into a folder."""
    (folder / "records").mkdir(parents=True)
    (folder / "trainings.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    for record in records:
        write_record(record, folder / "records")
    return folder


def draw_campaign(sign: float, **changes: Any) -> Any:
    """Return a campaign in which every published effect has this sign; ``changes`` go to its records."""
    trainings = [msgspec.convert(line, CAMPAIGN.Training) for line in draw_trainings(sign)]
    return CAMPAIGN.join_campaign(trainings, draw_records(sign, **changes))


def _evaluation(top5: float) -> dict[str, Any]:
    top1 = top5 / 2
    interval = {"low": top1 - 0.01, "high": top1 + 0.01, "level": 0.95, "method": "Wilson score"}
    return {
        "top1": top1, "top5": top5, "count": TEST_SWEEPS, "interval": interval, "collapsed": False, "reason": "",
        "predicted": 54, "spread": 1.0, "data": "abcd",
    }  # fmt: skip
