"""The base of the gated cells: one fused convolution for all gates, and what follows it."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import nn

from brainbench.models.cells.cell import Cell, ChannelNorm, Projected
from brainbench.models.ops import dispatch
from brainbench.models.ops.layers import Conv2d, pair


class GatedCell(Cell):
    """A cell with one fused convolution for all its gates.

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate over channels.
    """

    gates: ClassVar[tuple[str, ...]] = ()
    other_norms: ClassVar[tuple[str, ...]] = ()
    """Names of the norms beside those of the gates."""
    fused_parts: ClassVar[tuple[str, ...]] = ("apply_gates",)

    def __init__(
        self, in_channels: int, out_channels: int, *, kernel_size: int | tuple[int, int], layer_norm: bool = False
    ) -> None:
        super().__init__(in_channels, out_channels)
        self.conv = self._convolution(len(self.gates), kernel_size)
        normalised = (*self.gates, *self.other_norms) if layer_norm else ()
        self.norms = nn.ModuleDict({name: ChannelNorm(out_channels) for name in normalised})

    def _convolution(self, gates: int, kernel_size: int | tuple[int, int]) -> Conv2d:
        size = pair(kernel_size, "kernel size of a cell")
        return Conv2d(self.in_channels + self.out_channels, gates * self.out_channels, kernel_size=size, gain=1.0)

    @property
    def convolutions(self) -> tuple[Conv2d, ...]:
        """Convolutions of the input and the memory, in the order of their use."""
        return (self.conv,)

    def project(self, x: torch.Tensor) -> Projected:
        """Return the input's part of every convolution, biases included, for inputs [N, C, H, W].

        Nothing where kernels of our own join input and memory without a copy of either
        (:mod:`brainbench.models.ops.dispatch`).
        """
        if dispatch.kernel_applies(self.conv, x):
            return ()
        return tuple(conv.conv_slice(x, 0, use_bias=True) for conv in self.convolutions)

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y [B, out, H, W], state [B, state channels, H, W])."""
        state = self._check(x, state)
        return self.apply_gates(self._fused(self.conv, x, state, projected[:1]), x, state)

    def apply_gates(
        self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state) from the gates' pre-activations [B, gates × out, H, W]: all that follows the convolution.

        It reads every number a few times and computes little, so one fused kernel does it best: :meth:`fuse`.
        """
        raise NotImplementedError

    def fuse(self, on: bool = True) -> None:
        """Let PyTorch's compiler make what follows the convolutions into kernels of its own, or leave it to PyTorch."""
        for name in self.fused_parts:
            self.__dict__.pop(name, None)
            if on:
                setattr(self, name, torch.compile(getattr(self, name), dynamic=False))

    def _fused(self, conv: Conv2d, x: torch.Tensor, memory: torch.Tensor, projected: Projected) -> torch.Tensor:
        if projected:
            # W [x, s] = W_x x + W_s s: the input's part was computed for all steps at once, only the memory's is left.
            return projected[0] + conv.conv_slice(memory, self.in_channels, use_bias=False)
        return dispatch.conv_concat(conv, (x, memory))

    def _normalised(self, fused: torch.Tensor, names: tuple[str, ...]) -> list[torch.Tensor]:
        # One convolution gives all gates; each is normalised by itself, as gates differ in scale.
        parts = fused.chunk(len(names), 1)
        if not self.norms:
            return list(parts)
        return [self.norms[name](part) for name, part in zip(names, parts, strict=True)]
