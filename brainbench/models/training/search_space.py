"""A published search space as independent runs, one folder each.

Every run is complete in itself and resumable, so a cluster may run them in any order and on any machines that share
the folder; ``job`` picks every count-th run.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from brainbench.core.errors import DataError, UsageError
from brainbench.models.recipes import recipe_for
from brainbench.models.training.config import TrainingConfig


def sweep_runs(
    config: TrainingConfig, out: str | Path, *, job: tuple[int, int] = (0, 1), warmup: bool = False
) -> list[tuple[TrainingConfig, Path]]:
    """Return the runs of the search space published for a model and an objective, each with its folder.

    ``config`` is what all runs share; optimiser, schedule and learning rate are replaced. ``job`` is (number of this
    job from 0, number of jobs); ``warmup`` searches SimSiam's warmed-up schedule.
    """
    if not 0 <= job[0] < job[1]:
        raise UsageError(f"A job is (number, count) with 0 ≤ number < count; received {job}.")
    runs = []
    for setting in recipe_for(config.model, config.objective).search[job[0] :: job[1]]:
        if warmup:
            setting = replace(setting, warmup_epochs=10)
        warm = f"-warm{setting.warmup_epochs}" if setting.warmup_epochs else ""
        name = f"{setting.optimizer}-{setting.schedule}{warm}-{setting.learning_rate:g}-seed{config.seed}"
        runs.append((replace(config, **vars(setting)), Path(out) / name))
    return runs


def best_run(out: str | Path) -> tuple[Path, dict[str, float]]:
    """Return the folder of the best finished run of a sweep, and every finished run's score by its name.

    Scores are those of the validation data: highest accuracy, or lowest self-supervised loss. The test split has no
    say.
    """
    from brainbench.core.files import read_mapping
    from brainbench.core.runs.log import read_log
    from brainbench.models.training.trainer import RUN

    scores: dict[str, float] = {}
    costs: dict[str, float] = {}
    for path in sorted(Path(out).glob(f"*/{RUN}")):
        if read_mapping(path).get("status") != "finished":
            continue
        # Without validation data the losses of the training epochs decide.
        name, lines = path.parent.name, read_log(path.parent, "validation") or read_log(path.parent, "epoch")
        accuracies = [line["top1"] for line in lines if line.get("top1") is not None]
        losses = [line["loss"] for line in lines if line.get("loss") is not None]
        if accuracies or losses:
            scores[name] = max(accuracies) if accuracies else min(losses)
            costs[name] = -scores[name] if accuracies else scores[name]
    if not scores:
        raise DataError(f"No run in {str(out)!r} is finished.")
    return Path(out) / min(costs, key=costs.__getitem__), scores
