"""Optimisers whose steps can be recorded as a CUDA graph, which reads numbers where they stand."""

from __future__ import annotations

import torch
from torch.optim import Optimizer


def make_capturable(optimizer: Optimizer, rate: torch.Tensor) -> None:
    """Let an optimiser read its learning rate from a tensor [] on its device, and keep its counters there."""
    for group in optimizer.param_groups:
        group["lr"] = rate
        if "fused" in group:
            group["fused"], group["foreach"] = True, False
        if "capturable" in group:
            group["capturable"] = rate.is_cuda


@torch.no_grad()
def reset_optimizer(optimizer: Optimizer) -> None:
    """Put all moments and counters back to zero, in place."""
    for entries in optimizer.state.values():
        for value in entries.values():
            if isinstance(value, torch.Tensor):
                value.zero_()
