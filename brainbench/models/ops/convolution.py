"""Convolutions as products of rows, and weight gradients that wait for the last step of a sweep.

A recurrent network meets the same weights at every step. Summing their gradient step by step reads and writes all of it
every time, in products that are too small to fill a GPU; a :class:`DeferredWeightGrad` keeps both factors instead, and
one product over all steps gives the sum. Letters: B batch, C channels, (H, W) grid, R rows
(stimulus, then place), O outputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from brainbench.models.ops.layers import Conv2d

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
        ctx.deferred, ctx.shape = deferred, weight.shape
        ctx.set_materialize_grads(False)
        return matrix_of(weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *unused: Any) -> Any:
        outputs, channels, rows, columns = ctx.shape
        weight, bias = ctx.deferred.collect()
        if weight is not None:
            weight = weight.view(outputs, rows, columns, channels).permute(0, 3, 1, 2).float()
        return None, weight, bias


class _Convolution(torch.autograd.Function):
    """Convolution of one step; its backward pass leaves the gradient of the result to the pass's one product."""

    @staticmethod
    def forward(ctx: Any, deferred: DeferredWeightGrad, matrix: torch.Tensor, *inputs: torch.Tensor) -> torch.Tensor:
        columns = unfolded(inputs, deferred.geometry, deferred.reserve(len(inputs[0])))
        ctx.deferred, ctx.span = deferred, deferred.span
        ctx.inputs = [(x.shape[1], x.dtype) for x in inputs]
        return _maps(_product(columns, matrix, deferred.bias), deferred.geometry)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *given: Any) -> Any:
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
