"""One student from its configuration alone: environment, teacher, distillation, evaluation."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import read_json, read_mapping, write_json
from brainbench.core.progress import Progress, track
from robotics_bridge import tasks
from robotics_bridge.policies.contract import check_version, with_contacts_of
from robotics_bridge.policies.encoders.arms import ARMS, EncoderConfig
from robotics_bridge.policies.encoders.taxel_grid import CONTROL_SUB_STEP, HandCalibration
from robotics_bridge.policies.evaluate import Policy, evaluate
from robotics_bridge.policies.shipped import list_policies
from robotics_bridge.policies.training.distill import CONFIG, DistillResult, distill, load_student
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.policies.training.teacher import load_teacher
from robotics_bridge.tasks.settings import CONTACTS, contacts_name

_log = logging.getLogger(__name__)

EVALUATION = "evaluation.json"
"""File of a student's evaluations."""
GRADED = ("metric", "goals", "turn_rate", "seconds", "returns", "dropped")
"""Quantities of an episode beside its success."""
SEEDS = (1000, 1001, 1002)
"""Seeds of the environments in which students are evaluated; none of them is one of training."""
_CALIBRATION_STEPS, _CALIBRATION_ENVS = 80, 64
"""Two seconds of control, in so many environments."""


@dataclass(frozen=True)
class Student:
    """A student that was distilled, and how it does."""

    folder: Path
    result: DistillResult
    evaluations: tuple[dict[str, Any], ...]
    """One per evaluation seed; empty when none was asked for, or the run diverged."""

    @property
    def success(self) -> float | None:
        """Share of successful episodes; None without any."""
        return success_of(self.evaluations)


