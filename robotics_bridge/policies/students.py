"""One student from its configuration alone: environment, teacher, distillation, evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brainbench.errors import UsageError
from brainbench.files import write_json
from brainbench.types import Progress
from robotics_bridge.policies.distill import DistillResult, StudentPolicy, distill, load_student
from robotics_bridge.policies.distill_config import DistillConfig
from robotics_bridge.policies.report import EVALUATION

SEEDS = (1000, 1001, 1002)
"""Seeds of the environments in which students are evaluated; none of them is one of training."""


@dataclass(frozen=True)
class Student:
    """A student that was distilled, and how it does."""

    folder: Path
    result: DistillResult
    evaluations: tuple[dict[str, Any], ...]
    """One per evaluation seed; empty when the run is not finished."""


def train_student(
    config: DistillConfig,
    out: str | Path,
    *,
    device: str = "cpu",
    episodes: int = 100,
    seeds: Sequence[int] = SEEDS,
    stop_after: float | None = None,
    progress: Progress | None = None,
) -> Student:
    """Distil a student, or go on with an interrupted one, and evaluate it when it is finished.

    Args:
        config: What is distilled; ``teacher`` names a folder.
        out: The run's folder; a finished and evaluated run is left as it is.
        device: ``cpu``, or ``cuda`` for MuJoCo Warp.
        episodes: Per evaluation seed; 0 evaluates nothing.
        seeds: Of the evaluation.
        stop_after: Seconds after which the state is saved.
        progress: Called with (done, in all, what).

    Raises:
        UsageError: no teacher is named, or something does not fit.
        DataError: a file is missing or damaged.
    """
    from robotics_bridge import tasks
    from robotics_bridge.policies.teacher import load_teacher

    if not config.teacher:
        raise UsageError("A student needs a teacher: the folder of a run of brainbench policy train.")
    out = Path(out)
    env = tasks.make(
        config.task, num_envs=config.num_envs, device=device, hand=config.hand, config=config.variant,
        observe=config.observe, placement=config.placement, resolution=config.resolution, noisy=config.noisy,
        seed=config.seed,
    )  # fmt: skip
    teacher = load_teacher(config.teacher, env)
    result = distill(config, out, env=env, teacher=teacher, stop_after=stop_after, progress=progress)
    if result.status != "finished" or not episodes:
        return Student(out, result, ())
    return Student(out, result, evaluate_student(out, env, episodes=episodes, seeds=seeds, progress=progress))


def evaluate_student(
    folder: str | Path, env: Any, *, episodes: int = 100, seeds: Sequence[int] = SEEDS, progress: Progress | None = None
) -> tuple[dict[str, Any], ...]:
    """Run whole episodes with a student and write ``evaluation.json``, one entry per seed."""
    from robotics_bridge.policies.evaluate import evaluate

    student, _ = load_student(folder, device=str(env.device))
    policy, found = StudentPolicy(student), []
    for number, seed in enumerate(seeds):
        result = evaluate(env, policy, episodes=episodes, seed=seed, name=Path(folder).name)
        found.append(
            {
                "seed": seed, "success": [float(item) for item in result.success], "metric": list(result.metric),
                "returns": list(result.returns), "diverged": result.diverged,
            }
        )  # fmt: skip
        if progress is not None:
            progress(number + 1, len(seeds), "evaluating")
    write_json(Path(folder) / EVALUATION, found)
    return tuple(found)
