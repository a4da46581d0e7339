"""The choice of how convolutions, gates and scans are computed.

========================  ==================================================  ==========================================
computed by               where                                               in
========================  ==================================================  ==========================================
deferred gradients        a pass with gradients that :func:`deferring` wraps  :mod:`.convolution`, :mod:`.gates`
fused kernels             bfloat16 on CUDA with Triton, no gradients          :mod:`.convolution`, :mod:`.gates`
packed weights            one stimulus on the CPU, after :mod:`.packing`      :class:`.layers.PackedMatrix`
one matrix product        one stimulus on the CPU, many weights, no gradients  :class:`.layers.Conv2d`
scan of ``mamba_ssm``     CUDA, where the package is installed                :mod:`brainbench.models.attenders.mamba`
PyTorch                   everything else                                     :class:`.layers.Conv2d`
========================  ==================================================  ==========================================

The first two turn convolutions of small grids into matrix products of rows (one row per place of the grid, channels
innermost) and all that a gated cell does after its convolution into one kernel. Results are equal to rounding.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch

from brainbench.models.ops import convolution, gates
from brainbench.models.ops.layers import Conv2d

if TYPE_CHECKING:
    from brainbench.models.cells import IntersectionRNN

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
    cell: IntersectionRNN, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor, *, projected: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (y, state), both [B, C, H, W], from the gates' pre-activations; ``projected`` ones have no kernel."""
    if cell.deferred is not None or (not projected and kernel_applies(cell.conv, x)):
        return gates.apply_gates(cell, fused, x, state)
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
