"""One node of a temporal graph as a module."""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.models.cells import CELLS, Cell, TimeDecay
from brainbench.models.graph.spec import Convolution, Dense, Memory, Node, Operation, Pool, Shape
from brainbench.models.ops import dispatch
from brainbench.models.ops.layers import RECTIFIER_GAIN, Conv2d, Linear, activation

# Bilinear with antialiasing: a smaller grid averages what lies between its places instead of skipping it.
_RESIZED: dict[str, Any] = {"mode": "bilinear", "align_corners": False, "antialias": True}


class NodeModule(nn.Module):
    """Operation, memory, activation and pool of one node."""

    def __init__(self, node: Node, shape: Shape) -> None:
        super().__init__()
        self.node = node
        self.grid = shape[1:]
        self.operation, channels = _operation(node.operation, shape)
        self.memory = _memory(node.memory, channels)
        self.dropout = nn.Dropout(node.operation.dropout if node.operation is not None else 0.0)
        stages = node.stages(shape)
        self.before = _normed(node.operation, channels)
        steps = [_step(step, before) for step, before in zip(node.chain, stages[1:], strict=False)]
        self.after = nn.Sequential(activation(node.activation), *_pool(node.pool), *steps)
        self.steps: tuple[nn.Module, ...] = tuple(steps)
        """Modules of the chain."""

    def resized(self, inputs: list[torch.Tensor]) -> list[torch.Tensor]:
        """Return the inputs [B, C, H, W] on the node's grid."""
        size = self.grid
        return [x if x.shape[2:] == size else functional.interpolate(x, size=size, **_RESIZED) for x in inputs]

    def operate(self, inputs: list[torch.Tensor]) -> torch.Tensor:
        """Join the resized inputs on channels and operate on them; return what the memory sees [B, ...]."""
        inputs = self.resized(inputs)
        # Kernels join the inputs while they read them; dropout needs them joined before.
        if isinstance(self.operation, Conv2d) and not (self.training and self.dropout.p):
            return self.before(dispatch.conv_concat(self.operation, inputs))
        x = self.dropout(inputs[0] if len(inputs) == 1 else torch.cat(inputs, 1))
        return self.before(self.operation(x.flatten(1) if isinstance(self.operation, Linear) else x))


def _normed(what: Operation | None, channels: int) -> nn.Module:
    """Build what follows an operation: batch norm, if it has one, and its activation."""
    last = activation(what.activation if what is not None else None)
    if what is None or not what.batch_norm:
        return last
    norm = nn.BatchNorm1d(channels) if isinstance(what, Dense) else nn.BatchNorm2d(channels)
    return nn.Sequential(norm, last)


def _step(step: str | Pool | Operation, shape: Shape) -> nn.Module:
    if isinstance(step, str):
        return activation(step)
    if isinstance(step, Pool):
        return nn.Sequential(*_pool(step))
    operation, channels = _operation(step, shape)
    flat = [nn.Flatten()] if isinstance(step, Dense) else []
    return nn.Sequential(
        OrderedDict(
            dropout=nn.Dropout(step.dropout),
            flat=nn.Sequential(*flat),
            operation=operation,
            before=_normed(step, channels),
        )
    )


def _operation(what: Operation | None, shape: Shape) -> tuple[nn.Module, int]:
    """Build an operation for its concatenated input shape; return it with its output channels."""
    if what is None:
        return nn.Identity(), shape[0]
    options: dict[str, Any] = {"use_bias": what.use_bias, "bias": what.bias, "method": what.initialiser}
    if isinstance(what, Convolution):
        options |= {"kernel_size": what.kernel_size, "stride": what.stride, "padding": what.padding}
        return Conv2d(shape[0], what.channels, **options), what.channels
    assert isinstance(what, Dense)
    # Gain √2 as for convolutions (He et al. 2015), since a rectifier follows.
    return Linear(math.prod(shape), what.features, gain=RECTIFIER_GAIN, **options), what.features


def _memory(memory: Memory | None, channels: int) -> Cell | None:
    if memory is None:
        return None
    if memory.kind == "time-decay":
        return TimeDecay(channels, channels, tau=memory.tau, layer_norm=memory.layer_norm, trainable=memory.trainable)
    return CELLS[memory.kind](channels, channels, kernel_size=memory.kernel_size, layer_norm=memory.layer_norm)


def _pool(pool: Pool | None) -> list[nn.Module]:
    if pool is None:
        return []
    if pool.kind == "max":
        layer: nn.Module = nn.MaxPool2d(pool.size, pool.stride, pool.padding, ceil_mode=pool.ceil_mode)
    else:
        layer = nn.AdaptiveAvgPool2d(pool.size)
    return [layer, nn.Flatten()] if pool.flatten else [layer]
