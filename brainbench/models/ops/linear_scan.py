"""Linear recurrences over time in parallel: h_t = a_t h_{t−1} + b_t, element by element.

The odd-even scheme of Blelloch (1990): neighbouring steps are combined, the half as long recurrence is
solved, and the steps between are filled in. Work is linear in time and depth logarithmic. The gradient is
the same recurrence run backwards, so nothing between the levels is kept for it.
"""

from __future__ import annotations

from typing import Any

import torch


def linear_scan(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return h [B, T, ...] with h_0 = b_0 and h_t = a_t h_{t−1} + b_t, for a and b of equal shape."""
    return _LinearScan.apply(a, b)  # pyright: ignore[reportReturnType]


class _LinearScan(torch.autograd.Function):
    """The recurrence as one operation on a and b [B, T, ...], with its gradient in closed form."""

    @staticmethod
    def forward(ctx: Any, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        h = _solve(a, b)
        ctx.save_for_backward(a, h)
        return h

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        a, h = ctx.saved_tensors
        # The adjoint g_t = grad_t + a_{t+1} g_{t+1} is the recurrence on the reversed axis.
        following = torch.cat((a[:, 1:], torch.zeros_like(a[:, :1])), 1)
        adjoint = _solve(following.flip(1), grad.flip(1)).flip(1)
        before = torch.cat((torch.zeros_like(h[:, :1]), h[:, :-1]), 1)
        # ∂L/∂a_t = g_t h_{t−1} and ∂L/∂b_t = g_t.
        return adjoint * before, adjoint


def _solve(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    steps = a.shape[1]
    if steps == 1:
        return b.clone()
    pairs = steps // 2
    first_a, second_a = a[:, : 2 * pairs : 2], a[:, 1 : 2 * pairs : 2]
    first_b, second_b = b[:, : 2 * pairs : 2], b[:, 1 : 2 * pairs : 2]
    # Two steps are one, (a₂ a₁, a₂ b₁ + b₂), so odd steps obey a recurrence of half the length.
    odd = _solve(second_a * first_a, torch.addcmul(second_b, second_a, first_b))
    h = torch.empty_like(b)
    h[:, 1 : 2 * pairs : 2] = odd
    h[:, 0] = b[:, 0]
    # Each even step follows from the odd step before it.
    count = (steps - 1) // 2
    if count:
        h[:, 2::2] = torch.addcmul(b[:, 2::2], a[:, 2::2], odd[:, :count])
    return h
