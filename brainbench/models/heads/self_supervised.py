"""Heads of the self-supervised objectives; they are trained with the network and left behind afterwards.

Sizes are the published ones at 512 features: SimCLR 1,315,072 parameters, SimSiam 11,556,352, autoencoder
289,665. Letters: B batch, T step, F features.
"""

from __future__ import annotations

import torch
from torch import nn

from brainbench.core.contracts import GRID_SHAPE
from brainbench.core.errors import UsageError
from brainbench.models.ops.layers import RECTIFIER_GAIN, Linear


class SimCLRHead(nn.Module):
    """Projection [B, F] → [B, 128]: F → 2048 → 128 with batch norms, linear layers without bias (Chen et al. 2020).

    Args:
        features: F.
        hidden: Width of the hidden layer.
        outputs: Width of the projection.
    """

    def __init__(self, features: int, *, hidden: int = 2048, outputs: int = 128) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            Linear(features, hidden, use_bias=False, gain=RECTIFIER_GAIN),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            Linear(hidden, outputs, use_bias=False),
            nn.BatchNorm1d(outputs),
        )

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the embeddings, not normalised."""
        return self.layers(features)


class SimSiamHead(nn.Module):
    """Projector F → 2048 → 2048 → 2048 and predictor 2048 → 512 → 2048 (Chen & He 2021).

    Args:
        features: F.
        hidden: Width of the projector and of its result.
        bottleneck: Width of the predictor's hidden layer.
    """

    def __init__(self, features: int, *, hidden: int = 2048, bottleneck: int = 512) -> None:
        super().__init__()
        self.projector = nn.Sequential(
            Linear(features, hidden, gain=RECTIFIER_GAIN),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            Linear(hidden, hidden, gain=RECTIFIER_GAIN),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            Linear(hidden, hidden),
            nn.BatchNorm1d(hidden),
        )
        self.predictor = nn.Sequential(
            Linear(hidden, bottleneck, gain=RECTIFIER_GAIN),
            nn.BatchNorm1d(bottleneck),
            nn.ReLU(),
            Linear(bottleneck, hidden),
        )

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the projection and its prediction [B, 2048]."""
        projection = self.projector(features)
        return projection, self.predictor(projection)


class AutoencoderHead(nn.Module):
    """Reconstruction [B, T, F] → [B, T, C, 5, 7]: a linear layer to 15 channels, then three transposed convolutions.

    Args:
        features: F.
        channels: C of the stimulus; half as many, rounded down, stand behind the linear layer.
        grid: (rows, columns) of the stimulus.

    Raises:
        UsageError: there are fewer than 2 channels.
    """

    def __init__(self, features: int, *, channels: int = 30, grid: tuple[int, int] = GRID_SHAPE) -> None:
        super().__init__()
        if channels < 2:
            raise UsageError(f"The autoencoder reconstructs 2 channels or more; received {channels}.")
        self.shape = (channels // 2, *grid)
        self.dense = Linear(features, channels // 2 * grid[0] * grid[1], gain=RECTIFIER_GAIN)
        self.layers = nn.Sequential(
            nn.ReLU(),
            nn.ConvTranspose2d(channels // 2, channels, 3, padding=1),
            nn.ReLU(),
            nn.ConvTranspose2d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.ConvTranspose2d(channels, channels, 3, padding=1),
        )

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the reconstruction of every step, in normalised units."""
        leading = features.shape[:-1]
        hidden = self.dense(features.flatten(0, -2)).unflatten(-1, self.shape)
        return self.layers(hidden).unflatten(0, leading)
