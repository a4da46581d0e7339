"""Whole training steps as CUDA graphs: thousands of small kernels launched by one call.

A recurrent network of 22 steps launches some ten thousand kernels per optimiser step, and on a fast GPU the launching
takes longest. A captured step reads its inputs from tensors that stay in place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import nn

from brainbench.models.cells import GatedCell

WARM_UP = 3
"""Runs before a capture: they choose algorithms, fill caches and allocate the optimiser's state."""


def captured(
    work: Callable[[], None],
    device: torch.device,
    *,
    generators: Sequence[torch.Generator] = (),
    warm_up: int = WARM_UP,
    together: Callable[[], AbstractContextManager[Any]] = nullcontext,
    alone: Callable[[], AbstractContextManager[Any]] = nullcontext,
) -> Callable[[], None]:
    """Run ``work`` a few times and record it; return what repeats it. On the CPU that is ``work`` itself.

    Args:
        work: Reads and writes tensors that stay where they are; waits for nothing and asks for no value.
        device: Where it works.
        generators: Random numbers it draws, beside PyTorch's own on the device.
        warm_up: Runs before the recording.
        together: Entered for these runs, and left before the recording.
        alone: Entered for the recording, during which nothing else may use the device.

    What the runs before the recording change (weights, counters) stays changed: see :func:`reset_optimizer`.
    """
    if device.type != "cuda":
        with together():
            for _ in range(warm_up):
                work()
        return work
    with together():
        side = torch.cuda.Stream(device)
        side.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(side):
            for _ in range(warm_up):
                work()
        torch.cuda.current_stream(device).wait_stream(side)
        side.synchronize()
    graph = torch.cuda.CUDAGraph()
    for generator in generators:
        graph.register_generator_state(generator)
    # Other threads may train on the same device meanwhile.
    with alone(), torch.cuda.graph(graph, capture_error_mode="thread_local"):
        work()
    return graph.replay


def fuse(module: nn.Module, on: bool = True) -> None:
    """Fuse what follows the convolutions of all gated cells in a module, or undo it."""
    cells = [part for part in module.modules() if isinstance(part, GatedCell)]
    if on and cells:
        import torch._dynamo

        # One version per width and batch of every cell, for training and for evaluation.
        torch._dynamo.config.recompile_limit = max(torch._dynamo.config.recompile_limit, 64)
    for cell in cells:
        cell.fuse(on)


def make_capturable(optimizer: torch.optim.Optimizer, rate: torch.Tensor) -> None:
    """Let an optimiser read its learning rate from a tensor, and keep its counters on the device.

    Args:
        optimizer: One of :data:`~brainbench.models.training.optimizers.OPTIMIZERS`, before its first step.
        rate: The learning rate [], on the device of the parameters.
    """
    for group in optimizer.param_groups:
        group["lr"] = rate
        if "fused" in group:
            group["fused"], group["foreach"] = True, False
        if "capturable" in group:
            group["capturable"] = rate.is_cuda


@torch.no_grad()
def reset_optimizer(optimizer: torch.optim.Optimizer) -> None:
    """Put all moments and counters back to zero, in place."""
    for entries in optimizer.state.values():
        for value in entries.values():
            if isinstance(value, torch.Tensor):
                value.zero_()


@torch.no_grad()
def copy_state(module: nn.Module, state: dict[str, torch.Tensor]) -> None:
    """Copy parameters and buffers by name into a module without moving them."""
    own = module.state_dict()
    for name, value in state.items():
        own[name].copy_(value)


class Gradients:
    """The loss of a batch, its clipped gradients in the parameters, and their norm.

    Args:
        forward: Maps (views, labels) to (loss, anything).
        parameters: What is trained.
        clip: Largest norm; 0 leaves it alone.
        autocast: Makes the context of the forward pass.
        record: Record the pass for the shape that comes first, and replay it whenever that shape comes again.
        module: Whose buffers a pass changes, put back after the runs that precede a recording.
    """

    def __init__(
        self,
        forward: Callable[..., Any],
        parameters: Sequence[nn.Parameter],
        *,
        clip: float,
        autocast: Callable[[], Any],
        record: bool = False,
        module: nn.Module | None = None,
    ) -> None:
        self.forward, self.parameters, self.clip, self.autocast = forward, tuple(parameters), clip, autocast
        self.record, self.module = record, module
        self._inputs: tuple[torch.Tensor, ...] = ()
        self._kept: list[torch.Tensor | None] = []
        self._found = (torch.empty(()), torch.empty(()))

    def __call__(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (loss, norm of the gradients before clipping), not yet waited for."""
        given = (*views, labels)
        if not self.record:
            return self._compute(given)
        if not self._inputs:
            self._record(given)
        if [item.shape for item in given] != [item.shape for item in self._inputs]:
            return self._compute(given)
        for mine, item in zip(self._inputs, given, strict=True):
            mine.copy_(item)
        self._replay()
        # The recorded pass writes to these, whatever stood in the parameters meanwhile.
        for parameter, gradient in zip(self.parameters, self._kept, strict=True):
            parameter.grad = gradient
        return self._found

    def _compute(self, given: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        for parameter in self.parameters:
            parameter.grad = None
        with self.autocast():
            loss, _ = self.forward(given[:-1], given[-1])
        loss.backward()
        trained = [parameter for parameter in self.parameters if parameter.grad is not None]
        return loss.detach(), torch.nn.utils.clip_grad_norm_(trained, self.clip or float("inf"))

    def _record(self, given: tuple[torch.Tensor, ...]) -> None:
        device = given[0].device
        self._inputs = tuple(item.clone() for item in given)
        buffers = {name: value.clone() for name, value in self.module.named_buffers()} if self.module else {}
        random = torch.cuda.get_rng_state(device) if device.type == "cuda" else torch.get_rng_state()

        def work() -> None:
            self._found = self._compute(self._inputs)
            self._kept = [parameter.grad for parameter in self.parameters]

        self._replay = captured(work, device)
        if device.type == "cuda":
            torch.cuda.set_rng_state(random, device)
        else:
            torch.set_rng_state(random)
        if self.module is not None:
            copy_state(self.module, buffers)
