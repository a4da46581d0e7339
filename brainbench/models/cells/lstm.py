"""Long short-term memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch

from brainbench.models.cells.cell import FORGET_BIAS, Projected
from brainbench.models.cells.gated import GatedCell


class LSTM(GatedCell):
    """Long short-term memory; the state is cat(c, h) [B, 2 out, H, W].

    c ← c σ(f' + 1) + σ(i') tanh(j'), normalised too with ``layer_norm``; h = tanh(c) σ(o'); y = h.

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate and c over channels.
    """

    state_factor = 2
    gates = ("i", "j", "f", "o")
    other_norms = ("c",)
    tnn_names: ClassVar[Mapping[str, str]] = {
        "conv": "conv",
        "norms.i": "ln_input",
        "norms.j": "ln_transform",
        "norms.f": "ln_forget",
        "norms.o": "ln_output",
        "norms.c": "ln_state",
    }

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y [B, out, H, W], state [B, 2 out, H, W])."""
        state = self._check(x, state)
        return self.apply_gates(self._fused(self.conv, x, state.chunk(2, 1)[1], projected[:1]), x, state)

    def apply_gates(
        self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y [B, out, H, W], state [B, 2 out, H, W]) from the gates' pre-activations."""
        del x
        memory = state.chunk(2, 1)[0]
        write, candidate, keep, read = self._normalised(fused, self.gates)
        # The +1 on the forget gate keeps the memory early in training; c is normalised before it is read and stored.
        memory = memory * torch.sigmoid(keep + FORGET_BIAS) + torch.sigmoid(write) * torch.tanh(candidate)
        (memory,) = self._normalised(memory, ("c",))
        hidden = torch.tanh(memory) * torch.sigmoid(read)
        return hidden, torch.cat((memory, hidden), 1)
