"""The base of all cells, and the one without gates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.models.ops.parameters import load_named

FORGET_BIAS = 1.0
"""Added inside the sigmoid of every gate that keeps the old state."""

Projected = tuple[torch.Tensor, ...]
"""One step of the result of :meth:`Cell.project`."""

CellStep = tuple[torch.Tensor, torch.Tensor]
"""An output y [B, out, H, W] and the next state [B, state channels, H, W]."""


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of [B, C, ...], separately at every place."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Normalise [B, C, ...] over C."""
        # Layer norm (Ba et al. 2016) of each place by itself, so that a touch at one whisker does not scale the others.
        return super().forward(input.movedim(1, -1)).movedim(-1, 1)


class Cell(nn.Module):
    """Base of all cells: channels of x and y, the state's shape, zero initial states and PyTorchTNN's names."""

    state_factor: ClassVar[int] = 1
    """Channels of the state per output channel."""
    keeps_channels: ClassVar[bool] = False
    """True where the input itself is part of the output."""
    tnn_names: ClassVar[Mapping[str, str]] = {}
    """Our submodule names → PyTorchTNN's."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        name = type(self).__name__
        if in_channels < 1 or out_channels < 1:
            raise UsageError(f"{name} needs channels ≥ 1; received {in_channels} and {out_channels}.")
        if self.keeps_channels and in_channels != out_channels:
            raise UsageError(
                f"{name} mixes its input into its output, so both need the same channels; received {in_channels} in "
                f"and {out_channels} out."
            )
        self.in_channels, self.out_channels = in_channels, out_channels

    def initial_state(self, batch: int, *spatial: int) -> torch.Tensor:
        """Return the zero state [batch, state channels, *spatial], of the parameters' kind and device."""
        return next(self.parameters()).new_zeros(batch, self.state_factor * self.out_channels, *spatial)

    def project(self, x: torch.Tensor) -> Projected:
        """Return what the input alone adds to the gates, for any number of inputs [N, C, H, W] at once.

        ``forward(x, state, projected)`` then computes the recurrence only. A cell without gates has nothing to add.
        """
        del x
        return ()

    def load_tnn_state(self, state: Mapping[str, Any]) -> None:
        """Load arrays or tensors under PyTorchTNN's parameter names, such as ``conv.weight``."""
        load_named(self.tnn_parameters(), state, what=type(self).__name__)

    def tnn_parameters(self) -> dict[str, torch.Tensor]:
        """Return the parameters under PyTorchTNN's names."""
        renamed = {}
        for name, value in self.named_parameters():
            owner, _, leaf = name.rpartition(".")
            renamed[f"{self.tnn_names[owner]}.{leaf}" if owner else leaf] = value
        return renamed

    def _check(self, x: torch.Tensor, state: torch.Tensor | None) -> torch.Tensor:
        name = type(self).__name__
        if x.ndim < 2 or x.shape[1] != self.in_channels:
            raise UsageError(f"{name} expects [batch, {self.in_channels}, rows, columns]; received {list(x.shape)}.")
        expected = (x.shape[0], self.state_factor * self.out_channels, *x.shape[2:])
        if state is None:
            return x.new_zeros(expected)
        if tuple(state.shape) != expected:
            raise UsageError(f"{name} expects a state of shape {list(expected)}; received {list(state.shape)}.")
        return state


class TimeDecay(Cell):
    """Leaky trace: s ← x + τ s, y = s, with one scalar τ that starts at ``tau``, on any [B, C, ...].

    Training changes τ if it is ``trainable``. There is no gate to normalise, so ``layer_norm`` normalises the output
    (y = LN(s)); the trace itself stays as it is, or it would forget how strong the stimulus was.
    ``kernel_size`` is unused.
    """

    keeps_channels = True
    tnn_names: ClassVar[Mapping[str, str]] = {"norm": "norm"}

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        kernel_size: Any = None,
        layer_norm: bool = False,
        tau: float = 0.0,
        trainable: bool = True,
    ) -> None:
        super().__init__(in_channels, out_channels)
        check_number("The time decay tau", tau)
        self.tau = nn.Parameter(torch.tensor(float(tau)), requires_grad=trainable)
        self.norm = ChannelNorm(out_channels) if layer_norm else nn.Identity()

    def forward(self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()) -> CellStep:
        """Return (y, state), both [B, C, ...]."""
        del projected
        # s_t = x_t + τ s_{t−1}: linear, so the trace of one input decays as τ to the power of the steps since.
        state = x + self.tau * self._check(x, state)
        return self.norm(state), state
