"""Rollouts: observations, actions and the teacher's actions as [T, B, …] tensors of one iteration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file

from brainbench.core.writing.tensors import write_tensors


@dataclass
class Rollout:
    """T control steps of B environments."""

    parts: dict[str, torch.Tensor]
    """By name [T, B, …]: observation groups that the student or its decoders read; ``features`` [F] of a frozen encoder
    in place of the readings; actions [A] of ``teacher`` and ``student``; ``ended``: an episode did after the step."""
    memory: torch.Tensor
    """The student's memory [B, H] before the first step."""

    @property
    def steps(self) -> int:
        """T."""
        return len(self.parts["teacher"])

    def chunk(self, first: int, length: int) -> dict[str, torch.Tensor]:
        """Return the steps from one on, ``length`` or what is left: views [L, B, …] of all but the memory."""
        return {name: value[first : first + length] for name, value in self.parts.items()}

    def save(self, path: Path) -> None:
        """Write the rollout to a safetensors file."""
        write_tensors(path, {**self.parts, "memory": self.memory})

    @classmethod
    def load(cls, path: Path, device: torch.device) -> Rollout:
        """Read what :meth:`save` wrote."""
        parts = {name: value.to(device) for name, value in load_file(path).items()}
        return cls(parts, parts.pop("memory"))


class Recorder:
    """Collects the steps of a rollout in tensors of their final size."""

    def __init__(self, steps: int, memory: torch.Tensor) -> None:
        self.rollout = Rollout({}, memory.clone())
        self._steps, self._step = steps, 0

    def put(self, **values: torch.Tensor) -> None:
        """Keep values of the present step."""
        parts = self.rollout.parts
        for name, value in values.items():
            if name not in parts:
                parts[name] = torch.empty(self._steps, *value.shape, dtype=value.dtype, device=value.device)
            parts[name][self._step].copy_(value)

    def next(self) -> None:
        """Go on to the next step."""
        self._step += 1
