"""ResNet18 of every time step on its own: the feedforward control without any memory.

Residual network of He et al. 2016 with eight basic blocks. Its first convolution takes all channels of a
step; the last layer gives the features. 11,523,840 parameters at full width.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise
from typing import Any

import torch
from torch import nn

from brainbench.models.encoders.zhuang import INPUT_SHAPE, small_width
from brainbench.models.ops.layers import RECTIFIER_GAIN, Conv2d, Linear
from brainbench.models.parts import check_sweep, run_layers

_WIDTHS = (64, 128, 256, 512)


class BasicBlock(nn.Module):
    """Two 3×3 convolutions with batch norm around a shortcut, [B, C, H, W] → [B, out, H', W']."""

    def __init__(self, in_channels: int, out_channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = _convolution(in_channels, out_channels, 3, stride)
        self.norm1 = nn.BatchNorm2d(out_channels)
        self.conv2 = _convolution(out_channels, out_channels, 3, 1)
        self.norm2 = nn.BatchNorm2d(out_channels)
        self.shortcut = nn.Sequential()
        if stride != 1 or in_channels != out_channels:
            self.shortcut.append(_convolution(in_channels, out_channels, 1, stride))
            self.shortcut.append(nn.BatchNorm2d(out_channels))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the rectified sum of the branch and the shortcut."""
        # He et al. 2016: the branch learns the difference from the shortcut, so gradients pass by it undiminished.
        y = self.norm2(self.conv2(torch.relu(self.norm1(self.conv1(x)))))
        return torch.relu(y + self.shortcut(x))


class ResNet18Encoder(nn.Module):
    """Features [B, T, F] of a sweep [B, T, C, H, W], each step alone.

    With ``small`` all widths × 3/16 (F = 96 instead of 512; 0.4 M parameters). In training, batch norm pools over batch
    and time.
    """

    layers: tuple[str, ...] = ("conv1", "layer1", "layer2", "layer3", "layer4", "fc")
    input_shape: tuple[int, int, int] = INPUT_SHAPE
    latency: int = 0
    receptive_field: int | None = 1

    def __init__(self, *, small: bool = False) -> None:
        super().__init__()
        widths = [small_width(width) if small else width for width in _WIDTHS]
        self.features = widths[-1]
        first = _convolution(self.input_shape[0], widths[0], 7, 2)
        self.conv1 = nn.Sequential(first, nn.BatchNorm2d(widths[0]), nn.ReLU(), nn.MaxPool2d(3, 2, 1))
        for index, (before, width) in enumerate(pairwise((widths[0], *widths)), start=1):
            stride = 1 if index == 1 else 2
            blocks = nn.Sequential(BasicBlock(before, width, stride), BasicBlock(width, width, 1))
            self.add_module(f"layer{index}", blocks)
        self.fc = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), Linear(self.features, self.features))

    def multiply_adds(self) -> int:
        """Return the multiply-adds of one step of one stimulus."""
        total, (_, rows, columns) = self.features**2, self.input_shape
        # The first convolution halves the grid, its pool too, and every layer from the second on: a stride of 2 with
        # "same"-like padding of an odd kernel rounds up.
        for name, times in (("conv1", 1), ("layer1", 2), ("layer2", 3), ("layer3", 4), ("layer4", 5)):
            places = -(-rows // 2**times) * -(-columns // 2**times)
            layer = self.get_submodule(name)
            total += sum(m.weight.numel() for m in layer.modules() if isinstance(m, Conv2d)) * places
        return total

    def forward(self, x: torch.Tensor, *, return_activations: bool | Collection[str] = False) -> Any:
        """Return the features [B, T, F], with activations also ``{layer: [B, T, ...]}``."""
        check_sweep(x, self.input_shape, "The ResNet")
        leading = x.shape[:2]
        layers = ((name, self.get_submodule(name)) for name in self.layers)
        # Steps are independent images here, so batch and time are one axis.
        y, activations = run_layers(x.flatten(0, 1), layers, return_activations)
        y = y.unflatten(0, leading)
        if return_activations is False:
            return y
        return y, {name: value.unflatten(0, leading) for name, value in activations.items()}

    def init_state(self, batch: int) -> tuple[()]:
        """Return the state before the first step: there is none to keep."""
        del batch
        return ()

    def step(self, x: torch.Tensor, state: tuple[()]) -> tuple[torch.Tensor, tuple[()]]:
        """Return the features [B, F] of one step [B, C, H, W] and the (empty) state."""
        return self(x[:, None])[:, 0], state


def _convolution(in_channels: int, out_channels: int, size: int, stride: int) -> Conv2d:
    shape: dict[str, Any] = {"kernel_size": (size, size), "stride": (stride, stride), "padding": (size // 2, size // 2)}
    return Conv2d(in_channels, out_channels, **shape, use_bias=False, gain=RECTIFIER_GAIN)
