"""The choice of how convolutions, gates and scans are computed.

========================  ==================================================  ==========================================
computed by               where                                               in
========================  ==================================================  ==========================================
deferred gradients        a pass with gradients that :func:`deferring` wraps  here
fused kernels             bfloat16 on CUDA with Triton, no gradients          here
packed weights            one stimulus on the CPU, after :func:`.layers.packed`  :class:`.layers.PackedMatrix`
one matrix product        one stimulus on the CPU, many weights, no gradients  :class:`.layers.Conv2d`
scan of ``mamba_ssm``     CUDA, where the package is installed                :mod:`brainbench.models.encoders`
PyTorch                   everything else                                     :class:`.layers.Conv2d`
========================  ==================================================  ==========================================

The first two turn convolutions of small grids into matrix products of rows (one row per place of the grid, channels
innermost) and all that a gated cell does after its convolution into one kernel with a gradient of its own. Results are
equal to rounding.

Letters: B batch, C channels, (H, W) grid, R rows (stimulus, then place).

A recurrent network meets the same weights at every step. Summing their gradient step by step reads and writes all of it
every time, in products that are too small to fill a GPU; a :class:`DeferredWeightGrad` keeps both factors instead, and
one product over all steps gives the sum. O: outputs.
"""

from __future__ import annotations

import functools
import importlib.util
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from brainbench.models.ops.layers import ChannelNorm, Conv2d

HALF = torch.bfloat16


@dataclass(frozen=True)
class ConvolutionShape:
    """Kernel, padding and grids of a convolution of stride 1."""

    kernel: tuple[int, int]
    pads: tuple[int, int]
    """Zeros above and to the left."""
    grid: tuple[int, int]
    """Places of the input."""
    out: tuple[int, int]
    """Places of the result."""

    @classmethod
    def of(cls, conv: Conv2d, grid: Sequence[int]) -> ConvolutionShape:
        """Return that of a convolution on a grid (H, W)."""
        left, _, top, _ = conv.around
        rows, columns = (int(length) for length in grid)
        kernel = (int(conv.kernel_size[0]), int(conv.kernel_size[1]))
        return cls(kernel, (top, left), (rows, columns), conv.output_grid(rows, columns))

    def reversed(self) -> ConvolutionShape:
        """Return that of the convolution which takes gradients back."""
        # Taken back, every input sums over the windows that held it: these reach kernel − 1 − pad beyond the result.
        top, left = (size - 1 - pad for size, pad in zip(self.kernel, self.pads, strict=True))
        return ConvolutionShape(self.kernel, (top, left), self.out, self.grid)


def unfolded(
    inputs: Sequence[torch.Tensor], geometry: ConvolutionShape, out: torch.Tensor | None = None
) -> torch.Tensor:
    """Return the windows [R, taps · ΣC] of inputs [B, C, H, W] in half precision, in ``out`` if given."""
    from brainbench.models.ops.kernels.intersection import channels_innermost
    from brainbench.models.ops.kernels.unfold import unfold_into

    # im2col: a convolution of a small grid is one matrix product of all its windows.
    rows = len(inputs[0]) * math.prod(geometry.out)
    if out is None:
        width = math.prod(geometry.kernel) * sum(x.shape[1] for x in inputs)
        out = torch.empty(rows, width, dtype=HALF, device=inputs[0].device)
    unfold_into(out, [channels_innermost(x) for x in inputs], geometry.out, geometry.kernel, geometry.pads)
    return out


def matrix_of(weight: torch.Tensor) -> torch.Tensor:
    """Return weights [O, C, kernel] as [O, taps · C] in half precision."""
    return weight.detach().to(HALF).permute(0, 2, 3, 1).reshape(len(weight), -1)


