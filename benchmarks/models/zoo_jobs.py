"""What ``train_zoo.py`` trains: a list of jobs, most valuable first."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from brainbench.models.training.config import TrainingConfig

SMALL = (
    "zhuang-intersection-ln-small",
    "zhuang-small",
    "resnet18-small",
    "s4-small+gpt",
    "zhuang-small+mamba",
    "resnet18-small+gpt",
)
"""Six combinations of encoder and attender: memory of three kinds and none; GPT, Mamba and no attender."""
VARIED = ("zhuang-intersection-ln-small", "resnet18-small")
"""Where augmentations and masking are compared: a network with memory and one without."""
FULL = (
    ("zhuang-intersection-ln", "supervised"),
    ("zhuang-intersection-ln", "simclr"),
    ("zhuang-intersection-ln+gpt", "supervised"),
    ("resnet18", "supervised"),
    ("s4", "supervised"),
)
WEIGHTS = {
    "zhuang-intersection-ln-small": 1.6,
    "zhuang-small+mamba": 1.2,
    "zhuang-small": 1.0,
    "s4-small+gpt": 0.8,
    "resnet18-small+gpt": 0.7,
    "resnet18-small": 0.5,
}
"""How training time is divided among the small networks, by what a step costs."""
SHORT = {
    "zhuang-intersection-ln-small": (130, 130),
    "zhuang-small": (340, 280),
    "zhuang-small+mamba": (200, 150),
    "s4-small+gpt": (260, 210),
    "resnet18-small+gpt": (380, 300),
    "resnet18-small": (1100, 900),
}
"""Steps (supervised, SimCLR) of a short training on a processor: one to three minutes of one core each."""
PASS = 15
"""Steps of a pass of a short training."""
SEEDS = 3
FULL_EPOCHS = 20


@dataclass(frozen=True)
class Job:
    """One network to train, or to evaluate as it is: untrained (``objective`` = ``untrained``) or as the package has it
    (``model`` with its tag)."""

    model: str
    objective: str
    seed: int = 0
    augmentation: str = "physical"
    masking: float = 0.0
    epochs: int = 100
    """At most so many; fewer where the first epoch shows that time would not allow them."""
    learning_rate: float | None = None
    """Highest; by model when None."""
    ship: bool = False
    """Its weights come back."""
    timeless: bool = False
    """It ends after its epochs, not by the share of time that is its own, so that others can be compared with it."""

    @property
    def full(self) -> bool:
        """Whether the network has its published size."""
        return "-small" not in self.model

    @property
    def weight(self) -> float:
        """Its share of training time, relative to others of its size; SimCLR trains on two views."""
        # The published sizes without recurrence over areas are several times cheaper.
        own = WEIGHTS.get(self.model, 1.0 if self.model.startswith("zhuang") else 0.35)
        return own * (1.3 if self.objective == "simclr" else 0.7)

    def short(self, factor: float) -> Job:
        """Return the job as a short training, of so many times the steps of :data:`SHORT`; epochs are passes then."""
        steps = factor * SHORT[self.model][self.objective == "simclr"]
        return dataclasses.replace(self, epochs=max(1, round(steps / PASS)))

    @property
    def trained(self) -> bool:
        """Whether it is a training."""
        return self.objective != "untrained" and "." not in self.model

    @property
    def title(self) -> str:
        """What is trained how, in all seeds."""
        if "." in self.model:
            return f"{self.model}.shipped"
        variant = "" if self.augmentation == "physical" else f".{self.augmentation}"
        variant += f".masked{self.masking * 100:.0f}" if self.masking else ""
        return f"{self.model}.{self.objective}{variant}"

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.title}.seed{self.seed}"

    def config(self, epochs: int) -> TrainingConfig:
        """Return the configuration that ``brainbench train`` would train it with.

        The published recipes are for 100 epochs: a tenth of the rate every 30 of them means nothing to a shorter run,
        so all anneal by a cosine after a tenth of warm-up, with AdamW at rates of the published (supervised) search
        spaces. SimCLR was published with LARS, under which the loss of so short a run hardly fell.
        """
        usual = 1e-3 if not self.full or self.model in ("resnet18", "s4") else 3e-4
        chosen = TrainingConfig.published(
            self.model,
            self.objective,
            epochs=epochs,
            optimizer="adamw",
            schedule="cosine",
            learning_rate=self.learning_rate or usual,
            warmup_epochs=max(1, round(0.1 * epochs)),
            decoder="linear",
            augmentation=self.augmentation,
            masking=self.masking,
            seed=self.seed,
            batch_size=256,
            weights_dtype="float16",
            probe_epochs=40,
        )
        return dataclasses.replace(chosen, compile="off")


def all_jobs(ablation: int | None = None) -> list[Job]:
    """Return every job, so ordered that a cut leaves whole results.

    Args:
        ablation: Begin with the jobs that compare augmentations, of so many epochs each.
    """
    if ablation is None:
        return list(dict.fromkeys(_jobs()))
    # The published size takes longest and may go on beside all others.
    jobs = [Job(*FULL[0], epochs=FULL_EPOCHS, timeless=True), *_compared(VARIED[0], ablation)]
    jobs += [Job(VARIED[0], "untrained")]
    jobs += [Job(f"{model}.{objective}", objective) for model in SMALL for objective in ("supervised", "simclr")]
    for job in _further():
        jobs.append(dataclasses.replace(job, epochs=ablation, timeless=True) if job.trained and not job.full else job)
    return list({job.name: job for job in reversed(jobs)}.values())[::-1]


def _jobs() -> Iterator[Job]:
    for model in SMALL:
        for objective in ("supervised", "simclr"):
            yield Job(model, objective, ship=True)
    for model in SMALL:
        yield Job(model, "untrained")
    yield from _varied(VARIED[0])
    for seed in range(1, SEEDS):
        yield from _seeds(SMALL, (seed,))
    for model, objective in FULL:
        yield Job(model, objective, epochs=FULL_EPOCHS)
        yield Job(model, "untrained")
    for model in VARIED[1:]:
        yield from _varied(model)


def _further() -> Iterator[Job]:
    """What is trained after a comparison: further seeds of the networks that are shipped, the cheapest first."""
    yield from _seeds(SMALL[:1], range(1, SEEDS))
    cheap = sorted(SMALL[1:], key=WEIGHTS.__getitem__)
    yield from _seeds(cheap[:3], range(SEEDS))
    for model, objective in FULL[3:]:
        yield Job(model, objective, epochs=FULL_EPOCHS)
        yield Job(model, "untrained")
    yield Job(FULL[0][0], "untrained")
    yield from _seeds(cheap[3:], range(SEEDS))


def _seeds(models: Iterable[str], seeds: Iterable[int]) -> Iterator[Job]:
    for model in models:
        for seed in seeds:
            for objective in ("supervised", "simclr"):
                yield Job(model, objective, seed=seed, ship=seed == 0)
            yield Job(model, "untrained", seed=seed)


def _compared(model: str, epochs: int) -> list[Job]:
    """Return the jobs of a comparison, those of two views first: they take twice as long."""
    jobs = [job for objective in ("supervised", "simclr") for job in (Job(model, objective), *_varied(model))]
    equal = [dataclasses.replace(job, epochs=epochs, ship=True, timeless=True) for job in dict.fromkeys(jobs)]
    return sorted(equal, key=lambda job: job.objective)


def _varied(model: str) -> Iterator[Job]:
    for objective in ("supervised", "simclr"):
        for augmentation in ("none", "thesis", "image"):
            yield Job(model, objective, augmentation=augmentation)
        yield Job(model, objective, masking=0.75)
