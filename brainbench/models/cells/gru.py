"""The gated recurrent unit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch

from brainbench.models.cells.cell import FORGET_BIAS, Projected
from brainbench.models.cells.gated import GatedCell
from brainbench.models.ops.layers import Conv2d


class GRU(GatedCell):
    """Gated recurrent unit with two convolutions (Cho et al. 2014).

    r = σ(r' + 1), u = σ(u') from cat(x, s); c = tanh of a second convolution of cat(x, r s);
    s ← u s + (1 − u) c, y = s. The fixed +1 sits on the reset gate alone.

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate over channels.
    """

    gates = ("r", "u")
    other_norms = ("c",)
    fused_parts = ("reset", "update")
    tnn_names: ClassVar[Mapping[str, str]] = {
        "conv": "conv_ru",
        "candidate": "conv_c",
        "norms.r": "ln_r_pre",
        "norms.u": "ln_u_pre",
        "norms.c": "ln_c_pre",
    }

    def __init__(
        self, in_channels: int, out_channels: int, *, kernel_size: int | tuple[int, int], layer_norm: bool = False
    ) -> None:
        super().__init__(in_channels, out_channels, kernel_size=kernel_size, layer_norm=layer_norm)
        self.candidate = self._convolution(1, kernel_size)

    @property
    def convolutions(self) -> tuple[Conv2d, ...]:
        """Convolutions of the gates and of the candidate."""
        return self.conv, self.candidate

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, out, H, W]."""
        state = self._check(x, state)
        remembered, keep = self.reset(self._fused(self.conv, x, state, projected[:1]), state)
        state = self.update(self._fused(self.candidate, x, remembered, projected[1:]), keep, state)
        return state, state

    def reset(self, fused: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (r s, u) from the gates' pre-activations."""
        reset, keep = self._normalised(fused, self.gates)
        # The +1 lets the old state into the candidate early in training; the update gate has none.
        return torch.sigmoid(reset + FORGET_BIAS) * state, torch.sigmoid(keep)

    def update(self, fused: torch.Tensor, keep: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Return the next state from the candidate's pre-activation and the update gate u."""
        (candidate,) = self._normalised(fused, ("c",))
        # s ← u s + (1 − u) c (Cho et al. 2014): old state and candidate mix, so the state stays within ±1.
        return keep * state + (1 - keep) * torch.tanh(candidate)
