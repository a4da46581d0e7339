"""The gates of an IntersectionRNN, after its convolution (Collins et al. 2017): a kernel forward, a kernel backward.

With p, m, q, n the four gates' pre-activations, normalised over channels if asked (Ba et al. 2016): s' = σ(p + 1) s +
(1 − σ(p + 1)) tanh(m) and y = σ(q + 1) x + (1 − σ(q + 1)) relu(n). Letters: R rows (stimulus, then place), C channels.
"""

from typing import Any

import torch
import triton
import triton.language as tl

EPS = 1e-5
TILE = 2048  # numbers of one gate that a program holds at a time
WARPS = 8
BACK_WARPS = 4
"""Warps of a backward pass: fewer threads that keep more each take 72, not 84 µs (384 channels, NVIDIA H200)."""
PROGRAMS = 264
"""Programs of a backward pass: each sums the gradients of the norms over its own rows, always in the same order."""


@triton.jit
def _normalised(
    fused, norms, rows, c, inside, GATE: tl.constexpr, C: tl.constexpr, NORM: tl.constexpr, EPS: tl.constexpr
):
    """Return (what the gate sees, its normalised form before scale and shift, the inverse deviation)."""
    value = tl.load(fused + (rows.to(tl.int64) * (4 * C))[:, None] + (GATE * C + c)[None, :], mask=inside, other=0.0)
    value = value.to(tl.float32)
    inverse = tl.full((rows.shape[0],), 1.0, tl.float32)
    hat = value
    if NORM:
        # Layer norm over channels; the row is in registers, so the mean is taken first and no digits cancel.
        mean = tl.sum(value, 1) / C
        centred = tl.where(inside, value - mean[:, None], 0.0)
        inverse = 1.0 / tl.sqrt(tl.sum(centred * centred, 1) / C + EPS)
        hat = centred * inverse[:, None]
        weight = tl.load(norms + GATE * C + c, mask=c < C, other=0.0).to(tl.float32)
        bias = tl.load(norms + (4 + GATE) * C + c, mask=c < C, other=0.0).to(tl.float32)
        value = hat * weight[None, :] + bias[None, :]
    return value, hat, inverse


@triton.jit
def _tanh(x):
    # tanh v = 2σ(2v) − 1, which saturates without overflow.
    return 2.0 * tl.sigmoid(2.0 * x) - 1.0


