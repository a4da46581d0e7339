"""Records of students for a leaderboard, and the commands that make them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from brainbench.core.files import content_hash, provenance
from brainbench.core.provenance import Provenance
from brainbench.core.records import ModelCard, ResultRecord, Score, SubjectScore
from robotics_bridge.policies.report.results import StudentResult
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.tasks.task import TASK_VERSION


def command(config: DistillConfig, *, stop_at: int | None = None) -> str:
    """Return the command line that distils a student up to ``stop_at``, but for what only a file of students sets."""
    usual = DistillConfig(task=config.task)
    words: dict[str, Any] = {"teacher": config.teacher, "config": config.variant, "observe": config.observe}
    if config.tactile is not None:
        words |= {"placement": config.placement, "resolution": config.resolution, "encoder": config.encoder}
        words |= {"noisy": "" if config.noisy else None}
        words |= {name: config.encoder_settings.get(name) for name in ("learning", "time", "pretrained", "units")}
        words |= {"draw": config.encoder_settings.get("seed")}
        words |= {"unroll": config.encoder_settings.get("options", {}).get("unroll")}
    words |= {"contacts": config.contacts, "embedder": config.embedder, "hand": config.hand, "envs": config.num_envs}
    words |= {"seed": config.seed, "precision": config.precision, "iterations": config.iterations}
    words |= {"learning-rate": config.learning_rate, "epochs": config.epochs, "start": config.start}
    words |= {"hidden": ",".join(map(str, config.hidden)) if config.hidden != usual.hidden else None}
    words |= {"stop-at": stop_at if stop_at != config.iterations else None}
    given = {
        name: value
        for name, value in words.items()
        if value is not None
        and value != getattr(usual, {"config": "variant", "envs": "num_envs"}.get(name, name), None)
    }
    text = " ".join(f"--{name} {value}".rstrip() for name, value in given.items())
    return f"brainbench policy distill {config.task} {text}".rstrip()


def records(results: Sequence[StudentResult]) -> list[ResultRecord]:
    """Return one result record per group of students, for a leaderboard.

    A board is a task on a hand under a contact model: its recordings are the evaluation protocol, its animals the
    training seeds. A record is ``unreliable`` where fewer than :data:`FEWEST_SEEDS` students were trained.
    """
    found = []
    for result in results:
        config, tactile = result.config, result.config.tactile
        protocol = {"task": config.task, "hand": config.hand, "variant": config.variant}
        source = "{task} on {hand} ({variant})".format(**protocol)
        if config.contacts not in (None, "published"):  # records of versions before know no other contacts
            protocol["contacts"] = config.contacts
            source = f"{source}, {config.contacts} contacts"
        # Records of version 1 do not state it.
        protocol["task_version"] = str(TASK_VERSION)
        source = f"{source}, version {TASK_VERSION} of the tasks"
        name = result.name
        commands = [
            command(replace(one, teacher=config.teacher), stop_at=learned)
            for one, learned in zip(result.configs, result.learned, strict=True)
        ]
        settings = {
            "episodes": result.episodes, "metric": result.metric, "iterations_learned": result.iterations,
            "seeds": list(result.seeds), **{f"mean_{name}": mean for name, (mean, _) in result.graded.items()},
            **asdict(config),
        }  # fmt: skip
        facts = {
            "recordings": {"source": source, "content_hash": content_hash(protocol)},
            "settings": settings,
            "command": "; ".join(commands),
        }
        score = Score(
            name=name,
            value=result.value,
            status="unreliable" if result.note else "ok",
            reasons=(result.note,) if result.note else (),
            interval=result.interval,
            subjects=tuple(
                SubjectScore(f"seed {one.seed}{f', {one.draw}' * result.nested}", share, math.nan, math.nan)
                for one, share in zip(result.configs, result.success, strict=True)
            ),
            estimator="policy-success",
            metric="share of successful episodes",
            provenance=Provenance.of(provenance(**facts)),
        )
        card = ModelCard(
            name=name, family="policy", objective="distillation", seed=config.seed,
            encoder=tactile.arm if tactile is not None else None, attender="none",
        )  # fmt: skip
        found.append(ResultRecord(score, card=card))
    return found
