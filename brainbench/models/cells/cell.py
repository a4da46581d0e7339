"""The base of all cells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.models.ops.parameters import load_named

FORGET_BIAS = 1.0
"""Added inside the sigmoid of every gate that keeps the old state."""

Projected = tuple[torch.Tensor, ...]
"""One step of the result of :meth:`Cell.project`."""


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of [B, C, ...], separately at every place."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Normalise [B, C, ...] over C."""
        # Layer norm (Ba et al. 2016) of each place by itself, so that a touch at one whisker does not scale the others.
        return super().forward(input.movedim(1, -1)).movedim(-1, 1)


class Cell(nn.Module):
    """Base of all cells: the state's shape, zero initial states and PyTorchTNN's names.

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate over channels.

    Raises:
        UsageError: there is no channel.
    """

    state_factor: ClassVar[int] = 1
    """Channels of the state per output channel."""
    tnn_names: ClassVar[Mapping[str, str]] = {}
    """Our submodule names → PyTorchTNN's."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        if in_channels < 1 or out_channels < 1:
            raise UsageError(f"{type(self).__name__} needs channels ≥ 1; received {in_channels} and {out_channels}.")
        self.in_channels = in_channels
        self.out_channels = out_channels

    def initial_state(
        self,
        batch: int,
        *spatial: int,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> torch.Tensor:
        """Return the zero state [batch, state channels, *spatial], like the parameters unless told otherwise."""
        like = next(self.parameters())
        shape = (batch, self.state_factor * self.out_channels, *spatial)
        return torch.zeros(shape, device=device or like.device, dtype=dtype or like.dtype)

    def project(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return what the input alone adds to the gates, for any number of inputs [N, C, H, W] at once.

        ``forward(x, state, projected)`` then computes the recurrence only. A cell without gates has nothing to add.
        """
        del x
        return ()

    def load_tnn_state(self, state: Mapping[str, Any]) -> None:
        """Load arrays or tensors under PyTorchTNN's parameter names, such as ``conv.weight``.

        Raises:
            DataError: a name is missing or unexpected, or a shape differs.
        """
        load_named(self.tnn_parameters(), state, what=f"{type(self).__name__}")

    def tnn_parameters(self) -> dict[str, torch.Tensor]:
        """Return the parameters under PyTorchTNN's names."""
        renamed = {}
        for name, value in self.named_parameters():
            owner, _, leaf = name.rpartition(".")
            renamed[f"{self.tnn_names[owner]}.{leaf}" if owner else leaf] = value
        return renamed

    def _check(self, x: torch.Tensor, state: torch.Tensor | None) -> torch.Tensor:
        if x.ndim < 2 or x.shape[1] != self.in_channels:
            raise UsageError(
                f"{type(self).__name__} expects [batch, {self.in_channels}, rows, columns]; received {list(x.shape)}."
            )
        if state is None:
            return self.initial_state(x.shape[0], *x.shape[2:], device=x.device, dtype=x.dtype)
        expected = (x.shape[0], self.state_factor * self.out_channels, *x.shape[2:])
        if tuple(state.shape) != expected:
            raise UsageError(
                f"{type(self).__name__} expects a state of shape {list(expected)}; received {list(state.shape)}."
            )
        return state
