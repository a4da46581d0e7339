"""The choice of how convolutions, gates and scans are computed.

========================  ==================================================  ==========================================
computed by               where                                               in
========================  ==================================================  ==========================================
deferred gradients        a pass with gradients that :func:`deferring` wraps  :mod:`.convolution` and here
fused kernels             bfloat16 on CUDA with Triton, no gradients          :mod:`.convolution` and here
packed weights            one stimulus on the CPU, after :func:`.layers.packed`  :class:`.layers.PackedMatrix`
one matrix product        one stimulus on the CPU, many weights, no gradients  :class:`.layers.Conv2d`
scan of ``mamba_ssm``     CUDA, where the package is installed                :mod:`brainbench.models.attenders`
PyTorch                   everything else                                     :class:`.layers.Conv2d`
========================  ==================================================  ==========================================

The first two turn convolutions of small grids into matrix products of rows (one row per place of the grid, channels
innermost) and all that a gated cell does after its convolution into one kernel with a gradient of its own. Results are
equal to rounding.

Letters: B batch, C channels, (H, W) grid, R rows (stimulus, then place).
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from brainbench.models.ops import convolution
from brainbench.models.ops.convolution import HALF, DeferredWeightGrad
from brainbench.models.ops.layers import ChannelNorm, Conv2d

TRITON = importlib.util.find_spec("triton") is not None
"""True where the kernels can be compiled."""


def usable(x: torch.Tensor) -> bool:
    """Return whether the kernels apply to what is computed from ``x`` here: in bfloat16, on CUDA, not being traced."""
    if not _eager_on_cuda(x):
        return False
    # Under autocast inputs may still be single: what counts is the precision that convolutions compute in.
    half = torch.get_autocast_dtype("cuda") if torch.is_autocast_enabled("cuda") else x.dtype
    return half == torch.bfloat16 and TRITON


def selective_scan(x: torch.Tensor) -> Any:
    """Return Mamba's kernel of the package ``mamba_ssm`` for tensors on CUDA, None where it cannot be used."""
    return _mamba_kernel() if _eager_on_cuda(x) else None


def knows(conv: Conv2d, x: torch.Tensor) -> bool:
    """Return whether the kernels can compute this convolution of ``x``."""
    return tuple(conv.stride) == (1, 1) and usable(x)


def kernel_applies(conv: Conv2d, *inputs: torch.Tensor) -> bool:
    """Return whether kernels compute :func:`conv_concat` here: in a deferring pass, or where there is no gradient."""
    if conv.deferred is not None:
        return True
    learns = torch.is_grad_enabled() and any(item.requires_grad for item in (conv.weight, *inputs))
    return not learns and knows(conv, inputs[0])


def conv_concat(conv: Conv2d, inputs: Sequence[torch.Tensor]) -> torch.Tensor:
    """Convolve inputs [B, C, H, W] as if their channels lay side by side, in the first one's precision."""
    if conv.deferred is not None:
        return conv.deferred.convolve(inputs)
    if kernel_applies(conv, *inputs):
        return convolution.convolve(conv, inputs)
    first = inputs[0]
    # In mixed precision a memory is single and the convolution half: what it reads is rounded here, once.
    return conv(first if len(inputs) == 1 else torch.cat([first, *(x.to(first.dtype) for x in inputs[1:])], 1))


def apply_gates(
    cell: KernelCell, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor, *, projected: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (y, state), both [B, C, H, W], from the gates' pre-activations; ``projected`` ones have no kernel."""
    # In the deferring pass of a convolution the gates' kernels write its gradient, so they run there too.
    if cell.deferred is not None or (not projected and kernel_applies(cell.conv, x)):
        return apply_fused_gates(cell, fused, x, state)
    return cell.apply_gates(fused, x, state)


@contextmanager
def deferring(given: Iterable[tuple[Any, Any]]) -> Iterator[None]:
    """Give modules a place for deferred gradients each (convolution or cell, its place), and take it away again."""
    changed = []
    try:
        for module, place in given:
            module.deferred = place
            changed.append(module)
        yield
    finally:
        for module in changed:
            module.deferred = None


def _eager_on_cuda(x: torch.Tensor) -> bool:
    return x.is_cuda and not torch.compiler.is_compiling() and not torch.compiler.is_exporting()


@functools.cache
def _mamba_kernel() -> Any:
    try:
        from mamba_ssm.ops.selective_scan_interface import selective_scan_fn  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    return selective_scan_fn


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


class KernelCell(Protocol):
    """A cell that the kernels can compute: its gates, in the order of its convolution's channels, and their norms."""

    conv: Conv2d
    norms: nn.ModuleDict
    deferred: DeferredNormGrad | None

    @property
    def gates(self) -> tuple[str, ...]:
        """Names of the gates."""
        ...

    def norm(self, gate: str) -> ChannelNorm:
        """Return the norm of a gate."""
        ...

    def apply_gates(
        self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state) from the gates' pre-activations, by PyTorch."""
        ...


def apply_fused_gates(
    cell: KernelCell, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
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
