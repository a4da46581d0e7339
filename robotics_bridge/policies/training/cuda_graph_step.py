"""A gradient step on a few control steps, recorded once as a CUDA graph and replayed: its launches took most of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import nn

_LOG = logging.getLogger(__name__)
_WARM = 3
"""Steps taken as they are before one is recorded: they choose algorithms and allocate the optimiser's state."""

Tensors = dict[str, torch.Tensor]


class ChunkStep:
    """Forward, backward, clipping and a step of the optimiser, on data of always the same shapes.

    Args:
        loss: Maps the data to the parts of the loss, by name, and the memory after it.
        parameters: What is learned.
        optimizer: Of the parameters; capturable where it is recorded.
        clip: Largest norm of the gradients; None leaves them alone.
        record: Record and replay, on CUDA. A step that cannot be recorded runs as it is, and says so.
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
        self._record, self._left = record, _WARM
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: Tensors = {}
        self._result: tuple[Tensors, torch.Tensor] = {}, torch.empty(0)

    def __call__(self, given: Tensors) -> tuple[Tensors, torch.Tensor]:
        """Take a step; return the parts of the loss and the memory, which the next call may overwrite."""
        shapes = {name: value.shape for name, value in given.items()}
        if not self._record or (self._inputs and shapes != {n: v.shape for n, v in self._inputs.items()}):
            return self._step(given)
        if self._graph is None:
            if not self._inputs:
                self._inputs = {name: value.clone() for name, value in given.items()}
            if self._left > 0:
                self._left -= 1
                return self._aside(given)
            if not self._try():
                return self._step(given)
        for name, value in given.items():
            self._inputs[name].copy_(value)
        self._graph.replay()  # type: ignore[union-attr]
        return self._result

    def _step(self, given: Mapping[str, torch.Tensor]) -> tuple[Tensors, torch.Tensor]:
        self._optimizer.zero_grad(set_to_none=True)
        parts, memory = self._loss(given)
        torch.stack(list(parts.values())).sum().backward()
        if self._clip is not None:
            nn.utils.clip_grad_norm_(self._parameters, self._clip)
        self._optimizer.step()
        return {name: value.detach() for name, value in parts.items()}, memory.detach()

    def _aside(self, given: Mapping[str, torch.Tensor]) -> tuple[Tensors, torch.Tensor]:
        # On a stream of its own, as recordings are: what backward keeps must not lead to the default one.
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            result = self._step(given)
        torch.cuda.current_stream().wait_stream(side)
        return result

    def _try(self) -> bool:
        graph = torch.cuda.CUDAGraph()
        torch.cuda.synchronize()
        self._optimizer.zero_grad(set_to_none=True)
        try:
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                self._result = self._step(self._inputs)
        except RuntimeError as error:
            _LOG.warning("Learning cannot be recorded as a CUDA graph and runs launch by launch: %s", error)
            self._record, self._inputs = False, {}
            return False
        self._graph = graph
        return True
