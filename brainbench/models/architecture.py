"""The name of a model, parsed: ``<encoder>[-<cell>][-ln][-small][+<attender>][.<tag>]``."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal, get_args

from brainbench.core.errors import UsageError, brief

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
