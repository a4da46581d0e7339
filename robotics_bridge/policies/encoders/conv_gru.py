"""A convolutional GRU on many small pictures, as matrix products.

On pictures of a few cells a convolution reads little and launches much, and layer norm over 16 channels takes longer
than both. Here each convolution is one product with a matrix that holds its kernel at every place; the mean over
channels, which layer norm takes away, is taken out of that matrix once. Weights are those of the cell itself, so
nothing else needs to know. Letters: N picture, C channel, P = rows × columns cell, L step.
"""

from __future__ import annotations

import torch
from torch import nn

from brainbench.models.cells import FORGET_BIAS, GRU

MOST_CELLS = 64
"""Cells of a picture beyond which the products outweigh what they save (they grow with the square of P)."""


class ConvGRUProducts(nn.Module):
    """Steps of a :class:`~brainbench.models.cells.GRU` with layer norm and an odd square kernel; it has no weights."""

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
            flat, found = x.flatten(0, 1).to(kind), []
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
                found.append(state)
                if ended is not None:
                    state = torch.where(ended[step][:, None], 0.0, state)
        return torch.stack(found), state

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
