"""Where training starts: an untrained network, awake.

Before an object arrives a sweep is exactly zero, and so is every activation of a network whose biases are zero. There
layer norm has its steepest slope, 1/√ε = 316, at every place, step and layer: back through 22 steps of an unrolled
network the gradient overflows single precision, and four S4 blocks alone make it 1e9. Networks with layer norm
therefore start with the biases of their convolutions and linear layers drawn as PyTorch draws them; silence then has
a spread over channels, and the slope is of the order of one. Networks without layer norm start as they are.
"""

from __future__ import annotations

import math

import torch
from torch import nn


@torch.no_grad()
def draw_silent_biases(model: nn.Module) -> int:
    """Draw the biases that are zero, uniform within 1/√fan_in, in a network with layer norm.

    Args:
        model: Changed in place; a network without layer norm is left alone.

    Returns:
        How many layers got biases. They come from PyTorch's global random state.
    """
    if not any(isinstance(part, nn.LayerNorm) for part in model.modules()):
        return 0
    drawn = 0
    for part in model.modules():
        if isinstance(part, (nn.Conv2d, nn.Linear)) and part.bias is not None and not part.bias.any():
            bound = 1.0 / math.sqrt(part.weight[0].numel())
            part.bias.uniform_(-bound, bound)
            drawn += 1
    return drawn