def convolve(conv: Conv2d, inputs: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return the convolution [B, O, H', W'] of inputs that lie side by side on channels; no gradients."""
    geometry = ConvolutionShape.of(conv, inputs[0].shape[2:])
    columns = unfolded(inputs, geometry)
    return _maps(_product(columns, matrix_of(conv.weight), conv.bias), geometry)


def _product(columns: torch.Tensor, matrix: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
    if bias is None:
        return columns @ matrix.t()
    return torch.addmm(bias.detach().to(HALF), columns, matrix.t())


def _maps(rows: torch.Tensor, geometry: ConvolutionShape) -> torch.Tensor:
    return rows.view(-1, *geometry.out, rows.shape[1]).permute(0, 3, 1, 2)


class DeferredWeightGrad:
    """Both factors of the weight gradient of one convolution, kept for all steps of one pass.

    Its inputs lie on a grid (H, W); the whole pass has at most ``stimuli`` of them [1, ΣC, H, W].
    """

    def __init__(self, conv: Conv2d, grid: Sequence[int], stimuli: int) -> None:
        self.geometry = ConvolutionShape.of(conv, grid)
        self.places = math.prod(self.geometry.out)
        outputs, width = len(conv.weight), conv.weight[0].numel()
        options: dict[str, Any] = {"dtype": HALF, "device": conv.weight.device}
        self.bias = conv.bias
        self.learns = conv.weight.requires_grad
        self.shape = (stimuli * self.places if self.learns else 0, outputs)
        self.columns: torch.Tensor | None = torch.empty(self.shape[0], width, **options)
        self.gradients: torch.Tensor | None = None
        self.used = 0
        self.written: set[tuple[int, int]] = set()
        self.span = (0, 0)
        """Rows of the last result."""
        self.matrix: torch.Tensor = _WeightMatrix.apply(self, conv.weight, conv.bias)  # type: ignore[assignment]
        # The gradient of the input is the convolution with the kernel turned by 180° and its channels exchanged.
        flipped = conv.weight.detach().to(HALF).flip(2, 3).permute(2, 3, 0, 1)
        self.back = flipped.reshape(-1, conv.weight.shape[1])

    def convolve(self, inputs: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the convolution [B, O, H', W'] of inputs side by side on channels, and remember what it read."""
        return _Convolution.apply(self, self.matrix, *inputs)  # type: ignore[return-value]

    def reserve(self, stimuli: int) -> torch.Tensor | None:
        """Return where the windows of the next step are to be kept; None if nothing is learned from them."""
        if not self.learns or self.columns is None:
            return None
        first, self.used = self.used, self.used + stimuli * self.places
        self.span = first, self.used
        return self.columns[first : self.used]

    def gradient(self, span: tuple[int, int]) -> torch.Tensor | None:
        """Return where the gradient of a result is to be written; None for anywhere.

        Raises:
            RuntimeError: the pass has been taken back before.
        """
        if not self.learns:
            return None
        if self.columns is None:
            raise RuntimeError("This pass has been taken back already; compute it again to take it back again.")
        if self.gradients is None:
            self.gradients = torch.empty(self.shape, dtype=HALF, device=self.matrix.device)
        self.written.add(span)
        return self.gradients[span[0] : span[1]]

    def collect(self) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        """Return the sums [O, taps · C] and [O] over all steps; forget what they were made of."""
        columns, gradients = self.columns, self.gradients
        self.columns = self.gradients = None
        if columns is None or gradients is None:
            return None, None
        stop = 0
        for first, last in [*sorted(self.written), (self.used, self.used)]:
            gradients[stop:first].zero_()  # what no later step read
            stop = last
        columns, gradients = columns[: self.used], gradients[: self.used]
        # Sums over steps of half-precision gradients are kept in single precision.
        bias = None if self.bias is None else gradients.sum(0, dtype=torch.float32)
        # Σ_t g_tᵀ x_t of all steps as one product of [R, O] with [R, taps · C].
        return gradients.t() @ columns, bias


class _WeightMatrix(torch.autograd.Function):
    """The weights as a matrix. Its backward pass comes after that of all steps, and multiplies what they left."""

    @staticmethod
    def forward(
        ctx: Any, deferred: DeferredWeightGrad, weight: torch.Tensor, bias: torch.Tensor | None
    ) -> torch.Tensor:
        """Return the weights [O, C, kernel] as the matrix that unfolded columns are multiplied with."""
        ctx.deferred, ctx.shape = deferred, weight.shape
        ctx.set_materialize_grads(False)
        return matrix_of(weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *unused: Any) -> Any:
        """Return the gradients of weights and bias, each the sum over all steps."""
        outputs, channels, rows, columns = ctx.shape
        weight, bias = ctx.deferred.collect()
        if weight is not None:
            weight = weight.view(outputs, rows, columns, channels).permute(0, 3, 1, 2).float()
        return None, weight, bias


class _Convolution(torch.autograd.Function):
    """Convolution of one step; its backward pass leaves the gradient of the result to the pass's one product."""

    @staticmethod
    def forward(ctx: Any, deferred: DeferredWeightGrad, matrix: torch.Tensor, *inputs: torch.Tensor) -> torch.Tensor:
        """Return maps [B, O, H, W] of inputs [B, C, H, W] whose channels are joined; their columns are kept."""
        columns = unfolded(inputs, deferred.geometry, deferred.reserve(len(inputs[0])))
        ctx.deferred, ctx.span = deferred, deferred.span
        ctx.inputs = [(x.shape[1], x.dtype) for x in inputs]
        return _maps(_product(columns, matrix, deferred.bias), deferred.geometry)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *given: Any) -> Any:
        """Return the gradients of the inputs alone; that of the weights waits for the last step."""
        deferred: DeferredWeightGrad = ctx.deferred
        place = deferred.gradient(ctx.span)
        gradient = given[0] if place is None else _maps(place, deferred.geometry)
        # A fused kernel may have written the gradient to its place already; else it is copied there.
        if gradient.data_ptr() != given[0].data_ptr():
            gradient.copy_(given[0])
        if not any(ctx.needs_input_grad[2:]):
            return None, None, *(None for _ in ctx.inputs)
        back = deferred.geometry.reversed()
        # Taken back by the same kernels: windows of the gradient times the turned weights.
        gradients = _maps(unfolded([gradient], back) @ deferred.back, back)
        parts = gradients.split([channels for channels, _ in ctx.inputs], 1)
        return None, None, *(part.to(kind) for part, (_, kind) in zip(parts, ctx.inputs, strict=True))