@triton.jit
def _at(pointer, rows, c, batch_stride, PLACES: tl.constexpr, PLACE_STRIDE: tl.constexpr):
    places = (rows // PLACES).to(tl.int64) * batch_stride + (rows % PLACES) * PLACE_STRIDE
    return pointer + places[:, None] + c[None, :]


@triton.jit
def gates_kernel(
    fused, x, state, norms, y, after, count, x_batch, state_batch,
    PLACES: tl.constexpr, X_PLACE: tl.constexpr, STATE_PLACE: tl.constexpr,
    C: tl.constexpr, NORM: tl.constexpr, EPS: tl.constexpr, BLOCK_R: tl.constexpr, BLOCK_C: tl.constexpr,
):  # fmt: skip
    """Write y and s' [R, C]. A program takes ``BLOCK_R`` rows with all their channels."""
    rows = tl.program_id(0) * BLOCK_R + tl.arange(0, BLOCK_R)
    c = tl.arange(0, BLOCK_C)
    inside = (rows < count)[:, None] & (c < C)[None, :]
    through, _, _ = _normalised(fused, norms, rows, c, inside, 2, C, NORM, EPS)
    through = tl.sigmoid(through + 1.0)
    output, _, _ = _normalised(fused, norms, rows, c, inside, 3, C, NORM, EPS)
    seen = tl.load(_at(x, rows, c, x_batch, PLACES, X_PLACE), mask=inside, other=0.0).to(tl.float32)
    to = (rows.to(tl.int64) * C)[:, None] + c[None, :]
    # Output of the cell, h = y x + (1 − y) n (thesis, text after equation 3.3).
    answer = through * seen + (1.0 - through) * tl.maximum(output, 0.0)
    tl.store(y + to, answer.to(y.dtype.element_ty), mask=inside)
    keep, _, _ = _normalised(fused, norms, rows, c, inside, 0, C, NORM, EPS)
    keep = tl.sigmoid(keep + 1.0)
    candidate, _, _ = _normalised(fused, norms, rows, c, inside, 1, C, NORM, EPS)
    old = tl.load(_at(state, rows, c, state_batch, PLACES, STATE_PLACE), mask=inside, other=0.0).to(tl.float32)
    # State of the cell, s = p s + (1 − p) m (thesis, text after equation 3.3).
    new = keep * old + (1.0 - keep) * _tanh(candidate)
    tl.store(after + to, new.to(after.dtype.element_ty), mask=inside)


@triton.jit
def _store_gate(
    d_fused, norms, gradient, hat, inverse, rows, c, inside, GATE: tl.constexpr, C: tl.constexpr, NORM: tl.constexpr
):
    """Write the gradient of a gate's pre-activation from that of its normalised form."""
    if NORM:
        weight = tl.load(norms + GATE * C + c, mask=c < C, other=0.0).to(tl.float32)
        # Layer norm taken back: (g − mean g − x̂ mean(g x̂))/σ with g the scaled gradient and x̂ the normalised value.
        scaled = gradient * weight[None, :]
        mean = tl.sum(scaled, 1) / C
        along = tl.sum(scaled * hat, 1) / C
        gradient = (scaled - mean[:, None] - hat * along[:, None]) * inverse[:, None]
    to = d_fused + (rows.to(tl.int64) * (4 * C))[:, None] + (GATE * C + c)[None, :]
    tl.store(to, gradient.to(d_fused.dtype.element_ty), mask=inside)


@triton.jit
def _add(at, gradient, c, C: tl.constexpr):
    tl.store(at, tl.load(at, mask=c < C, other=0.0) + tl.sum(gradient, 0), mask=c < C)


@triton.jit
def gates_backward_kernel(
    fused, x, state, norms, d_y, d_after, d_fused, d_x, d_state, sums,
    count, x_batch, state_batch, d_y_batch, d_after_batch,
    PLACES: tl.constexpr, X_PLACE: tl.constexpr, STATE_PLACE: tl.constexpr,
    D_Y_PLACE: tl.constexpr, D_AFTER_PLACE: tl.constexpr,
    C: tl.constexpr, NORM: tl.constexpr, EPS: tl.constexpr, BLOCK_R: tl.constexpr, BLOCK_C: tl.constexpr,
):  # fmt: skip
    """Write the gradients of pre-activations [R, 4 C], x and s [R, C]; add those of the norms to this program's sums.

    A program takes every num_programs-th block of ``BLOCK_R`` rows, with all their channels.
    """
    c = tl.arange(0, BLOCK_C)
    # Kept apart by row until the end: threads that share a sum would race for its place in memory.
    scale0 = tl.zeros((BLOCK_R, BLOCK_C), tl.float32)
    scale1, scale2, scale3 = scale0, scale0, scale0
    shift0, shift1, shift2, shift3 = scale0, scale0, scale0, scale0
    block = tl.program_id(0)
    while block * BLOCK_R < count:
        rows = block * BLOCK_R + tl.arange(0, BLOCK_R)
        block += tl.num_programs(0)
        inside = (rows < count)[:, None] & (c < C)[None, :]
        to = (rows.to(tl.int64) * C)[:, None] + c[None, :]

        got = tl.load(_at(d_y, rows, c, d_y_batch, PLACES, D_Y_PLACE), mask=inside, other=0.0).to(tl.float32)
        through, through_hat, through_inverse = _normalised(fused, norms, rows, c, inside, 2, C, NORM, EPS)
        output, output_hat, output_inverse = _normalised(fused, norms, rows, c, inside, 3, C, NORM, EPS)
        through = tl.sigmoid(through + 1.0)
        seen = tl.load(_at(x, rows, c, x_batch, PLACES, X_PLACE), mask=inside, other=0.0).to(tl.float32)
        tl.store(d_x + to, (got * through).to(d_x.dtype.element_ty), mask=inside)
        # With σ' = σ(1 − σ): the output gate gets ∂L/∂h (x − n) y (1 − y), its candidate ∂L/∂h (1 − y) where n > 0.
        gradient = got * (seen - tl.maximum(output, 0.0)) * through * (1.0 - through)
        _store_gate(d_fused, norms, gradient, through_hat, through_inverse, rows, c, inside, 2, C, NORM)
        if NORM:
            scale2 += gradient * through_hat
            shift2 += gradient
        gradient = tl.where(output > 0.0, got * (1.0 - through), 0.0)
        _store_gate(d_fused, norms, gradient, output_hat, output_inverse, rows, c, inside, 3, C, NORM)
        if NORM:
            scale3 += gradient * output_hat
            shift3 += gradient

        pointer = _at(d_after, rows, c, d_after_batch, PLACES, D_AFTER_PLACE)
        got = tl.load(pointer, mask=inside, other=0.0).to(tl.float32)
        keep, keep_hat, keep_inverse = _normalised(fused, norms, rows, c, inside, 0, C, NORM, EPS)
        candidate, candidate_hat, candidate_inverse = _normalised(fused, norms, rows, c, inside, 1, C, NORM, EPS)
        keep, candidate = tl.sigmoid(keep + 1.0), _tanh(candidate)
        old = tl.load(_at(state, rows, c, state_batch, PLACES, STATE_PLACE), mask=inside, other=0.0).to(tl.float32)
        tl.store(d_state + to, (got * keep).to(d_state.dtype.element_ty), mask=inside)
        # The state gate gets ∂L/∂s (s − m) p (1 − p), its candidate ∂L/∂s (1 − p)(1 − m²).
        gradient = got * (old - candidate) * keep * (1.0 - keep)
        _store_gate(d_fused, norms, gradient, keep_hat, keep_inverse, rows, c, inside, 0, C, NORM)
        if NORM:
            scale0 += gradient * keep_hat
            shift0 += gradient
        gradient = got * (1.0 - keep) * (1.0 - candidate * candidate)
        _store_gate(d_fused, norms, gradient, candidate_hat, candidate_inverse, rows, c, inside, 1, C, NORM)
        if NORM:
            scale1 += gradient * candidate_hat
            shift1 += gradient
    if NORM:
        at = sums + tl.program_id(0) * (8 * C) + c
        _add(at, scale0, c, C)
        _add(at + C, scale1, c, C)
        _add(at + 2 * C, scale2, c, C)
        _add(at + 3 * C, scale3, c, C)
        _add(at + 4 * C, shift0, c, C)
        _add(at + 5 * C, shift1, c, C)
        _add(at + 6 * C, shift2, c, C)
        _add(at + 7 * C, shift3, c, C)


def apply_gates(
    fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor, norms: torch.Tensor | None, state_type: torch.dtype
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (y, state), both [B, C, H, W] with channels innermost.

    ``fused`` [R, 4 C] and ``norms`` [8, C] (scales of the four gates, then shifts; None without layer norms) are
    contiguous. y has the precision of ``x`` [B, C, H, W], the new state that of ``state_type``.
    """
    x, state = channels_innermost(x), channels_innermost(state)
    y, after = _empty_maps(x, x.dtype), _empty_maps(x, state_type)
    arrays = (fused, x, state, fused if norms is None else norms, y, after)
    _launch(gates_kernel, arrays, (x, state), norms is not None, warps=WARPS)
    return y, after


def apply_gates_backward(
    fused: torch.Tensor,
    x: torch.Tensor,
    state: torch.Tensor,
    norms: torch.Tensor | None,
    d_y: torch.Tensor,
    d_after: torch.Tensor,
    d_fused: torch.Tensor,
    sums: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Fill ``d_fused`` [R, 4 C], add to ``sums`` [PROGRAMS, 8, C]; return the gradients of (x, state) [B, C, H, W].

    The other arguments are those of :func:`apply_gates`, and the gradients of its two results.
    """
    x, state, d_y, d_after = (channels_innermost(maps) for maps in (x, state, d_y, d_after))
    d_x, d_state = _empty_maps(x, x.dtype), _empty_maps(x, state.dtype)
    # Kernels ask for a pointer even where there are no norms, and do not use it.
    weights, totals = fused if norms is None else norms, fused if sums is None else sums
    arrays = (fused, x, state, weights, d_y, d_after, d_fused, d_x, d_state, totals)
    _launch(gates_backward_kernel, arrays, (x, state, d_y, d_after), norms is not None, warps=BACK_WARPS, most=PROGRAMS)
    return d_x, d_state


def _launch(
    kernel: Any,
    arrays: tuple[torch.Tensor, ...],
    read: tuple[torch.Tensor, ...],
    norm: bool,
    *,
    warps: int,
    most: int | None = None,
) -> None:
    """Launch a kernel over blocks of rows; ``read`` are the maps [B, C, H, W] whose strides it is told."""
    rows, (_, channels, height, width) = len(arrays[0]), read[0].shape
    wide = triton.next_power_of_2(channels)
    tall = max(1, TILE // wide)
    programs = triton.cdiv(rows, tall)
    batches, places = (tuple(maps.stride(axis) for maps in read) for axis in (0, 3))
    sizes = (rows, *batches, height * width, *places, channels, norm, EPS, tall, wide)
    kernel[(programs if most is None else min(most, programs),)](*arrays, *sizes, num_warps=warps)


def _empty_maps(like: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    batch, channels, height, width = like.shape
    return torch.empty(batch, height, width, channels, dtype=dtype, device=like.device).permute(0, 3, 1, 2)


def channels_innermost(x: torch.Tensor) -> torch.Tensor:
    """Return [B, C, H, W] with channels innermost and places one after the other, copied only if it is not so."""
    _, _, rows, columns = x.shape
    if x.stride(1) == 1 and (rows == 1 or x.stride(2) == columns * x.stride(3)):
        return x
    return x.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
