"""The options of a training run, warnings against some of them, and a published search space as many runs.

Every run of a search is complete in itself and resumable, so a cluster may run them in any order and on any machines
that share the folder. Importing this module imports no framework.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from brainbench.core.errors import DataError, UsageError, check_each, check_kind, unknown_name
from brainbench.core.files import read_mapping
from brainbench.core.limits import Limit, NotNegative, Positive, limited
from brainbench.core.runs.folder import RUN
from brainbench.core.runs.log import read_log
from brainbench.models.recipes import (
    BATCH_SIZE,
    EPOCHS,
    OBJECTIVES,
    Architecture,
    Objective,
    Optimizer,
    Schedule,
    is_path,
    recipe_for,
)
from brainbench.models.registry import locate_model
from brainbench.models.training.checkpoints import DType

_Times = Annotated[int, Limit(least=0, most=2**31 - 1)]


@limited
class TrainingConfig:
    """One training run. :meth:`published` fills in the published recipe."""

    model: str
    """Registry name without a tag."""
    objective: Objective = "supervised"
    """``supervised``, ``simclr``, ``simsiam`` or ``ae``; ``simsiam-warmup`` names a recipe of its own."""
    optimizer: Optimizer = "sgd"
    """``sgd``, ``adam``, ``adamw`` or ``lars``."""
    schedule: Schedule = "step"
    """``step``, ``constant`` or ``cosine``."""
    learning_rate: Positive = 1e-2
    """Highest learning rate."""
    warmup_epochs: _Times = 0
    """Epochs in which the rate of the ``cosine`` schedule rises from 1e-4 of its highest."""
    epochs: Annotated[int, Limit(least=1, most=2**31 - 1)] = EPOCHS
    """Passes through the training sweeps (published: 100)."""
    batch_size: Annotated[int, Limit(least=2, most=2**31 - 1)] = BATCH_SIZE
    """Sweeps per optimiser step, over all processes."""
    decoder: str = "linear"
    """One of :data:`~brainbench.models.parts.DECODERS`."""
    augmentation: Literal["none", "physical", "thesis", "image"] = "physical"
    """``none``, ``physical``, ``thesis`` or ``image`` (:class:`~brainbench.models.training.batches.Augmentation`)."""
    masking: Annotated[float, Limit(least=0, below=1)] = 0.0
    """Share of masked time steps (published with 0.75)."""
    precision: Literal["auto", "float32", "bf16"] = "auto"
    """``float32``, ``bf16`` (mixed precision with float32 weights), or ``auto``: bf16 on CUDA and float32 on the CPU,
    where PyTorch's half-precision gradients of small convolutions are slower and now and then not finite."""
    compile: Literal["off", "parts", "default", "graphs"] = "off"
    """``off``, ``parts`` (torch.compile of cells and blocks, each once: quick to compile), ``default`` (of the whole
    unrolled step) or ``graphs`` (cells fused, and on CUDA the whole step recorded as a CUDA graph: the fastest)."""
    clip: NotNegative = 1.0
    """Largest norm of the gradient; 0 leaves it alone."""
    probe_epochs: _Times = 100
    """Epochs of the linear probe after a self-supervised objective; 0 for none."""
    seed: _Times = 0
    """Seed of weights, order, augmentation and dropout."""
    checkpoint_seconds: NotNegative = 60.0
    """Time (s) between saved states within an epoch, 0 for none there; the end of every epoch saves too."""
    weights_dtype: Literal["auto", DType] = "auto"
    """Precision of the published weights: ``float32``, ``float16``, ``bfloat16``, or ``auto``: bfloat16 where the run
    trains in bf16 (half the size), else float32."""

    @classmethod
    def published(cls, model: str, objective: str = "supervised", **changes: Any) -> TrainingConfig:
        """Return the published recipe of an architecture and an objective, with changes."""
        check_start(model)
        objective, _, variant = objective.partition("-")
        recipe = recipe_for(model, objective)
        setting = recipe.setting
        if variant == "warmup" and objective == "simsiam":
            setting = replace(setting, warmup_epochs=10)
        elif variant:
            raise unknown_name("objective", f"{objective}-{variant}", OBJECTIVES)
        values = {"model": model, "objective": objective, "batch_size": recipe.batch_size, "epochs": recipe.epochs}
        values["decoder"] = recipe.decoder if objective == "supervised" else "linear"
        stated = {name: value for name, value in changes.items() if value is not None}
        return cls.from_mapping({**values, **vars(setting), **stated})

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> TrainingConfig:
        """Build a configuration from names and values."""
        check_each("training option", values, [field.name for field in fields(cls)])
        if "model" not in values:
            raise UsageError("A training configuration needs the option 'model'.")
        check_kind("model of a training", values["model"], str, "a name")
        return cls(**values)

    @property
    def identity(self) -> dict[str, Any]:
        """Options that must be equal for a run to be resumed: all but how often and how exactly results are stored."""
        free = ("checkpoint_seconds", "weights_dtype")
        stated = {name: value for name, value in asdict(self).items() if name not in free}
        version = 1 if is_path(self.model) else Architecture.parse(self.model).version
        # A run that was begun before its architecture changed must not go on with the new one.
        return stated if version == 1 else stated | {"version": version}


def check_start(model: str) -> None:
    """Raise UsageError unless a name is that of an untrained model, which training starts from and is compared with."""
    located = locate_model(model)
    if located.trained is not None or located.architecture.tag is not None:
        raise UsageError(
            f"Training starts from new weights, and {model!r} names trained ones: train "
            f"{located.architecture.untrained!r}."
        )


def config_warnings(config: TrainingConfig, model: Any) -> list[str]:
    """Return reasons why a run may teach nothing, each a sentence and what to do instead.

    Of its network ``spec.receptive_field`` is read, if there is one.
    """
    warnings: list[str] = []
    if config.objective not in ("simclr", "simsiam"):
        return warnings
    if config.augmentation == "none" and not config.masking:
        warnings.append(
            f"Without augmentation or masking both views of a sweep are equal, so {config.objective} has nothing to "
            "ignore: only telling sweeps apart is rewarded, without bound, and such runs tend to diverge. Choose an "
            "augmentation, or masking."
        )
    seen = getattr(getattr(model, "spec", None), "receptive_field", None)
    # These augmentations reverse time.
    if seen is not None and config.augmentation in ("physical", "thesis"):
        steps = "the last step" if seen == 1 else f"the last {seen} steps"
        warnings.append(
            f"{config.model} has no memory: its last answer sees {steps} of a sweep alone. The augmentation "
            f"{config.augmentation!r} plays half of the views backwards, which end before the whiskers touch anything "
            f"and look all alike, so the loss of {config.objective} cannot fall far. A network with memory or an "
            "attender, or the augmentation 'image', can learn."
        )
    return warnings


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
