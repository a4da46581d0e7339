"""The gradients of a training step: compiled, and on CUDA recorded as a graph.

A recurrent network of 22 steps launches some ten thousand kernels per optimiser step, and on a fast GPU the launching
takes longest; a recorded step is launched by one call and reads its inputs from tensors that stay in place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from brainbench.core.cuda_graphs import record_step
from brainbench.models.attenders import GPTBlock, MambaBlock
from brainbench.models.cells import Cell, GatedCell
from brainbench.models.encoders import BasicBlock, S4Block
from brainbench.models.ops.parameters import copy_named

PARTS = (Cell, GPTBlock, MambaBlock, S4Block, BasicBlock)
"""Modules that are compiled on their own: called at every step or block, with few shapes."""


def compiled(module: torch.nn.Module, how: str) -> Any:
    """Return a module compiled in one of the ways of :data:`~brainbench.models.training.config.COMPILE`."""
    if how == "off":
        return module
    if how == "parts":
        for part in module.modules():
            if isinstance(part, PARTS):
                part.compile()
        return module
    if how == "graphs":
        fuse(module)
        return module
    return torch.compile(module)


def fuse(module: nn.Module, on: bool = True) -> None:
    """Fuse what follows the convolutions of all gated cells in a module, or undo it."""
    cells = [part for part in module.modules() if isinstance(part, GatedCell)]
    if on and cells:
        import torch._dynamo

        # One version per width and batch of every cell, for training and for evaluation.
        torch._dynamo.config.recompile_limit = max(torch._dynamo.config.recompile_limit, 64)
    for cell in cells:
        cell.fuse(on)


class Gradients:
    """The loss of a batch, its clipped gradients in the parameters of a module, and their norm.

    What a pass does to the buffers of ``module`` is undone after the runs that precede a recording. ``forward`` is the
    module as it is computed, compiled or wrapped: (views, labels) → loss, in a context that ``autocast`` makes.
    ``clip`` is the largest norm; 0 leaves it alone. With ``record`` the pass is recorded for the shape that comes
    first, and replayed whenever that shape comes again. ``average`` replaces a vector by its mean over several
    processes, each of which then returns the loss and norm of the whole batch.
    """

    def __init__(
        self,
        module: nn.Module,
        forward: Callable[..., Any],
        *,
        clip: float,
        autocast: Callable[[], Any],
        record: bool = False,
        average: Callable[[torch.Tensor], None] | None = None,
    ) -> None:
        self.module, self.forward, self.clip, self.autocast, self.record = module, forward, clip, autocast, record
        self.average = average
        self.parameters = [parameter for parameter in module.parameters() if parameter.requires_grad]
        self._inputs: tuple[torch.Tensor, ...] = ()
        self._kept: list[torch.Tensor | None] = []
        self._found = (torch.empty(()), torch.empty(()))

    def __call__(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (loss, norm of the gradients before clipping), not yet waited for."""
        results = self._pass((*views, labels))
        return results if self.average is None else self._clip(self._averaged(results[0]))

    def _pass(self, given: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        if not self.record:
            return self._compute(given)
        if not self._inputs:
            self._record(given)
        if [item.shape for item in given] != [item.shape for item in self._inputs]:
            return self._compute(given)
        for mine, tensor in zip(self._inputs, given, strict=True):
            mine.copy_(tensor)
        self._replay()
        # The recorded pass writes to these, whatever stood in the parameters meanwhile.
        for parameter, gradient in zip(self.parameters, self._kept, strict=True):
            parameter.grad = gradient
        return self._found

    def _compute(self, given: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        for parameter in self.parameters:
            parameter.grad = None
        with self.autocast():
            loss = self.forward(given[:-1], given[-1])
        loss.backward()
        # The gradient of several processes is clipped once it is the mean of all.
        return self._clip(loss.detach()) if self.average is None else (loss.detach(), loss.detach())

    def _clip(self, loss: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        # One norm over all tensors keeps the direction of the step; an infinite limit measures it alone.
        return loss, torch.nn.utils.clip_grad_norm_(self._trained, self.clip or float("inf"))

    def _averaged(self, loss: torch.Tensor) -> torch.Tensor:
        """Average gradients and loss over processes in one vector: one collective, also beside a recorded pass."""
        gradients = [parameter.grad for parameter in self._trained if parameter.grad is not None]
        vector = torch.cat([*(item.reshape(-1).float() for item in gradients), loss.reshape(1).float()])
        if self.average is not None:
            self.average(vector)
        parts = vector.split([*(item.numel() for item in gradients), 1])
        means = [part.view_as(item) for part, item in zip(parts, gradients, strict=False)]
        torch._foreach_copy_(gradients, means)  # pyright: ignore[reportPrivateImportUsage] - a launch for all
        return parts[-1][0]

    @property
    def _trained(self) -> list[nn.Parameter]:
        return [parameter for parameter in self.parameters if parameter.grad is not None]

    def _record(self, given: tuple[torch.Tensor, ...]) -> None:
        device = given[0].device
        self._inputs = tuple(item.clone() for item in given)
        # The runs before a recording draw random numbers and move averages of batch norm; both are put back after it.
        buffers = {name: value.clone() for name, value in self.module.named_buffers()}
        random = torch.cuda.get_rng_state(device) if device.type == "cuda" else torch.get_rng_state()

        def work() -> None:
            self._found = self._compute(self._inputs)
            self._kept = [parameter.grad for parameter in self.parameters]

        self._replay = record_step(work, device)
        if device.type == "cuda":
            torch.cuda.set_rng_state(random, device)
        else:
            torch.set_rng_state(random)
        copy_named(dict(self.module.named_buffers()), buffers)
