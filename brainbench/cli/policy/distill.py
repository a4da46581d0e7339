"""``brainbench policy distill``: teach a student that feels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar
from brainbench.cli.policy.options import (
    DeviceOption,
    HandOption,
    NoisyOption,
    PlacementOption,
    ResolutionOption,
    SeedOption,
    TaskArgument,
)


def distill(
    task: TaskArgument,
    teacher: Annotated[Path, typer.Option(help="A shipped teacher, or a folder of brainbench policy train.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the run; by default students/<what it is>.")] = None,
    observe: Annotated[str, typer.Option(help="Tactile observation type (table 4.3), or none.")] = "force_torque",
    placement: PlacementOption = "hand",
    resolution: ResolutionOption = "med",
    noisy: NoisyOption = False,
    encoder: Annotated[
        str, typer.Option(help="mlp, rnn, tactile_cnn, tactile_convrnn, …, or a model's name; auto as published.")
    ] = "auto",
    learning: Annotated[str, typer.Option(help="Of a model: frozen or finetuned.")] = "frozen",
    time: Annotated[str, typer.Option(help="Of a model: native or resampled to its own 9 ms.")] = "native",
    pretrained: Annotated[Path | None, typer.Option(help="Weights of a tagged model.")] = None,
    embedder: Annotated[str, typer.Option(help="Of joints and goal: none, mlp or lstm.")] = "mlp",
    hand: HandOption = "xhand1",
    variant: Annotated[str, typer.Option("--config", help="Configuration of the task: default or published.")] = (
        "default"
    ),
    envs: Annotated[int, typer.Option(help="Environments at once.")] = 4096,
    iterations: Annotated[int | None, typer.Option(help="By default the task's own (table 4.4).")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="By default the task's own (table 4.4).")] = None,
    epochs: Annotated[int | None, typer.Option(help="Over each iteration's steps; by default the task's own.")] = None,
    teacher_share: Annotated[float, typer.Option(help="Share of the teacher's actions at the start (β).")] = 0.0,
    teacher_iterations: Annotated[int, typer.Option(help="Iterations until that share is 0; 0 keeps it.")] = 0,
    aggregate: Annotated[int, typer.Option(help="Earlier rollouts that are learned from again.")] = 0,
    precision: Annotated[str, typer.Option(help="Of the tactile encoder: float32 or bf16.")] = "float32",
    save_interval: Annotated[int, typer.Option(help="Iterations between saved states.")] = 100,
    seed: SeedOption = 0,
    episodes: Annotated[int, typer.Option(help="Of the evaluation, per seed; 0 for none.")] = 100,
    device: DeviceOption = "cpu",
    stop_after: Annotated[float | None, typer.Option(help="Save, stop and evaluate after so many seconds.")] = None,
    stop_at: Annotated[int | None, typer.Option(help="Likewise after so many iterations in all.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Distil a teacher into a student that feels; a run that was interrupted goes on when it is started again."""
    from robotics_bridge.policies.encoders.arms import ARMS, AUTO
    from robotics_bridge.policies.training.distill_config import DistillConfig
    from robotics_bridge.policies.training.students import train_student

    settings: dict[str, Any] = {}
    if encoder not in (AUTO, *ARMS):
        settings = {"learning": learning, "time": time}
        if pretrained is not None:
            settings["pretrained"] = str(pretrained)
    config = DistillConfig(
        task=task, teacher=str(teacher), hand=hand, variant=variant, observe=observe, placement=placement,
        resolution=resolution, noisy=noisy, encoder=encoder, encoder_settings=settings, embedder=embedder,
        num_envs=envs, iterations=iterations, teacher_share=teacher_share, teacher_iterations=teacher_iterations,
        aggregate=aggregate, precision=precision, save_interval=save_interval, seed=seed,
        learning_rate=learning_rate, epochs=epochs,
    )  # fmt: skip
    folder = out or Path("students") / config.name
    with progress_bar() as progress:
        student = train_student(
            config, folder, device=device, episodes=episodes, stop_after=stop_after, stop_at=stop_at, progress=progress
        )
    facts = describe(student)
    lines = [f"{key}: {value}" for key, value in facts.items() if value not in ("", None)]
    emit(facts, "\n".join(lines), as_json=as_json)
    if student.result.status == "diverged":
        raise typer.Exit(1)


def describe(student: Any) -> dict[str, Any]:
    """Return what is printed about a student."""
    success = [value for item in student.evaluations for value in item["success"]]
    return {
        "folder": str(student.folder),
        "status": student.result.status,
        "reason": student.result.reason,
        "iterations": student.result.iterations,
        "loss": student.result.loss,
        "success": sum(success) / len(success) if success else None,
        "episodes": len(success),
        "seconds": round(student.result.seconds, 1),
    }
