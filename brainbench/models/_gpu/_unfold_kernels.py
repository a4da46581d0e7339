"""The windows of a convolution as rows of a matrix, in one kernel per input: padded, joined and rounded on the way.

Letters: R rows (stimulus, then place), C channels, (H, W) grid.
"""

import math

import torch
import triton
import triton.language as tl

TILE = 2048


@triton.jit
def unfold_kernel(
    x,
    out,
    rows,
    batch_stride,
    channels,
    row_stride,
    place_stride,
    start,
    width,
    UNIT: tl.constexpr,
    H: tl.constexpr,
    W: tl.constexpr,
    OUT_H: tl.constexpr,
    OUT_W: tl.constexpr,
    KERNEL_H: tl.constexpr,
    KERNEL_W: tl.constexpr,
    TOP: tl.constexpr,
    LEFT: tl.constexpr,
    BLOCK_R: tl.constexpr,
    BLOCK_C: tl.constexpr,
):
    """Write the windows of one input to its columns ``start`` to ``start + channels`` of every tap's ``width``.

    All that is counted in channels comes in units, so that the compiler knows how far addresses are aligned.
    """
    r = tl.program_id(0) * BLOCK_R + tl.arange(0, BLOCK_R)
    c = tl.program_id(1) * BLOCK_C + tl.arange(0, BLOCK_C)
    stimulus, place = r // (OUT_H * OUT_W), r % (OUT_H * OUT_W)
    top, left = place // OUT_W - TOP, place % OUT_W - LEFT
    inside = (r < rows)[:, None] & (c < channels * UNIT)[None, :]
    source = x + (stimulus.to(tl.int64) * batch_stride)[:, None] + c[None, :]
    target = out + (r.to(tl.int64) * (KERNEL_H * KERNEL_W * width * UNIT))[:, None] + (start * UNIT + c)[None, :]
    for i in tl.static_range(KERNEL_H):
        for j in tl.static_range(KERNEL_W):
            h, w = top + i, left + j
            there = (h >= 0) & (h < H) & (w >= 0) & (w < W)
            offset = ((h * row_stride + w * place_stride) * UNIT)[:, None]
            value = tl.load(source + offset, mask=inside & there[:, None], other=0.0)
            tl.store(target + (i * KERNEL_W + j) * width * UNIT, value.to(out.dtype.element_ty), mask=inside)


def unfold_into(
    out: torch.Tensor,
    inputs: list[torch.Tensor],
    grid: tuple[int, int],
    kernel: tuple[int, int],
    pads: tuple[int, int],
) -> None:
    """Fill ``out`` [R, taps · ΣC] with windows of inputs [B, C, H, W] whose channels lie side by side.

    Args:
        out: Contiguous; its precision is what inputs are rounded to.
        inputs: On one grid; channels innermost in memory.
        grid: Places (rows, columns) of the result.
        kernel: Size of the window.
        pads: Zeros (above, left) of the inputs.
    """
    width, start = sum(x.shape[1] for x in inputs), 0
    for x in inputs:
        channels = x.shape[1]
        block = min(128, triton.next_power_of_2(channels))
        tall = TILE // block
        unit = math.gcd(8, channels, start, width, x.stride(2), x.stride(3))
        unfold_kernel[triton.cdiv(len(out), tall), triton.cdiv(channels, block)](
            x,
            out,
            len(out),
            x.stride(0),
            *(value // unit for value in (channels, x.stride(2), x.stride(3), start, width)),
            unit,
            *x.shape[2:],
            *grid,
            *kernel,
            *pads,
            tall,
            block,
        )
        start += channels
