"""Selective state spaces over the encoder's features (Mamba).

Gu & Dao 2023, in plain PyTorch: a sweep is solved by a parallel scan (on CUDA by the kernel of ``mamba_ssm`` where
that package is installed, with equal results), a stream by the recurrence. Pre-norm
residual blocks and a final norm. 6,784,000 parameters at width 512.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple, cast

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.models.ops import dispatch
from brainbench.models.ops.layers import Linear
from brainbench.models.ops.linear_scan import linear_scan
from brainbench.models.parts import run_layers

_STEP_RANGE = (1e-3, 1e-1)


class MambaMemory(NamedTuple):
    """Memory of a block between two steps."""

    recent: torch.Tensor
    """[B, inner, convolution − 1] the inputs of the short convolution, oldest first."""
    state: torch.Tensor
    """[B, inner, states] of the state space."""


MambaState = tuple[MambaMemory, ...]
"""One memory per block."""


class MambaBlock(nn.Module):
    """x + selective state space(LayerNorm(x)), [B, T, width].

    Per inner channel and state: h_t = exp(Δ_t A) h_{t−1} + Δ_t B_t u_t, y_t = C_t · h_t + D u_t, where the step
    Δ_t and the vectors B_t, C_t are functions of the input; y is gated by SiLU of a second branch.

    Sizes are those of :class:`MambaAttender`; what each of ``depth`` blocks adds is scaled by 1/√depth.
    """

    def __init__(self, width: int, *, expansion: int, states: int, convolution: int, depth: int) -> None:
        super().__init__()
        inner, self.rank, self.states = expansion * width, math.ceil(width / 16), states
        self.norm = nn.LayerNorm(width)
        self.expand = Linear(width, 2 * inner, use_bias=False)
        self.convolution = nn.Conv1d(inner, inner, convolution, groups=inner)
        self.select = Linear(inner, self.rank + 2 * states, use_bias=False)
        self.step_size = Linear(self.rank, inner, gain=1.0 / math.sqrt(3.0))
        self.log_decay = nn.Parameter(torch.arange(1.0, states + 1).log().repeat(inner, 1))
        self.skip = nn.Parameter(torch.ones(inner))
        self.project = Linear(inner, width, use_bias=False, gain=1.0 / math.sqrt(depth))
        if not self.skip.is_meta:
            with torch.no_grad():
                low, high = map(math.log, _STEP_RANGE)
                # Δ is drawn log-uniformly; its inverse softplus is Δ + log(1 − e^−Δ).
                size = torch.empty(inner).uniform_(low, high).exp()
                # The softplus of this bias is the step size.
                self.step_size.bias.copy_(size + torch.log(-torch.expm1(-size)))

    def init_memory(self, batch: int) -> MambaMemory:
        """Return the memory before the first step, all zeros."""
        inner, _, size = self.convolution.weight.shape
        return MambaMemory(self.skip.new_zeros(batch, inner, size - 1), self.skip.new_zeros(batch, inner, self.states))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Process a sweep [B, T, width]."""
        u, gate = self.expand(self.norm(x)).chunk(2, -1)
        # Zeros before the first step alone make the short convolution causal.
        padded = functional.pad(u.transpose(1, 2), (self.convolution.kernel_size[0] - 1, 0))
        u = functional.silu(self.convolution(padded).transpose(1, 2))
        if (scan := dispatch.selective_scan(u)) is not None:
            return self._scanned(scan, x, u, gate)
        decay, drive, readout = self._selected(u)
        return self._out(x, linear_scan(decay, drive), readout, u, gate)

    def step(self, x: torch.Tensor, memory: MambaMemory) -> tuple[torch.Tensor, MambaMemory]:
        """Advance by one step [B, width]; return the answer and the next memory."""
        u, gate = self.expand(self.norm(x)).chunk(2, -1)
        # The stream keeps the last inputs, so its short convolution sees what the sweep's does.
        window = torch.cat((memory.recent.to(u.dtype), u[..., None]), -1)
        weight, bias = self.convolution.weight[:, 0], cast(torch.Tensor, self.convolution.bias)
        u = functional.silu((window * weight).sum(-1) + bias)
        decay, drive, readout = self._selected(u)
        h = decay * memory.state + drive
        return self._out(x, h, readout, u, gate), MambaMemory(window[..., 1:], h)

    def _selected(self, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return exp(Δ A) and Δ B u [..., inner, states], and C [..., states], in single precision or better."""
        size, drive, readout = self.select(u).split((self.rank, self.states, self.states), -1)
        # Products of many decays need more digits than half floats have.
        exact = torch.promote_types(u.dtype, torch.float32)
        size = functional.softplus(self.step_size(size)).to(exact)
        # exp(Δ A) with A = −exp(log_decay) < 0, so no state can grow; the input enters by Δ B (Gu & Dao 2023).
        decay = torch.exp(size[..., None] * -torch.exp(self.log_decay.to(exact)))
        return decay, (size * u.to(exact))[..., None] * drive.to(exact)[..., None, :], readout.to(exact)

    def _scanned(self, scan: Any, x: torch.Tensor, u: torch.Tensor, gate: torch.Tensor) -> torch.Tensor:
        """Answer by a kernel that scans, reads out and gates in one pass; it takes [B, channel, T]."""
        size, drive, readout = self.select(u).split((self.rank, self.states, self.states), -1)
        size = size @ self.step_size.weight.to(size.dtype).T
        u, size, drive, readout, gate = (part.transpose(1, 2).contiguous() for part in (u, size, drive, readout, gate))
        decay, bias = -torch.exp(self.log_decay.float()), self.step_size.bias.float()
        y = scan(u, size, decay, drive, readout, self.skip.float(), z=gate, delta_bias=bias, delta_softplus=True)
        return x + self.project(y.transpose(1, 2)).to(x.dtype)

    def _out(self, x: torch.Tensor, h: torch.Tensor, readout: torch.Tensor, u: torch.Tensor, gate: torch.Tensor) -> Any:
        """Read the states h [..., inner, states] out, gate them and add them to the stream."""
        y = (h * readout[..., None, :]).sum(-1).to(u.dtype) + self.skip * u
        return x + self.project(y * functional.silu(gate)).to(x.dtype)


class MambaAttender(nn.Module):
    """Map features [B, T, F] to [B, T, F], causally and for any number of steps.

    The inner width of a block is ``expansion`` times F, with ``states`` per inner channel; the short convolution sees
    ``convolution`` steps.
    """

    max_steps: int | None = None

    def __init__(
        self, features: int, *, blocks: int = 4, expansion: int = 2, states: int = 16, convolution: int = 4
    ) -> None:
        super().__init__()
        sizes = {"expansion": expansion, "states": states, "convolution": convolution}
        given = {"features": features, "blocks": blocks, **sizes}
        if min(given.values()) < 1:
            told = ", ".join(f"{name} {value}" for name, value in given.items())
            raise UsageError(f"A Mamba attender needs positive sizes; received {told}.")
        self.features = features
        self.blocks: Any = nn.ModuleList(MambaBlock(features, depth=blocks, **sizes) for _ in range(blocks))
        self.norm = nn.LayerNorm(features)
        self.layers: tuple[str, ...] = (*(f"block{index}" for index in range(1, blocks + 1)), "norm")

    def multiply_adds(self) -> int:
        """Return the multiply-adds of products and convolutions in one step (the recurrences add about 3 %)."""
        return sum(m.weight.numel() for m in self.modules() if isinstance(m, (Linear, nn.Conv1d)))

    def forward(self, x: torch.Tensor, *, return_activations: bool | Collection[str] = False) -> Any:
        """Return the answers [B, T, F], with activations also ``{layer: [B, T, F]}``."""
        layers = zip(self.layers, (*self.blocks, self.norm), strict=True)
        y, activations = run_layers(x, layers, return_activations)
        return y if return_activations is False else (y, activations)

    def init_state(self, batch: int) -> MambaState:
        """Return the state before the first step, all zeros."""
        return tuple(block.init_memory(batch) for block in self.blocks)

    def step(self, x: torch.Tensor, state: MambaState) -> tuple[torch.Tensor, MambaState]:
        """Advance by one step of features [B, F]; return the answer [B, F] and the next state."""
        after = []
        for block, memory in zip(self.blocks, state, strict=True):
            x, memory = block.step(x, memory)
            after.append(memory)
        return self.norm(x), tuple(after)
