"""Structured state-space encoder (S4): a linear layer, four blocks with diagonal-plus-low-rank memory, a linear layer.

Gu, Goel & Ré 2022 (ICLR), with the stable form A = Λ − P P* of Goel et al. 2022. 3,434,496 parameters at
full width. A sweep is one convolution over time by FFT; a stream is the recurrence of the same system.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.reading.ranges import check_number
from brainbench.models.encoders.zhuang import INPUT_SHAPE, small_width
from brainbench.models.ops.layers import RECTIFIER_GAIN, Linear
from brainbench.models.ops.state_space import StateSpace, System
from brainbench.models.parts import check_sweep, run_layers

S4State = tuple[tuple[torch.Tensor, System], ...]
"""For every block the memory [B, width, pairs, 2] and the discretised system (constant while streaming)."""


class S4Block(nn.Module):
    """LayerNorm(x + GLU(GELU(state space(x)))), [B, T, width], as published.

    ``dropout`` is the share dropped while training, both after the GELU and of what is added.
    """

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.memory = StateSpace(width)
        self.mix = Linear(width, 2 * width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Process a sweep [B, T, width]."""
        return self._added(x, self.memory(x))

    def step(self, x: torch.Tensor, memory: torch.Tensor, system: System) -> tuple[torch.Tensor, torch.Tensor]:
        """Advance by one step [B, width]; return the answer and the next memory."""
        y, memory = self.memory.step(x, memory, system)
        return self._added(x, y), memory

    def _added(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        # State spaces keep channels apart; the gated linear unit mixes them at every step.
        y = self.dropout(functional.glu(self.mix(self.dropout(functional.gelu(y))), -1))
        return self.norm(x + y)


class S4Encoder(nn.Module):
    """Features [B, T, F] of a sweep [B, T, C, H, W], causally.

    With ``small`` all widths × 3/16 (F = 96 instead of 512; 0.3 M parameters). ``dropout`` is as for :class:`S4Block`.
    """

    layers: tuple[str, ...] = ("embed", "block1", "block2", "block3", "block4", "fc")
    input_shape: tuple[int, int, int] = INPUT_SHAPE
    latency: int = 0
    receptive_field: int | None = None

    def __init__(self, *, small: bool = False, dropout: float = 0.2) -> None:
        super().__init__()
        check_number("The share dropped by S4", dropout, least=0, most=1)
        self.features = small_width(512) if small else 512
        self.embed = Linear(math.prod(self.input_shape), self.features, gain=RECTIFIER_GAIN)
        self.blocks: Any = nn.ModuleList(S4Block(self.features, dropout) for _ in range(len(self.layers) - 2))
        self.fc = Linear(self.features, self.features)

    def multiply_adds(self) -> int:
        """Return the multiply-adds of one streamed step: linear layers, and 12 per conjugate pair of the recurrence."""
        # For each pair: 4 for the transition, 2 each for row, column, input and readout.
        linear = sum(module.weight.numel() for module in self.modules() if isinstance(module, Linear))
        return linear + sum(12 * block.memory.frequency.numel() for block in self.blocks)

    def forward(self, x: torch.Tensor, *, return_activations: bool | Collection[str] = False) -> Any:
        """Return the features [B, T, F], with activations also ``{layer: [B, T, width]}``."""
        check_sweep(x, self.input_shape, "S4")
        layers = zip(self.layers, (self.embed, *self.blocks, self.fc), strict=True)
        y, activations = run_layers(x.flatten(2), layers, return_activations)
        return y if return_activations is False else (y, activations)

    def init_state(self, batch: int) -> S4State:
        """Return the state before the first step: empty memories and the systems discretised from the weights."""
        return tuple(block.memory.init_state(batch) for block in self.blocks)

    def step(self, x: torch.Tensor, state: S4State) -> tuple[torch.Tensor, S4State]:
        """Return the features [B, F] of one step [B, C, H, W] and the next state."""
        y, after = self.embed(x.flatten(1)), []
        for block, (memory, system) in zip(self.blocks, state, strict=True):
            y, memory = block.step(y, memory, system)
            after.append((memory, system))
        return self.fc(y), tuple(after)
