"""The gates of a cell as one operation with a gradient of its own.

Letters: B batch, C channels, (H, W) grid, R rows (stimulus, then place).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

from brainbench.models.ops.convolution import HALF, DeferredWeightGrad

if TYPE_CHECKING:
    from brainbench.models.cells import IntersectionRNN
    from brainbench.models.cells.cell import CellStep, ChannelNorm


class DeferredNormGrad:
    """Sums of the gradients of a cell's norms over the steps of a pass."""

    def __init__(self, norms: list[ChannelNorm]) -> None:
        from brainbench.models.ops.kernels.intersection import PROGRAMS

        self.sums: torch.Tensor | None = None
        self.norms: torch.Tensor | None = None
        if norms:
            weights = [norm.weight for norm in norms] + [norm.bias for norm in norms]
            options: dict[str, Any] = {"dtype": torch.float32, "device": weights[0].device}
            self.sums = torch.zeros(PROGRAMS, len(weights), len(weights[0]), **options)
            self.norms = _NormWeights.apply(self, *weights)  # type: ignore[assignment]


class _NormWeights(torch.autograd.Function):
    """Scales and shifts as one array. Its backward pass comes after that of all steps, which left their sums."""

    @staticmethod
    def forward(ctx: Any, deferred: DeferredNormGrad, *weights: torch.Tensor) -> torch.Tensor:
        ctx.deferred, ctx.kinds = deferred, [weight.dtype for weight in weights]
        ctx.set_materialize_grads(False)
        return torch.stack([weight.detach().float() for weight in weights])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *unused: Any) -> Any:
        # Programs left their sums apart: added here in one order, results do not differ from run to run.
        sums = ctx.deferred.sums.sum(0)
        return None, *(row.to(kind) for row, kind in zip(sums, ctx.kinds, strict=True))


def apply_gates(cell: IntersectionRNN, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> CellStep:
    """Return what ``cell.apply_gates`` returns, by fused kernels: (y, state), both [B, C, H, W].

    In mixed precision the new state is single, otherwise of the precision of the old one.
    """
    # A memory is added to at every step; in half precision small additions would be lost.
    kind = torch.float32 if torch.is_autocast_enabled(x.device.type) else state.dtype
    state = state.to(kind)
    if cell.deferred is not None:
        return _Gates.apply(  # type: ignore[return-value]
            cell.deferred, cell.conv.deferred, cell.deferred.norms, kind, fused, x, state
        )
    from brainbench.models.ops.kernels import intersection as kernels

    norms = None
    if cell.norms:
        chosen = [cell.norm(name) for name in cell.gates]
        norms = torch.stack((*(norm.weight for norm in chosen), *(norm.bias for norm in chosen)))
    return kernels.apply_gates(_rows(fused), x, state, norms, kind)


def _rows(maps: torch.Tensor) -> torch.Tensor:
    return maps.permute(0, 2, 3, 1).reshape(-1, maps.shape[1])


class _Gates(torch.autograd.Function):
    """Fused gates of one step: (pre-activations, x, state) → (y, state), all [B, C, H, W] but for the first's 4 C."""

    @staticmethod
    def forward(
        ctx: Any,
        deferred: DeferredNormGrad,
        conv: DeferredWeightGrad,
        norms: torch.Tensor | None,
        kind: torch.dtype,
        fused: torch.Tensor,
        x: torch.Tensor,
        state: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        from brainbench.models.ops.kernels import intersection as kernels

        rows = _rows(fused)
        ctx.deferred, ctx.conv, ctx.span, ctx.shape = deferred, conv, conv.span, fused.shape
        ctx.save_for_backward(rows, x, state, *(() if norms is None else (norms,)))
        return kernels.apply_gates(rows, x, state, norms, kind)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_y: torch.Tensor, d_after: torch.Tensor) -> Any:
        from brainbench.models.ops.kernels import intersection as kernels

        rows, x, state, *norms = ctx.saved_tensors
        # Straight to where the gradient of the convolution's weights will look for it.
        place = ctx.conv.gradient(ctx.span)
        d_fused = torch.empty_like(rows, dtype=HALF) if place is None else place
        d_x, d_state = kernels.apply_gates_backward(
            rows, x, state, norms[0] if norms else None, d_y, d_after, d_fused, ctx.deferred.sums
        )
        batch, channels, height, width = ctx.shape
        d_maps = d_fused.view(batch, height, width, channels).permute(0, 3, 1, 2)
        return None, None, None, None, d_maps, d_x, d_state
