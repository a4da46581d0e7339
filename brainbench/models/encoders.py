"""Encoders, which turn a stimulus [B, T, C, H, W] into features [B, T, F].

The recurrent convolutional network of Zhuang et al. (2017), with any cell; a ResNet18 of every time step on its own,
which is the feedforward control without any memory (He et al. 2016); and a structured state-space encoder (S4: Gu, Goel
& Ré 2022, with the stable form A = Λ − P P* of Goel et al. 2022).
"""

from __future__ import annotations

import math
from collections.abc import Collection
from itertools import pairwise
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import check_number
from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node
from brainbench.models.ops.layers import RECTIFIER_GAIN, Conv2d, Linear
from brainbench.models.ops.state_space import StateSpace, System
from brainbench.models.parts import check_sweep, run_layers

INPUT_SHAPE = (30, 5, 7)  # five sub-steps of six channels (sub-step-major) on the whisker grid

_FEEDBACK = ((3, 2), (4, 2), (4, 3), (5, 3), (5, 4), (6, 4), (6, 5))
_FULL = (96, 128, 256, 384, 384, 256)


def small_width(full: int) -> int:
    """Return the width of a ``-small`` variant: 3/16 of the full one, in every encoder."""
    return full * 3 // 16


def zhuang_graph(
    cell: str = "time-decay", layer_norm: bool = False, small: bool = False, *, feedforward: bool = False
) -> GraphSpec:
    """Return the encoder's graph with a cell of :mod:`brainbench.models.cells`.

    It has 512 features, or 96 when ``small`` (every width × 3/16, about 1.3 M parameters with the largest cell).
    Six 2×2 convolutions (the first "valid", 5 × 7 → 4 × 6, the others "same"), two dense layers, feedback
    3→2, 4→2, 4→3, 5→3, 5→4, 6→4, 6→5 and skips conv2, conv4 → fc7. With the time-decay cell every node has a
    memory, as published; with a gated cell the convolutions carry it and the dense layers have none.
    ``feedforward`` keeps nodes, skips and timing and drops memory and feedback; cell and layer norm then have no
    meaning.
    """
    scaled = small_width if small else int
    memory = None if feedforward else Memory(cell, layer_norm=layer_norm)
    names = [f"conv{index}" for index in range(1, 7)]
    nodes = [
        Node(name, Convolution(scaled(width), padding="valid" if name == "conv1" else "same"), memory)
        for name, width in zip(names, _FULL, strict=True)
    ]
    # Gated memories are convolutional and need a grid, which dense layers lack; a trace needs none.
    dense = Memory() if cell == "time-decay" and not feedforward else None
    nodes += [Node("fc7", Dense(scaled(1024)), dense), Node("fc8", Dense(scaled(512)), dense)]
    # Skips bring early responses to the dense layers before the last convolution has answered.
    forward = [*pairwise(names), ("conv2", "fc7"), ("conv4", "fc7"), ("conv6", "fc7")]
    edges = [Edge(*ends) for ends in (*forward, ("fc7", "fc8"))]
    if not feedforward:
        edges += [Edge(f"conv{source}", f"conv{target}", feedback=True) for source, target in _FEEDBACK]
    return GraphSpec(tuple(nodes), tuple(edges), ("conv1",), "fc8", INPUT_SHAPE)


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
    """Features [B, T, F] of a sweep [B, T, C, H, W], each step alone: eight basic blocks, 11,523,840 parameters.

    The first convolution takes all channels of a step; the last layer gives the features.

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
    """Features [B, T, F] of a sweep [B, T, C, H, W], causally: a linear layer, four S4 blocks, a linear layer.

    A sweep is one convolution over time by FFT; a stream is the recurrence of the same system. 3,434,496 parameters.

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
