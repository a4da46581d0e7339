"""Optimisers and learning-rate schedules by name, with the published defaults (thesis, table 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer

from brainbench.core.errors import check_name
from brainbench.core.reading.ranges import check_number
from brainbench.models.recipes import OPTIMIZERS, SCHEDULES

MOMENTUM = 0.9
WEIGHT_DECAY = 1e-4
TRUST = 1e-3
STEP_EPOCHS = 30
STEP_FACTOR = 0.1
WARMUP_RATIO = 1e-4


class LARS(Optimizer):
    """SGD with momentum whose step in every tensor is scaled to that tensor's norm (You, Gitman & Ginsburg 2017).

    trust = η ‖w‖ / (‖g + λ w‖), v ← m v + trust (g + λ w), w ← w − lr v, with momentum m, weight decay λ and ``trust``
    η. Biases and norm parameters (tensors of fewer than two axes) are excluded: they take plain momentum steps without
    decay, as in SimCLR.
    """

    def __init__(self, parameters: Iterable[Any], lr: float) -> None:
        options = {"lr": lr, "momentum": MOMENTUM, "weight_decay": WEIGHT_DECAY, "trust": TRUST}
        super().__init__(parameters, options)

    @torch.no_grad()
    def step(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Take one step."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                update = weight.grad
                # Trust ratio η ‖w‖/‖g + λ w‖ of each tensor (You, Gitman & Ginsburg 2017); 1 where either is zero.
                if weight.ndim > 1:
                    update = update + group["weight_decay"] * weight
                    size, length = weight.norm(), update.norm()
                    ratio = group["trust"] * size / length
                    update = update * torch.where((size > 0) & (length > 0), ratio, torch.ones_like(ratio))
                state = self.state[weight]
                if "velocity" not in state:
                    state["velocity"] = torch.zeros_like(weight)
                state["velocity"].mul_(group["momentum"]).add_(update)
                weight.sub_(group["lr"] * state["velocity"])


_MAKERS: Mapping[str, Callable[..., Optimizer]] = {
    "sgd": lambda p, lr: torch.optim.SGD(p, lr=lr, momentum=MOMENTUM, weight_decay=WEIGHT_DECAY),
    "adam": lambda p, lr: torch.optim.Adam(p, lr=lr, weight_decay=WEIGHT_DECAY),
    "adamw": lambda p, lr: torch.optim.AdamW(p, lr=lr, weight_decay=WEIGHT_DECAY),
    "lars": LARS,
}
"""Optimisers by name; each takes parameters and a learning rate."""


def make_optimizer(name: str, parameters: Iterable[nn.Parameter], learning_rate: float) -> Optimizer:
    """Build an optimiser by name over the parameters that want a gradient."""
    check_name("optimizer", name, OPTIMIZERS)
    check_number("learning_rate", learning_rate, above=0)
    return _MAKERS[name]([p for p in parameters if p.requires_grad], learning_rate)


def rate_factor(schedule: str, epoch: float, *, epochs: int, warmup_epochs: int = 0) -> float:
    """Return the learning rate after so many epochs of all, relative to the initial one.

    For ``cosine`` fractions of an epoch count, and ``warmup_epochs`` of linear rise from 1e-4.
    """
    check_name("schedule", schedule, SCHEDULES)
    if schedule == "constant":
        return 1.0
    if schedule == "step":
        # StepLR (thesis, table 3.2): a tenth every 30 epochs, constant within them.
        return STEP_FACTOR ** (int(epoch) // STEP_EPOCHS)
    # A run shorter than the published one keeps the share of its warm-up below half.
    warmup = min(warmup_epochs, epochs / 2)
    # Linear rise from the warm-up ratio of table 3.2: steps stay small while gradients are still large.
    if epoch < warmup:
        return WARMUP_RATIO + (1 - WARMUP_RATIO) * epoch / warmup
    # Cosine annealing ½(1 + cos πt) to zero, with t from the end of the warm-up (thesis, table 3.2).
    done = (epoch - warmup) / max(epochs - warmup, 1e-9)
    return 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))
