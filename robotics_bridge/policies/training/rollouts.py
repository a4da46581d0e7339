"""Rollouts: observations, actions and the teacher's actions as [T, B, …] tensors of one iteration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from brainbench.core.files import atomic_path


@dataclass
class Rollout:
    """T control steps of B environments."""

    groups: dict[str, torch.Tensor]
    """Observation groups [T, B, …] that the student or its decoders read."""
    features: torch.Tensor | None
    """Features [T, B, F] that a frozen encoder gave, in place of the readings."""
    teacher: torch.Tensor
    """Actions [T, B, A] of the teacher."""
    student: torch.Tensor
    """Actions [T, B, A] of the student at the time."""
    ended: torch.Tensor
    """Steps [T, B] after which an episode ended."""
    memory: torch.Tensor
    """The student's memory [B, H] before the first step."""

    @property
    def steps(self) -> int:
        """T."""
        return len(self.teacher)

    def chunk(self, first: int, length: int) -> dict[str, torch.Tensor]:
        """Return the steps from one on, ``length`` or what is left: views [L, B, …] of all but the memory."""
        span = slice(first, first + length)
        parts = {name: value[span] for name, value in self.groups.items()}
        parts |= {name: getattr(self, name)[span] for name in ("teacher", "student", "ended")}
        return parts if self.features is None else {**parts, "features": self.features[span]}

    def save(self, path: Path) -> None:
        """Write the rollout to a safetensors file."""
        parts: dict[str, Any] = {f"groups.{name}": value for name, value in self.groups.items()}
        parts |= {name: getattr(self, name) for name in ("teacher", "student", "ended", "memory")}
        if self.features is not None:
            parts["features"] = self.features
        with atomic_path(path) as temporary:
            save_file({name: value.detach().cpu().contiguous() for name, value in parts.items()}, temporary)

    @classmethod
    def load(cls, path: Path, device: torch.device) -> Rollout:
        """Read what :meth:`save` wrote."""
        parts = {name: value.to(device) for name, value in load_file(path).items()}
        groups = {name.removeprefix("groups."): parts.pop(name) for name in list(parts) if name.startswith("groups.")}
        return cls(groups, parts.pop("features", None), **parts)


class Recorder:
    """Collects the steps of a rollout in tensors of their final size."""

    def __init__(self, steps: int, memory: torch.Tensor) -> None:
        self.steps, self.memory = steps, memory.clone()
        self._parts: dict[str, torch.Tensor] = {}
        self._step = 0

    def put(self, **values: torch.Tensor) -> None:
        """Keep values of the present step."""
        for name, value in values.items():
            if name not in self._parts:
                self._parts[name] = torch.empty(self.steps, *value.shape, dtype=value.dtype, device=value.device)
            self._parts[name][self._step].copy_(value)

    def next(self) -> None:
        """Go on to the next step."""
        self._step += 1

    def finish(self, groups: Iterable[str]) -> Rollout:
        """Return the rollout."""
        parts = self._parts
        features = parts.get("features")
        kept = {name: parts[name] for name in groups if name in parts}
        return Rollout(kept, features, parts["teacher"], parts["student"], parts["ended"], self.memory)
