"""What an iteration of distillation learns from, and its gradient step: rollouts [T, B, …] and steps on parts of them.

A gradient step on a few control steps is recorded once as a CUDA graph and replayed: its launches took most of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import nn

from brainbench.core.devices import WARM_UP, CudaGraphStep, Graph, torch_recorder
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


Tensors = dict[str, torch.Tensor]


class ChunkStep:
    """Forward, backward, clipping and a step of the optimiser, on data of always the same shapes.

    ``loss`` maps the data to the parts of the loss, by name, and the memory after it; ``clip`` is the largest norm of
    the gradients. With ``record``, on CUDA, the step is recorded and replayed; one that cannot be runs as it is, and
    says so.
    """

    def __init__(
        self,
        loss: Callable[[Mapping[str, torch.Tensor]], tuple[Tensors, torch.Tensor]],
        parameters: Sequence[nn.Parameter],
        optimizer: torch.optim.Optimizer,
        *,
        clip: float | None,
        record: bool,
    ) -> None:
        self._loss, self._parameters, self._optimizer, self._clip = loss, list(parameters), optimizer, clip
        self._record, self._inputs = record, dict[str, torch.Tensor]()
        # On a stream of its own: what backward keeps must not lead to the default one.
        self._step = CudaGraphStep(
            self._descend, self._recorder, subject="Learning", warm_up=WARM_UP, aside=True, retained=None
        )

    def __call__(self, given: Tensors) -> tuple[Tensors, torch.Tensor]:
        """Take a step; return the parts of the loss and the memory, which the next call may overwrite."""
        if not self._record or self._step.failed:
            return self._descend(given)
        if not self._inputs:
            self._inputs = {name: value.clone() for name, value in given.items()}
        if any(value.shape != self._inputs[name].shape for name, value in given.items()):
            return self._descend(given)
        for name, value in given.items():
            self._inputs[name].copy_(value)
        return self._step(self._inputs)

    def _descend(self, given: Mapping[str, torch.Tensor]) -> tuple[Tensors, torch.Tensor]:
        self._optimizer.zero_grad(set_to_none=True)
        parts, memory = self._loss(given)
        torch.stack(list(parts.values())).sum().backward()
        if self._clip is not None:
            nn.utils.clip_grad_norm_(self._parameters, self._clip)
        self._optimizer.step()
        return {name: value.detach() for name, value in parts.items()}, memory.detach()

    def _recorder(self, work: Callable[[], Any]) -> tuple[Graph, Any]:
        # Gradients are then allocated in the memory of the graph.
        self._optimizer.zero_grad(set_to_none=True)
        return torch_recorder()(work)
