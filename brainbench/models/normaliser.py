"""Physical units to the numbers a network sees."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from brainbench.core.contracts import CHANNELS
from brainbench.core.reading.ranges import check_number

FORCE_SCALE = 1e-4
"""N that become 1: the order of a whisker's base force in contact."""
MOMENT_SCALE = 1e-6
"""N·m that become 1."""
PUBLISHED_FORCE_SCALE = 1e-3
"""N that become 1 in the published networks, which saw mN and µN·m."""


class Normaliser(nn.Module):
    """(x − offset) / scale per channel of [B, T, C, H, W] or [B, C, H, W], in SI; buffers, not parameters.

    Without an offset silence stays silence.
    """

    scale: torch.Tensor
    offset: torch.Tensor

    def __init__(self, scale: Sequence[float], offset: Sequence[float] | None = None) -> None:
        super().__init__()
        for value in scale:
            check_number("A scale of a normaliser", value, above=0)
        for value in offset or ():
            check_number("An offset of a normaliser", value)
        self.register_buffer("scale", torch.tensor(scale).view(-1, 1, 1))
        self.register_buffer("offset", torch.tensor(offset or [0.0] * len(scale)).view(-1, 1, 1))

    @classmethod
    def physical(cls, sub_steps: int = 5, force: float = FORCE_SCALE) -> Normaliser:
        """Return the fixed scale of untrained models: forces / 1e-4 N, moments / 1e-6 N·m, sub-step-major."""
        return cls([force if name.startswith("F") else MOMENT_SCALE for name in CHANNELS] * sub_steps)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the normalised stimulus, same shape."""
        return (x - self.offset) / self.scale
