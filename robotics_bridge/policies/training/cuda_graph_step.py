"""A gradient step on a few control steps, recorded once as a CUDA graph and replayed: its launches took most of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import nn

from brainbench.core.cuda_graphs import WARM_UP, CudaGraphStep, Graph, torch_recorder

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
            self._descend, self._recorder, subject="Learning", warm_up=WARM_UP, aside=True, kept=None
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
