"""The leaky trace."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.models.cells.cell import Cell, ChannelNorm, Projected


class TimeDecay(Cell):
    """Leaky trace: s ← x + τ s, y = s, with one trainable scalar τ that starts at zero.

    There is no gate to normalise, so ``layer_norm`` normalises the output (y = LN(s)); the trace itself
    stays as it is, or it would forget how strong the stimulus was. Works on any [B, C, ...].
    ``kernel_size`` is accepted for a uniform signature and unused.

    Args:
        in_channels: C.
        out_channels: C again.
        kernel_size: Unused.
        layer_norm: Normalise the output over channels.
        tau: τ before training.

    Raises:
        UsageError: the numbers of channels differ.
    """

    tnn_names: ClassVar[Mapping[str, str]] = {"norm": "norm"}

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        kernel_size: int | tuple[int, int] | None = None,
        layer_norm: bool = False,
        tau: float = 0.0,
    ) -> None:
        super().__init__(in_channels, out_channels)
        if in_channels != out_channels:
            raise UsageError(f"TimeDecay keeps its channels; received {in_channels} in and {out_channels} out.")
        self.tau = nn.Parameter(torch.tensor(float(tau)))
        self.norm = ChannelNorm(out_channels) if layer_norm else nn.Identity()

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, C, ...]."""
        del projected
        # s_t = x_t + τ s_{t−1}: linear, so the trace of one input decays as τ to the power of the steps since.
        state = x + self.tau * self._check(x, state)
        return self.norm(state), state
