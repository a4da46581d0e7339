"""Names of architectures, ``<encoder>[-<cell>][-ln][-small][+<attender>][.<tag>]``, and how the published ones train.

Tables 3.2 to 3.5 of the reference thesis (chapter 3): 20 supervised and 12 × 3 self-supervised combinations
of encoder, attender and objective, and SimSiam again with a warmed-up schedule: 68 recipes. The thesis names
search spaces, not winners: ``search`` is the published grid and ``setting`` the point of it that
``brainbench train`` starts from. Importing this module imports no framework.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from itertools import product
from typing import Literal, get_args

from brainbench.core.errors import UsageError, brief, check_name

Objective = Literal["supervised", "simclr", "simsiam", "ae"]
OBJECTIVES: tuple[Objective, ...] = get_args(Objective)
"""Tags of trained weights: the objective they were trained with."""

_NEW = re.compile(r"[a-z0-9]+([-+][a-z0-9]+)*")
# The cell is matched lazily, so that "-ln" and "-small" at its end are not taken for a part of it.
_NAME = re.compile(
    r"(?P<encoder>[^-+.]*)(-(?P<cell>[^+.]*?))??(?P<layer_norm>-ln)?(?P<small>-small)?"
    r"(\+(?P<attender>[^.]*))?(\.(?P<tag>.*))?",
    re.DOTALL,
)


@dataclass(frozen=True)
class Architecture:
    """The parts that a model's name states; whether such a model exists is known to the registry."""

    encoder: str
    """``zhuang``, ``resnet18`` or ``s4``, or the first word of another package's model."""
    cell: str | None = None
    """Cell of a Zhuang encoder, or ``feedforward``; None: the encoder's own."""
    layer_norm: bool = False
    small: bool = False
    """At most 2.5 M parameters."""
    attender: str | None = None
    tag: str | None = None
    """Objective that the weights were trained with; None: untrained."""

    @classmethod
    def parse(cls, name: str) -> Architecture:
        """Take a name apart; ``str`` puts it together again unchanged.

        >>> Architecture.parse("zhuang-gru-ln-small+gpt.simclr")
        Architecture(encoder='zhuang', cell='gru', layer_norm=True, small=True, attender='gpt', tag='simclr')
        """
        if is_path(name):
            raise UsageError(
                f"{name!r} looks like a path, not a model's name; a model of your own is given as "
                "path/to/file.py:make_model (load_user_model in Python), a folder of trained weights as "
                "local-dir:FOLDER."
            )
        parts = re.fullmatch(_NAME, name)
        assert parts is not None, name
        flags = {name: parts[name] is not None for name in ("layer_norm", "small")}
        return cls(parts["encoder"], parts["cell"], **flags, attender=parts["attender"], tag=parts["tag"])

    def __str__(self) -> str:
        return self.untrained + (f".{self.tag}" if self.tag is not None else "")

    @property
    def untrained(self) -> str:
        """Name without the tag: what the registry builds."""
        sized = f"{self.memory_encoder}{'-small' if self.small else ''}"
        return sized + (f"+{self.attender}" if self.attender is not None else "")

    @property
    def memory_encoder(self) -> str:
        """Encoder with its cell and norm, whatever its size."""
        cell = f"-{self.cell}" if self.cell is not None else ""
        return f"{self.encoder}{cell}{'-ln' if self.layer_norm else ''}"

    @property
    def version(self) -> int:
        """Version of what the weights mean: 2 where published details changed the computation (S4, GPT), else 1.

        Version 1 of S4 normalised before its blocks, and of GPT used the exact GELU.
        """
        changed = self.encoder == "s4" or (self.attender == "gpt" and self.encoder in ("zhuang", "resnet18"))
        return 2 if changed else 1

    @property
    def full(self) -> Architecture:
        """Same architecture, at full size and untrained."""
        return replace(self, small=False, tag=None)


def is_path(name: str) -> bool:
    """Return whether a text is a path or a source with a prefix rather than a model's name."""
    return name.endswith(".py") or any(mark in name for mark in "/\\:")


def check_new_name(name: str) -> None:
    """Raise UsageError unless a model can be registered under a name."""
    if not _NEW.fullmatch(name):
        raise UsageError(f"A model name is lower-case letters and digits joined by '-' or '+'; received {brief(name)}.")


SOURCE = "thesis, tables 3.2-3.5"
EPOCHS = 100
BATCH_SIZE = 256
SIMSIAM_BATCH_SIZE = 1024
Optimizer = Literal["sgd", "adam", "adamw", "lars"]
Schedule = Literal["step", "constant", "cosine"]
OPTIMIZERS: tuple[Optimizer, ...] = get_args(Optimizer)
SCHEDULES: tuple[Schedule, ...] = get_args(Schedule)
"""``step``: a tenth every 30 epochs; ``constant``; ``cosine``: to zero, after a linear rise if there is a warm-up."""
_RATES = (1e-1, 1e-2, 1e-3, 1e-4)


@dataclass(frozen=True)
class TrainingSetting:
    """One point of a search space."""

    optimizer: str
    """A name of :data:`OPTIMIZERS`."""
    schedule: str
    """A name of :data:`SCHEDULES`."""
    learning_rate: float
    """Initial (highest) learning rate."""
    warmup_epochs: int = 0
    """Epochs over which a cosine schedule rises to it, from 1e-4 of it."""

    def __str__(self) -> str:
        warm = f", {self.warmup_epochs} epochs of warm-up" if self.warmup_epochs else ""
        return f"{self.optimizer}, {self.schedule}{warm}, learning rate {self.learning_rate:g}"


