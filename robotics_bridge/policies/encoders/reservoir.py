"""Parts that make random and trained encoders comparable: an echo-state network, and features standardised one by one.

Letters: B batch, I input, U unit, F feature.
"""

from __future__ import annotations

import torch
from torch import nn

UNITS = 96
"""Units of a reservoir, as many as the features of the small networks."""
_LEAK, _RADIUS, _OFFSET = 0.5, 0.9, 0.1
_FARTHEST = 10.0
"""Standard deviations to which features are cut."""


class EchoState(nn.Module):
    """A random recurrent network that learns nothing: x ← (1 − a) x + a tanh(u + W x + b), spectral radius .9.

    The same seed gives the same network on every machine.
    """

    inputs: torch.Tensor
    """[I, U]: standard normal."""
    inner: torch.Tensor
    offset: torch.Tensor

    def __init__(self, inputs: int, units: int = UNITS, *, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randn(inputs, units, generator=generator)
        inner = torch.randn(units, units, generator=generator)
        inner *= _RADIUS / torch.linalg.eigvals(inner).abs().max()
        offset = _OFFSET * torch.randn(units, generator=generator)
        for name, value in (("inputs", drawn), ("inner", inner), ("offset", offset)):
            # Not weights: they follow from the seed, so files of weights need not hold them.
            self.register_buffer(name, value, persistent=False)

    def drive(self, x: torch.Tensor) -> torch.Tensor:
        """Return the drive u [B, U] of inputs [B, I] of which those that are not silent have an rms of 1.

        A quarter of a hand's sites or fewer are touched at a time, so that it is of the order of 1.
        """
        return 2.0 * x.shape[-1] ** -0.5 * (x @ self.inputs)

    def forward(self, drive: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Return the state [B, U] after one step of a drive u [B, U]."""
        return (1 - _LEAK) * state + _LEAK * torch.tanh(drive + state @ self.inner + self.offset)


class FeatureNorm(nn.Module):
    """Features [..., F] less their mean over their standard deviation, over all that was seen in training mode.

    Unlike layer norm it takes away what is the same in every step, and unlike batch norm it acts alike in training and
    after it.
    """

    count: torch.Tensor
    mean: torch.Tensor
    square: torch.Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(1, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(features, dtype=torch.float64))
        self.register_buffer("square", torch.ones(features, dtype=torch.float64))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the standardised features; in training mode they are counted first."""
        if self.training:
            with torch.no_grad():
                flat = x.detach().reshape(-1, x.shape[-1]).double()
                self.count += len(flat)
                share = len(flat) / self.count
                self.mean += share * (flat.mean(0) - self.mean)
                self.square += share * (flat.square().mean(0) - self.square)
        spread = (self.square - self.mean.square()).clamp(min=0).sqrt()
        # Features of untrained networks are small by orders of magnitude, so what counts as constant is relative: to
        # the other features, and to the feature's own mean, of which single precision keeps seven digits.
        spread = torch.maximum(spread, 1e-6 * spread.max())
        spread = torch.maximum(spread, 1e-2 * self.mean.abs()).clamp(min=1e-30)
        return ((x.float() - self.mean.float()) / spread.float()).clamp(-_FARTHEST, _FARTHEST)
