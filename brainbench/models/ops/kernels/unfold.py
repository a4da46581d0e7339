"""The windows of a convolution as rows of a matrix, in one kernel: padded, joined and rounded on the way.

Letters: R rows (stimulus, then place), C channels, (H, W) grid.
"""

import math

import torch
import triton
import triton.language as tl

TILE = 2048  # numbers that a program writes, all in one piece
SLOTS = 4  # inputs of one kernel; more are joined before


@triton.jit
def _from(
    x, stimulus, batch_stride, h, w, row_stride, place_stride, c, there, FIRST: tl.constexpr, C: tl.constexpr,
    UNIT: tl.constexpr,
):  # fmt: skip
    """Return the numbers of an input whose channels begin at ``FIRST``; zeros where others have theirs."""
    c -= FIRST
    mask = there & (c >= 0) & (c < C)
    offset = stimulus.to(tl.int64) * batch_stride + h * row_stride + w * place_stride + c
    offset = offset[:, None] * UNIT + tl.arange(0, UNIT)[None, :]
    return tl.load(x + offset, mask=mask[:, None], other=0.0).to(tl.float32)


@triton.jit
def unfold_kernel(
    x0, x1, x2, x3, out, total,
    batch0, batch1, batch2, batch3, row0, row1, row2, row3, place0, place1, place2, place3,
    C0: tl.constexpr, C1: tl.constexpr, C2: tl.constexpr, C3: tl.constexpr, UNIT: tl.constexpr,
    H: tl.constexpr, W: tl.constexpr, OUT_H: tl.constexpr, OUT_W: tl.constexpr,
    KERNEL_H: tl.constexpr, KERNEL_W: tl.constexpr, TOP: tl.constexpr, LEFT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the windows of all inputs, whose channels lie side by side in every tap.

    A thread's share is ``UNIT`` numbers, and all strides and channels come in units: threads that follow one another
    write what follows in memory, whatever the channels are.
    """
    WIDTH: tl.constexpr = C0 + C1 + C2 + C3
    start = tl.program_id(0).to(tl.int64) * BLOCK
    inner = tl.arange(0, BLOCK)
    unit = (start + inner).to(tl.uint32)
    inside = start + inner < total
    # The flat index is (stimulus, place, tap, channel), channels innermost.
    window, c = unit // WIDTH, (unit % WIDTH).to(tl.int32)
    r, tap = window // (KERNEL_H * KERNEL_W), (window % (KERNEL_H * KERNEL_W)).to(tl.int32)
    stimulus, place = r // (OUT_H * OUT_W), (r % (OUT_H * OUT_W)).to(tl.int32)
    # Place of the input under this tap; taps outside the grid read the zeros of the padding.
    h, w = place // OUT_W - TOP + tap // KERNEL_W, place % OUT_W - LEFT + tap % KERNEL_W
    there = inside & (h >= 0) & (h < H) & (w >= 0) & (w < W)
    value = _from(x0, stimulus, batch0, h, w, row0, place0, c, there, 0, C0, UNIT)
    # A channel belongs to one input and the others give zero for it, so the sum picks the right one.
    if C1 > 0:
        value += _from(x1, stimulus, batch1, h, w, row1, place1, c, there, C0, C1, UNIT)
    if C2 > 0:
        value += _from(x2, stimulus, batch2, h, w, row2, place2, c, there, C0 + C1, C2, UNIT)
    if C3 > 0:
        value += _from(x3, stimulus, batch3, h, w, row3, place3, c, there, C0 + C1 + C2, C3, UNIT)
    target = out + start * UNIT + inner[:, None] * UNIT + tl.arange(0, UNIT)[None, :]
    tl.store(target, value.to(out.dtype.element_ty), mask=inside[:, None])


def unfold_into(
    out: torch.Tensor, inputs: list[torch.Tensor], grid: tuple[int, int], kernel: tuple[int, int], pads: tuple[int, int]
) -> None:
    """Fill ``out`` [R, taps · ΣC] with windows of inputs [B, C, H, W] whose channels lie side by side.

    ``out`` is contiguous, and its precision is what inputs are rounded to; they lie on one grid, channels innermost in
    memory. ``grid`` counts places (rows, columns) of the result, ``pads`` zeros (above, left) of the inputs.
    """
    if len(inputs) > SLOTS:
        joined = torch.cat([x.permute(0, 2, 3, 1).to(out.dtype) for x in inputs[SLOTS - 1 :]], 3).permute(0, 3, 1, 2)
        inputs = [*inputs[: SLOTS - 1], joined]
    channels = [x.shape[1] for x in inputs] + [0] * (SLOTS - len(inputs))
    used = [*inputs, *(inputs[0] for _ in range(SLOTS - len(inputs)))]
    strides = [[x.stride(axis) for x in used] for axis in (0, 2, 3)]
    # Largest common divisor of strides and channels, up to 8 numbers: 16 bytes in half precision, one access to memory.
    unit = math.gcd(8, *channels, *(value for axis in strides for value in axis))
    total = out.numel() // unit
    # The kernel takes its index apart as a 32-bit number, which limits one launch.
    if total >= 2**32:
        raise ValueError(f"{out.numel():,} numbers of windows are too many for one kernel; compute fewer at a time.")
    block = TILE // unit
    unfold_kernel[(triton.cdiv(total, block),)](
        *used,
        out,
        total,
        *(value // unit for axis in strides for value in axis),
        *(value // unit for value in channels),
        unit,
        *inputs[0].shape[2:],
        *grid,
        *kernel,
        *pads,
        block,
    )
