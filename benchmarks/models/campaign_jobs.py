"""Trainings of the campaign: the published combinations at equal length, the most valuable first.

Table 3.3 of the thesis gives 20 supervised networks and table 3.5 twelve for each of three self-supervised objectives.
Here they are ``-small``. Networks that carry the study's headlines have three seeds, two have the published size.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

from brainbench.models.architecture import Architecture
from brainbench.models.recipes import find_recipe, list_recipes
from brainbench.models.training.config import TrainingConfig

EPOCHS = 30
BATCH = 1024
RATES = (3e-4, 1e-3, 3e-3)
"""Learning rates that every network of seed 0 tries."""
SEARCH_EPOCHS = 2
"""Epochs of each try."""
HEADLINES = (
    "zhuang", "zhuang+gpt", "zhuang-intersection-ln", "zhuang-intersection-ln+gpt", "resnet18", "resnet18+gpt",
    "s4+gpt", "zhuang-ugrnn", "zhuang-ugrnn+gpt", "zhuang-gru", "zhuang-gru+gpt", "zhuang-lstm", "zhuang-lstm+gpt",
)  # fmt: skip
"""Architectures that the study's conclusions rest on."""
SEEDS = 3
FULL_SIZE = ("zhuang+gpt", "zhuang-intersection-ln+gpt")
VARIED = "zhuang-intersection-ln"
"""Architecture with which augmentations and masking are compared, and whose weights serve students of a hand."""
SHIPPED = (
    "resnet18-small.supervised", "resnet18-small+gpt.supervised", "resnet18-small+gpt.simclr",
    "s4-small+gpt.supervised", "zhuang-small.supervised", "zhuang-small.simclr",
    "zhuang-intersection-ln-small.supervised", "zhuang-intersection-ln-small.simclr",
)  # fmt: skip
"""Networks of seed 0 that come with the package, 15 MB in all."""
HIGHER_RATE = 1e-2
RATE_CHECKED = ("zhuang", "zhuang-ugrnn", "zhuang-intersection-ln", "resnet18", "resnet18+gpt", "s4+gpt")
"""Networks trained once more with a rate above the search, since with labels all chose its highest."""
_MILLISECONDS = {"zhuang": 16, "ugrnn": 24, "intersection": 24, "gru": 30, "lstm": 30, "resnet18": 4, "s4": 8}
_ATTENDER = {None: 0, "gpt": 13, "mamba": 8}
"""A step of 1,024 sweeps on one H200 takes about the sum of both."""


@dataclass(frozen=True)
class Job:
    """One network to train; ``untrained``: one that a probe reads as it was drawn; ``baseline``: the input itself."""

    model: str
    """Registry name."""
    objective: str
    seed: int = 0
    augmentation: str = "physical"
    masking: float = 0.0
    epochs: int = EPOCHS
    rate: float | None = None
    """Learning rate that is given; None: searched, or as seed 0 found it."""

    @property
    def trained(self) -> bool:
        """Whether it is a training."""
        return self.objective not in ("untrained", "baseline")

    @property
    def architecture(self) -> Architecture:
        """Parts of the model's name."""
        return Architecture.parse(self.model)

    @property
    def name(self) -> str:
        """Name of its folder."""
        usual = self.augmentation == augmentation_of(self.objective)
        variant = "" if usual else f".{self.augmentation}"
        variant += f".masked{self.masking * 100:.0f}" if self.masking else ""
        variant += f".rate{self.rate:g}" if self.rate is not None else ""
        return f"{self.model}.{self.objective}{variant}.seed{self.seed}"

    @property
    def seconds(self) -> float:
        """About how long training takes on one H200 with 100 steps in an epoch."""
        if not self.trained:
            return 15.0
        parts = self.architecture
        step = _MILLISECONDS[parts.cell or parts.encoder] + _ATTENDER[parts.attender] + 6 * parts.layer_norm
        step *= {"supervised": 1.0, "ae": 1.1}.get(self.objective, 1.65) * (1 if parts.small else 3.7)
        searched = self.seed == 0 and self.rate is None
        return 0.1 * step * (self.epochs + SEARCH_EPOCHS * len(RATES) * searched) + 15.0

    def shortened(self, epochs: int) -> Job:
        """Return the job with fewer epochs."""
        return dataclasses.replace(self, epochs=epochs)

    def config(self, learning_rate: float) -> TrainingConfig:
        """Return the configuration that ``brainbench train`` would train it with.

        Published rates fall to a tenth after 30 epochs, which means nothing to 30 epochs: all anneal by a cosine after
        a tenth of warm-up, with AdamW.
        """
        return dataclasses.replace(
            TrainingConfig.published(self.model, self.objective),
            epochs=self.epochs,
            batch_size=BATCH,
            optimizer="adamw",
            schedule="cosine",
            learning_rate=learning_rate,
            warmup_epochs=round(0.1 * self.epochs),
            decoder="linear",
            augmentation=self.augmentation,
            masking=self.masking,
            seed=self.seed,
            weights_dtype="bfloat16",
            probe_epochs=40,
            precision="bf16",
            compile="graphs",
        )


def augmentation_of(objective: str) -> str:
    """Return the augmentation of an objective: as published, networks that learn from labels have none."""
    return "none" if objective in ("supervised", "untrained", "baseline") else "physical"


def campaign() -> list[Job]:
    """Return every job, so ordered that a cut leaves whole comparisons."""
    return list(dict.fromkeys(_jobs()))


def _job(architecture: str, objective: str, seed: int = 0, *, small: bool = True) -> Job:
    parts = dataclasses.replace(Architecture.parse(architecture), small=small)
    return Job(str(parts), objective, seed, augmentation_of(objective))


def _published(objective: str) -> list[str]:
    names = [name for name in list_recipes(f"*.{objective}") if not name.endswith("-warmup")]
    found = [find_recipe(name).architecture for name in names]
    # Those of the headlines first.
    return sorted(found, key=lambda name: HEADLINES.index(name) if name in HEADLINES else len(HEADLINES))


def _jobs() -> Iterator[Job]:
    yield Job("raw-input", "baseline", augmentation="none")
    supervised, simclr = _published("supervised"), _published("simclr")
    for name in HEADLINES:
        yield _job(name, "supervised")
    for name in simclr:
        yield _job(name, "simclr")
    for name in supervised:
        yield _job(name, "untrained")
    for name in supervised:
        yield _job(name, "supervised")
    for seed in range(1, SEEDS):
        for name in HEADLINES:
            yield _job(name, "supervised", seed)
            yield _job(name, "untrained", seed)
    for name in _published("ae"):
        yield _job(name, "ae")
    for name in _published("simsiam"):
        yield _job(name, "simsiam")
    varied = _job(VARIED, "simclr")
    for augmentation in ("image", "thesis", "none"):
        yield dataclasses.replace(varied, augmentation=augmentation)
    yield dataclasses.replace(varied, masking=0.75)
    for name in FULL_SIZE:
        yield _job(name, "supervised", small=False)
        yield _job(name, "untrained", small=False)
    for name in RATE_CHECKED:
        yield dataclasses.replace(_job(name, "supervised"), rate=HIGHER_RATE)
    for seed in range(1, SEEDS):
        yield _job(VARIED, "simclr", seed)
