"""Whole training steps as CUDA graphs: thousands of small kernels launched by one call.

A recurrent network of 22 steps launches some ten thousand kernels per optimiser step, and on a fast GPU the launching
takes longest. A captured step reads its inputs from tensors that stay in place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
) -> Callable[[], None]:
    """Run ``work`` a few times and record it; return what repeats it. On the CPU that is ``work`` itself.

    Args:
        work: Reads and writes tensors that stay where they are; waits for nothing and asks for no value.
        device: Where it works.
        generators: Random numbers it draws, beside PyTorch's own on the device.
        warm_up: Runs before the recording.

    What the runs before the recording change (weights, counters) stays changed: see :func:`reset_optimizer`.
    """
    if device.type != "cuda":
        for _ in range(warm_up):
            work()
        return work
    side = torch.cuda.Stream(device)
    side.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(side):
        for _ in range(warm_up):
            work()
    torch.cuda.current_stream(device).wait_stream(side)
    torch.cuda.synchronize(device)
    graph = torch.cuda.CUDAGraph()
    for generator in generators:
        graph.register_generator_state(generator)
    # Other threads may train on the same device meanwhile.
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
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
        optimizer: One of :data:`~brainbench.models.optimizers.OPTIMIZERS`, before its first step.
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