def success_of(evaluations: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the share of successful episodes of some evaluations; None without any."""
    episodes = [value for evaluation in evaluations for value in evaluation["success"]]
    return sum(episodes) / len(episodes) if episodes else None


def train_student(
    config: DistillConfig,
    out: str | Path,
    *,
    device: str = "cpu",
    episodes: int = 100,
    evaluations: int = len(SEEDS),
    stop_after: float | None = None,
    stop_at: int | None = None,
    progress: Progress | None = None,
) -> Student:
    """Distil a student, or go on with an interrupted one, and evaluate it, also when its time is over.

    Args:
        config: What is distilled; ``teacher`` names a folder or a shipped one.
        out: The run's folder; a finished and evaluated run is left as it is.
        device: ``cpu``, or ``cuda`` for MuJoCo Warp.
        episodes: Per evaluation seed; 0 evaluates nothing. An evaluation says how many iterations the student had.
        evaluations: How many of :data:`SEEDS` it is evaluated with.
        stop_after: Seconds; this and the next as of :func:`~robotics_bridge.policies.training.distill.distill`.
        stop_at: Iterations.
        progress: Called with (done, in all, what).
    """
    if not config.teacher:
        raise UsageError(
            "A student needs a teacher: the folder of a run of brainbench policy train, or a shipped one "
            f"({', '.join(list_policies('teacher'))})."
        )
    out = Path(out)
    task = tasks.load(config.task, config.variant)
    if config.contacts is not None:
        task = replace(task, contacts=CONTACTS[config.contacts])
    elif config.variant != "published":
        task = with_contacts_of(task, [config.teacher])
    if config.law == "published":
        task = replace(task, taxel_twist=tasks.load(config.task, "published").taxel_twist)
    if config.tactile is not None and config.tactile.time == "resampled" and task.solver.timestep != CONTROL_SUB_STEP:
        raise UsageError(
            f"time='resampled' is for readings every {CONTROL_SUB_STEP:g} s; those of {config.task!r} come every "
            f"{task.solver.timestep:g} s. Use time='native'."
        )
    env = tasks.make(
        task, num_envs=config.num_envs, device=device, hand=config.hand, observe=config.observe,
        placement=config.placement, resolution=config.resolution, noisy=config.noisy,
        seed=config.seed,
    )  # fmt: skip
    contacts = contacts_name(task.contacts)
    config = replace(config, contacts=contacts if contacts in CONTACTS else None)
    teacher = load_teacher(config.teacher, env)
    config = calibrated(config, env, teacher, out)
    result = distill(config, out, env=env, teacher=teacher, stop_after=stop_after, stop_at=stop_at, progress=progress)
    if result.status == "diverged" or not episodes:
        return Student(out, result, ())
    return Student(out, result, evaluate_student(out, env, episodes, result.iterations, progress, evaluations))


def is_done(config: DistillConfig, out: Path, stop_at: int | None = None) -> bool:
    """Return whether a folder holds this very student, evaluated after its last iteration, or after ``stop_at``."""
    if not (out / EVALUATION).is_file():
        return False
    mine = config.resolved(tasks.load(config.task, config.variant).student)
    described = read_mapping(out / CONFIG)
    check_version(described, str(out))
    stored = DistillConfig.of(described.get("distill", {}))
    # Contacts and calibration that a student does not state are chosen when it begins.
    settings = {**stored.encoder_settings, **mine.encoder_settings}
    mine = replace(mine, encoder_settings=settings, contacts=mine.contacts or stored.contacts)
    total = stored.iterations or 0
    rows = read_json(out / EVALUATION)
    return mine == stored and all(row.get("iterations", total) >= min(total, stop_at or total) for row in rows)


def calibrated(config: DistillConfig, env: Any, teacher: Any, out: Path) -> DistillConfig:
    """Return the configuration with a hand calibration for a network, measured while the teacher acts.

    Nothing changes for encoders that are learned with the policy, or where a calibration is given. A run that was
    begun keeps the one it began with.
    """
    tactile = config.tactile
    if tactile is None or tactile.arm in ARMS or "calibration" in config.encoder_settings:
        return config
    if (out / CONFIG).is_file():
        measured = read_mapping(out / CONFIG).get("distill", {}).get("encoder_settings", {}).get("calibration")
    else:
        measured = asdict(_measure(tactile, env, teacher))
    settings = {} if measured is None else {"calibration": measured}
    return replace(config, encoder_settings={**config.encoder_settings, **settings})


def _measure(tactile: EncoderConfig, env: Any, teacher: Any) -> HandCalibration:
    """Return the unit of force and moment of two seconds in which the teacher acts."""
    grid = tactile.grid().to(env.device)
    observations, felt = env.reset(), []
    for _ in range(_CALIBRATION_STEPS):
        felt.append(grid(observations["tactile"][:_CALIBRATION_ENVS]).cpu())
        observations, *_ = env.step(teacher(observations))
    try:
        return HandCalibration.fit(torch.stack(felt))
    except DataError:
        _log.warning("The teacher touched nothing in %d steps; the default calibration is used.", _CALIBRATION_STEPS)
        return HandCalibration()


def evaluate_student(
    folder: str | Path, env: Any, episodes: int, iterations: int, progress: Progress | None, evaluations: int
) -> tuple[dict[str, Any], ...]:
    """Run whole episodes with a student and write ``evaluation.json``, one entry per seed of the first ``evaluations``.

    An entry lists per episode ``success``, ``metric``, ``returns``, ``goals``, ``turn_rate`` (rad/s), ``seconds`` and
    ``dropped`` (:class:`~robotics_bridge.policies.evaluate.PolicyEvaluation`), and holds the ``iterations`` learned
    so far.
    """
    student, _ = load_student(folder, device=str(env.device))
    policy, rows = Policy(student), []
    for seed in track(SEEDS[:evaluations], "evaluating", progress):
        result = evaluate(env, policy, episodes=episodes, seed=seed, name=Path(folder).name)
        rows.append(
            {
                "seed": seed, "success": [float(item) for item in result.success], "diverged": result.diverged,
                "iterations": iterations,
                **{name: [float(item) for item in getattr(result, name)] for name in GRADED},
            }
        )  # fmt: skip
    write_json(Path(folder) / EVALUATION, rows)
    return tuple(rows)
