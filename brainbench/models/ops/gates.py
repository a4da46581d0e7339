"""The gates of a cell as one operation with a gradient of its own.

Letters: B batch, C channels, (H, W) grid, R rows (stimulus, then place).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

from brainbench.models.ops.convolution import HALF, DeferredWeightGrad

if TYPE_CHECKING:
    from brainbench.models.cells import ChannelNorm, IntersectionRNN


class DeferredNormGrad:
    """What the gradients of a cell's norms add up to over the steps of a pass."""

    def __init__(self, norms: list[ChannelNorm]) -> None:
        from brainbench.models.ops.kernels.intersection import PROGRAMS

        self.sums: torch.Tensor | None = None
        self.norms: torch.Tensor | None = None
        if norms:
            weights = [norm.weight for norm in norms] + [norm.bias for norm in norms]
            options: dict[str, Any] = {"dtype": torch.float32, "device": weights[0].device}
            self.sums = torch.zeros(PROGRAMS, len(weights), len(weights[0]), **options)
            self.norms = _Stacked.apply(self, *weights)  # type: ignore[assignment]


class _Stacked(torch.autograd.Function):
    """Scales and shifts as one array. Its backward pass comes after that of all steps, which left their sums."""

    @staticmethod
    def forward(ctx: Any, tape: DeferredNormGrad, *weights: torch.Tensor) -> torch.Tensor:
        ctx.tape, ctx.kinds = tape, [weight.dtype for weight in weights]
        ctx.set_materialize_grads(False)
        return torch.stack([weight.detach().float() for weight in weights])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *unused: Any) -> Any:
        sums = ctx.tape.sums.sum(0)
        return None, *(row.to(kind) for row, kind in zip(sums, ctx.kinds, strict=True))


def settle(
    cell: IntersectionRNN, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what ``cell.settle`` returns: (y, state), both [B, C, H, W].

    In mixed precision the new state is single, otherwise of the precision of the old one.
    """
    kind = torch.float32 if torch.is_autocast_enabled(x.device.type) else state.dtype
    state = state.to(kind)
    if cell.tape is not None:
        return _Settled.apply(cell.tape, cell.conv.tape, cell.tape.norms, kind, fused, x, state)  # type: ignore[return-value]
    from brainbench.models.ops.kernels import intersection as kernels

    norms = None
    if cell.norms:
        chosen = [cell.norm(name) for name in cell.gates]
        norms = torch.stack((*(norm.weight for norm in chosen), *(norm.bias for norm in chosen)))
    return kernels.settle(_rows(fused), x, state, norms, kind)


def _rows(maps: torch.Tensor) -> torch.Tensor:
    return maps.permute(0, 2, 3, 1).reshape(-1, maps.shape[1])


class _Settled(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        tape: DeferredNormGrad,
        conv: DeferredWeightGrad,
        norms: torch.Tensor | None,
        kind: torch.dtype,
        fused: torch.Tensor,
        x: torch.Tensor,
        state: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        from brainbench.models.ops.kernels import intersection as kernels

        rows = _rows(fused)
        ctx.tape, ctx.conv, ctx.span, ctx.shape = tape, conv, conv.span, fused.shape
        ctx.save_for_backward(rows, x, state, *(() if norms is None else (norms,)))
        return kernels.settle(rows, x, state, norms, kind)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_y: torch.Tensor, d_after: torch.Tensor) -> Any:
        from brainbench.models.ops.kernels import intersection as kernels

        rows, x, state, *norms = ctx.saved_tensors
        # Straight to where the gradient of the convolution's weights will look for it.
        place = ctx.conv.gradient(ctx.span)
        d_fused = torch.empty_like(rows, dtype=HALF) if place is None else place
        d_x, d_state = kernels.settle_backward(
            rows, x, state, norms[0] if norms else None, d_y, d_after, d_fused, ctx.tape.sums
        )
        batch, channels, height, width = ctx.shape
        d_maps = d_fused.view(batch, height, width, channels).permute(0, 3, 1, 2)
        return None, None, None, None, d_maps, d_x, d_state


@contextmanager
def recorded(tapes: Iterable[tuple[Any, Any]]) -> Iterator[None]:
    """Give modules a tape each, and take it away again: (convolution, Tape) or (cell, GateTape)."""
    given = []
    try:
        for module, tape in tapes:
            module.tape = tape
            given.append(module)
        yield
    finally:
        for module in given:
            module.tape = None
