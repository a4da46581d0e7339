"""The cell gated through time and through depth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, cast

import torch

from brainbench.core.errors import UsageError
from brainbench.models.cells.cell import FORGET_BIAS, ChannelNorm, Projected
from brainbench.models.cells.gated import GatedCell
from brainbench.models.ops import dispatch

if TYPE_CHECKING:
    from brainbench.models.ops.gates import DeferredNormGrad


class IntersectionRNN(GatedCell):
    """Cell gated through time and through depth (Collins et al. 2017).

    State: p = σ(p' + 1), s ← p s + (1 − p) tanh(m'). Output: q = σ(q' + 1), y = q x + (1 − q) relu(n').

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y; the same number.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate over channels.

    Raises:
        UsageError: the numbers of channels differ.
    """

    gates = ("gh", "h", "gy", "y")
    tnn_names: ClassVar[Mapping[str, str]] = {"conv": "conv"} | {f"norms.{name}": f"ln_{name}_act" for name in gates}

    def __init__(
        self, in_channels: int, out_channels: int, *, kernel_size: int | tuple[int, int], layer_norm: bool = False
    ) -> None:
        if in_channels != out_channels:
            raise UsageError(
                "IntersectionRNN mixes its input into its output, so both need the same channels; "
                f"received {in_channels} in and {out_channels} out."
            )
        super().__init__(in_channels, out_channels, kernel_size=kernel_size, layer_norm=layer_norm)
        self.deferred: DeferredNormGrad | None = None
        """Place for the gradients of the norms of each step; None outside of a deferring pass."""

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, out, H, W]."""
        state = self._check(x, state)
        fused = self._fused(self.conv, x, state, projected[:1])
        return dispatch.apply_gates(self, fused, x, state, projected=bool(projected))

    def norm(self, gate: str) -> ChannelNorm:
        """Return the norm of a gate."""
        return cast(ChannelNorm, self.norms[gate])

    def apply_gates(
        self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, out, H, W], from the gates' pre-activations."""
        keep, candidate, through, output = self._normalised(fused, self.gates)
        keep = torch.sigmoid(keep + FORGET_BIAS)
        # Thesis, equations 3.2 and 3.3: one gate passes the state on in time, the other the input on in depth.
        through = torch.sigmoid(through + FORGET_BIAS)
        # h = y x + (1 − y) n and s = p s + (1 − p) m: early in training most of input and state passes.
        y = through * x + (1 - through) * torch.relu(output)
        return y.to(x.dtype), keep * state + (1 - keep) * torch.tanh(candidate)