@dataclass(frozen=True)
class PublishedTraining:
    """Published way to train one architecture with one objective."""

    architecture: str
    """Registry name."""
    objective: str
    """``supervised``, ``simclr``, ``simsiam`` or ``ae``."""
    setting: TrainingSetting
    search: tuple[TrainingSetting, ...]
    variant: str = ""
    """``warmup`` for SimSiam with a warmed-up schedule."""
    decoder: str = "linear"
    """Decoder of the supervised objective; self-supervised networks are read by a linear probe."""
    batch_size: int = BATCH_SIZE
    epochs: int = EPOCHS
    source: str = SOURCE

    @property
    def name(self) -> str:
        """``architecture.objective[-variant]``."""
        return self.model + (f"-{self.variant}" if self.variant else "")

    @property
    def model(self) -> str:
        """Name of the model that it trains, ``architecture.objective``."""
        return f"{self.architecture}.{self.objective}"


PROBE = TrainingSetting("sgd", "step", 0.1)  # the linear probe on a frozen network: 100 epochs, batch 256


def list_recipes(pattern: str = "*") -> list[str]:
    """Return the names of the recipes that match a shell pattern, such as ``*.simclr``."""
    return [name for name in _recipes() if fnmatchcase(name, pattern)]


def find_recipe(name: str) -> PublishedTraining:
    """Return the recipe ``architecture.objective[-warmup]``."""
    check_name("recipe", name, _recipes(), hint="See them all with: brainbench models recipes")
    return _recipes()[name]


def recipe_for(architecture: str, objective: str) -> PublishedTraining:
    """Return the published recipe, or for an architecture without one that of its nearest published relative.

    A ``-small`` model is trained like the full one. Other architectures follow the row of their attender.
    """
    recipes = _recipes()
    full = Architecture.parse(architecture).full
    if (name := f"{full}.{objective}") in recipes:
        return replace(recipes[name], architecture=architecture)
    objectives = tuple(dict.fromkeys(recipe.objective for recipe in recipes.values()))
    check_name("objective", objective, objectives)
    relative = f"zhuang{'+' + full.attender if full.attender in ('gpt', 'mamba') else ''}.{objective}"
    if full.layer_norm and not full.attender and objective == "supervised":
        relative = "zhuang-intersection-ln.supervised"
    return replace(recipes[relative], architecture=architecture, source=f"as {relative} of {SOURCE}")


@cache
def _recipes() -> dict[str, PublishedTraining]:
    return {recipe.name: recipe for recipe in (*_supervised(), *_self_supervised())}


def _grid(
    optimizers: tuple[str, ...], schedule: str, rates: tuple[float, ...], warmup: int = 0
) -> tuple[TrainingSetting, ...]:
    return tuple(TrainingSetting(optimizer, schedule, rate, warmup) for optimizer, rate in product(optimizers, rates))


def _supervised() -> Iterator[PublishedTraining]:
    """Table 3.3, row by row."""
    sgd = TrainingSetting("sgd", "step", 1e-2)
    yield PublishedTraining("resnet18", "supervised", sgd, _grid(("sgd",), "step", _RATES[:3]), decoder="all-steps")
    search = (*_grid(("sgd",), "step", _RATES), *_grid(("sgd",), "constant", (1e-2, 5e-3)))
    yield PublishedTraining("zhuang", "supervised", sgd, search)
    adamw = TrainingSetting("adamw", "step", 1e-3)
    for cell in ("ugrnn", "intersection", "gru", "lstm"):
        search = _grid(("sgd", "adam", "adamw"), "step", _RATES)
        yield PublishedTraining(f"zhuang-{cell}", "supervised", adamw, search)
        yield PublishedTraining(f"zhuang-{cell}-ln", "supervised", adamw, _grid(("adamw",), "step", _RATES))
    cosine = TrainingSetting("adamw", "cosine", 1e-4, 10)
    search = (cosine, *_grid(("sgd", "adamw"), "step", _RATES[:3]))
    encoders = ("resnet18", "zhuang", "zhuang-ugrnn", "zhuang-intersection-ln", "zhuang-gru", "zhuang-lstm", "s4")
    for encoder in encoders:
        yield PublishedTraining(f"{encoder}+gpt", "supervised", cosine, search)
    for encoder in ("resnet18", "zhuang", "s4"):
        yield PublishedTraining(f"{encoder}+mamba", "supervised", cosine, search)


def _self_supervised() -> Iterator[PublishedTraining]:
    """Table 3.4 for every architecture of table 3.5."""
    names = ["zhuang", "zhuang-ugrnn", "zhuang-intersection-ln", "zhuang-gru", "zhuang-lstm"]
    names += [f"{encoder}+gpt" for encoder in ("resnet18", "zhuang-intersection-ln", "zhuang", "s4")]
    names += [f"{encoder}+mamba" for encoder in ("resnet18", "zhuang", "s4")]
    for name in names:
        warm = _grid(("lars",), "cosine", _RATES, 10)
        yield PublishedTraining(name, "simclr", warm[0], warm)
        for variant, warmup in (("", 0), ("warmup", 10)):
            search = _grid(("sgd",), "cosine", _RATES, warmup)
            yield PublishedTraining(name, "simsiam", search[1], search, variant, batch_size=SIMSIAM_BATCH_SIZE)
        search = _grid(("sgd",), "step", _RATES)
        yield PublishedTraining(name, "ae", search[1], search)
