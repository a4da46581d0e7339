"""Recurrent parts of encoders: a convolutional GRU as matrix products, a random echo-state network, feature norms.

Letters: N picture, C channel, P = rows × columns cell, L step, B batch, I input, U unit, F feature.
"""

from __future__ import annotations

import torch
from torch import nn

from brainbench.models.cells import FORGET_BIAS, GRU

MOST_CELLS = 64
"""Cells of a picture beyond which the products outweigh what they save (they grow with the square of P)."""


class ConvGRUProducts(nn.Module):
    """Steps of a :class:`~brainbench.models.cells.GRU` with layer norm and an odd square kernel; it has no weights.

    On pictures of a few cells a convolution reads little and launches much, and layer norm over 16 channels takes
    longer than both. Here each convolution is one product with a matrix that holds its kernel at every place; the mean
    over channels, which layer norm takes away, is taken out of that matrix once. Weights are those of the cell itself.
    """

    places: torch.Tensor
    """[kernel², P, P]: whether cell p stands at this place of the kernel around cell q."""

    def __init__(self, rows: int, columns: int, kernel: int) -> None:
        super().__init__()
        cells = torch.arange(rows * columns)
        # Offset from cell q to cell p as a place of the kernel; places outside belong to no product, which pads with
        # zeros.
        down = cells[:, None] // columns - cells[None, :] // columns + kernel // 2
        right = cells[:, None] % columns - cells[None, :] % columns + kernel // 2
        inside = (down >= 0) & (down < kernel) & (right >= 0) & (right < kernel)
        place = torch.where(inside, down * kernel + right, -1)
        places = torch.stack([(place == index).float() for index in range(kernel**2)])
        self.register_buffer("places", places, persistent=False)

    def forward(
        self, cell: GRU, x: torch.Tensor, state: torch.Tensor, ended: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y [L, N, C·P], state [N, C·P] single) of pictures x [L, N, inputs·P] from a state.

        The state is forgotten after a step where ``ended`` [L, N]; None for nowhere.
        """
        gates, candidate = self._gates(cell, ("r", "u")), self._gates(cell, ("c",))
        kind = torch.get_autocast_dtype(x.device.type) if torch.is_autocast_enabled(x.device.type) else x.dtype
        with torch.autocast(x.device.type, enabled=False):
            inputs = cell.in_channels * len(self.places[0])
            split = [matrix.to(kind).split([inputs, len(matrix) - inputs]) for matrix, _ in (gates, candidate)]
            flat, states = x.flatten(0, 1).to(kind), []
            shares = [
                torch.addmm(bias.to(kind), flat, parts[0]).unflatten(0, x.shape[:2])
                for parts, (_, bias) in zip(split, (gates, candidate), strict=True)
            ]
            for step in range(len(x)):
                fused = torch.addmm(shares[0][step], state.to(kind), split[0][1])
                reset, keep = self._normalised(cell, fused, ("r", "u"))
                remembered = torch.sigmoid(reset + FORGET_BIAS) * state.to(kind)
                new = self._normalised(cell, torch.addmm(shares[1][step], remembered, split[1][1]), ("c",))[0]
                # h = u h + (1 − u) c. The state stays in single precision, since small updates vanish in half
                # precision.
                state = torch.lerp(torch.tanh(new).float(), state.float(), torch.sigmoid(keep).float())
                states.append(state)
                if ended is not None:
                    state = torch.where(ended[step][:, None], 0.0, state)
        return torch.stack(states), state

    def _gates(self, cell: GRU, names: tuple[str, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the matrix [(inputs + C)·P, gates·C·P] and bias of some gates, without their mean over channels."""
        conv = cell.candidate if names == ("c",) else cell.conv
        assert conv.bias is not None
        weight = conv.weight.float().unflatten(0, (len(names), -1))
        bias = conv.bias.float().unflatten(0, (len(names), -1))
        # Layer norm subtracts the mean over channels, which is linear: taken out of the weights, it costs nothing per
        # step.
        weight, bias = weight - weight.mean(1, keepdim=True), bias - bias.mean(1, keepdim=True)
        # The convolution as a dense matrix over all pairs of cells, in one product with the places of the kernel.
        everywhere = weight.flatten(3).flatten(0, 1) @ self.places.flatten(1)  # [O, I, P·P]
        cells = len(self.places[0])
        matrix = everywhere.unflatten(2, (cells, cells)).permute(1, 2, 0, 3).flatten(2).flatten(0, 1)
        return matrix, bias.flatten().repeat_interleave(cells)

    def _normalised(self, cell: GRU, fused: torch.Tensor, names: tuple[str, ...]) -> list[torch.Tensor]:
        """Return the gates [N, C·P] of centred pre-activations [N, gates·C·P] (Ba et al. 2016)."""
        norms = [cell.norms[name] for name in names]
        parts = fused.unflatten(1, (len(names), cell.out_channels, -1))
        # The mean is gone already, so the variance is the mean square; its sum is taken in single precision.
        size = torch.linalg.vector_norm(parts, dim=2, keepdim=True, dtype=torch.float32)
        scale = torch.rsqrt(size.square() / cell.out_channels + norms[0].eps).to(fused.dtype)  # type: ignore[operator]
        gain, bias = (torch.stack([getattr(norm, name) for norm in norms])[..., None] for name in ("weight", "bias"))
        whole = torch.addcmul(bias.to(fused.dtype), parts * scale, gain.to(fused.dtype))
        return [part.flatten(1) for part in whole.unbind(1)]


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