TRITON = importlib.util.find_spec("triton") is not None  # true where the kernels can be compiled


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
        return convolve(conv, inputs)
    first = inputs[0]
    # In mixed precision a memory is single and the convolution half: what it reads is rounded here, once.
    return conv(first if len(inputs) == 1 else torch.cat([first, *(x.to(first.dtype) for x in inputs[1:])], 1))


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
        """Return [2 · norms, C] in single precision: the scales, then the shifts."""
        ctx.deferred, ctx.kinds = deferred, [weight.dtype for weight in weights]
        ctx.set_materialize_grads(False)
        return torch.stack([weight.detach().float() for weight in weights])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *unused: Any) -> Any:
        """Return the gradient [C] of each scale and shift, summed over steps."""
        # Programs left their sums apart: added here in one order, results do not differ from run to run.
        sums = ctx.deferred.sums.sum(0)
        return None, *(row.to(kind) for row, kind in zip(sums, ctx.kinds, strict=True))


def fused_gates(
    fused: torch.Tensor,
    x: torch.Tensor,
    state: torch.Tensor,
    norms: Sequence[ChannelNorm],
    deferred: tuple[DeferredNormGrad, DeferredWeightGrad] | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (y, state), both [B, C, H, W], from the pre-activations of an intersection cell's gates, by fused kernels.

    ``norms`` are those of its gates, in the order of its convolution's channels; ``deferred`` are the places for
    gradients of norms and convolution in a deferring pass. In mixed precision the new state is single, otherwise of the
    precision of the old one.
    """
    # A memory is added to at every step; in half precision small additions would be lost.
    kind = torch.float32 if torch.is_autocast_enabled(x.device.type) else state.dtype
    state = state.to(kind)
    if deferred is not None:
        return _Gates.apply(*deferred, deferred[0].norms, kind, fused, x, state)  # type: ignore[return-value]
    from brainbench.models.ops.kernels import intersection as kernels

    weights = torch.stack((*(norm.weight for norm in norms), *(norm.bias for norm in norms))) if norms else None
    return kernels.apply_gates(_rows(fused), x, state, weights, kind)


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
        """Return (y, state), both [B, C, H, W]; the state is of the type ``kind``."""
        from brainbench.models.ops.kernels import intersection as kernels

        rows = _rows(fused)
        ctx.deferred, ctx.conv, ctx.span, ctx.shape = deferred, conv, conv.span, fused.shape
        ctx.save_for_backward(rows, x, state, *(() if norms is None else (norms,)))
        return kernels.apply_gates(rows, x, state, norms, kind)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_y: torch.Tensor, d_after: torch.Tensor) -> Any:
        """Return the gradients of pre-activations, x and state; those of the norms are added to their sums."""
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
