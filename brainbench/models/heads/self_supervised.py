"""Heads of the self-supervised objectives; they are trained with the network and left behind afterwards.

Sizes are the published ones at 512 features: SimCLR 1,315,072 parameters, SimSiam 11,556,352, autoencoder
289,665. Letters: B batch, T step, F features.
"""

from __future__ import annotations

import torch
from torch import nn

from brainbench.core.contracts import GRID_SHAPE
from brainbench.core.reading.ranges import check_number
from brainbench.models.ops.layers import RECTIFIER_GAIN, Linear, perceptron

HIDDEN = 2048


class SimCLRHead(nn.Module):
    """Projection [B, F] → [B, 128]: F → 2048 → 128 with batch norms, linear layers without bias (Chen et al. 2020)."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.layers = perceptron(features, HIDDEN, 128, norms=2, use_bias=False)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the embeddings, not normalised."""
        return self.layers(features)


class SimSiamHead(nn.Module):
    """Projector F → 2048 → 2048 → 2048 and predictor 2048 → 512 → 2048 (Chen & He 2021)."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.projector = perceptron(features, HIDDEN, HIDDEN, HIDDEN, norms=3)
        self.predictor = perceptron(HIDDEN, 512, HIDDEN, norms=1)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the projection and its prediction [B, 2048]."""
        projection = self.projector(features)
        return projection, self.predictor(projection)


class AutoencoderHead(nn.Module):
    """Reconstruction [B, T, F] → [B, T, C, H, W]: a linear layer to C/2 channels, three transposed convolutions."""

    def __init__(self, features: int, *, channels: int = 30, grid: tuple[int, int] = GRID_SHAPE) -> None:
        super().__init__()
        check_number("The number of channels of an autoencoder", channels, least=2, whole=True)
        self.shape = (channels // 2, *grid)
        self.dense = Linear(features, channels // 2 * grid[0] * grid[1], gain=RECTIFIER_GAIN)
        self.layers = nn.Sequential()
        for width in (channels // 2, channels, channels):
            self.layers.extend((nn.ReLU(), nn.ConvTranspose2d(width, channels, 3, padding=1)))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the reconstruction of every step, in normalised units."""
        hidden = self.dense(features.flatten(0, -2)).unflatten(-1, self.shape)
        return self.layers(hidden).unflatten(0, features.shape[:-1])
