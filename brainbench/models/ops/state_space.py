r"""Linear recurrences in parallel, and a bank of linear state spaces with diagonal-plus-low-rank dynamics.

Per channel: x' = A x + B u, y = 2 Re(C x) + D u, with A = diag(Λ) − P P*, written for one of every two
conjugate states (Gu et al. 2022; Goel et al. 2022). Time is discretised by the bilinear rule with step Δ,

    x_k = (I − Δ/2 A)⁻¹ ((I + Δ/2 A) x_{k−1} + Δ B u_k),

where the inverse of diagonal plus rank one is written out (Sherman-Morrison), so a step costs O(pairs). The
kernel K_k = 2 Re(C Ā^k B̄) comes from its generating function Σ K_k z^k = C (I − Ā z)⁻¹ B̄ on a circle
|z| < 1: there the infinite sum converges and wraps around with a relative error of only |z|^M for M
points, so no power of Ā is needed, and the kernel of any length follows from the same parameters.

Letters: H channels, N conjugate pairs, L length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn


def linear_scan(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return h [B, T, ...] with h_0 = b_0 and h_t = a_t h_{t−1} + b_t, element by element, for a and b of equal shape.

    The odd-even scheme of Blelloch (1990): neighbouring steps are combined, the half as long recurrence is solved, and
    the steps between are filled in. Work is linear in time and depth logarithmic. The gradient is the same recurrence
    run backwards, so nothing between the levels is kept for it.
    """
    return _LinearScan.apply(a, b)  # pyright: ignore[reportReturnType]


class _LinearScan(torch.autograd.Function):
    """The recurrence as one operation on a and b [B, T, ...], with its gradient in closed form."""

    @staticmethod
    def forward(ctx: Any, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return h [B, T, ...] with h_t = a_t h_{t−1} + b_t, from zero."""
        h = _solve(a, b)
        ctx.save_for_backward(a, h)
        return h

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the gradients of a and b, both [B, T, ...]."""
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


# With M = 2 L points the wrapped tail is damped by 1e-10, and undoing the damping of the first L values
# amplifies rounding by at most 1e5, in double precision.
_WRAPPED = 1e-10
_BLOCK = 1 << 23  # complex numbers (channels × pairs × frequencies) held at once; bounds the memory of long kernels


class System(NamedTuple):
    """The discretised system, real and imaginary parts in the last axis; every field [H, N, 2]."""

    decay: torch.Tensor
    """Diagonal of the transition, before the rank-one correction."""
    left: torch.Tensor
    """Column of the rank-one correction."""
    right: torch.Tensor
    """Row of the rank-one correction, conjugated, as it multiplies the old state."""
    drive: torch.Tensor
    """Change of the state for one unit of input."""
    readout: torch.Tensor
    """Weights of the answer."""


class StateSpace(nn.Module):
    """H independent systems with N conjugate pairs each: [B, L, H] → [B, L, H].

    The initial Δ is drawn log-uniformly in ``step_range``, in time steps. Initial dynamics are HiPPO-LegS (Gu et al.
    2020), the same for every channel. Complex parameters are stored as real and imaginary parts, so that a change of
    precision cannot drop one.
    """

    def __init__(self, channels: int, pairs: int = 32, *, step_range: tuple[float, float] = (1e-3, 1e-1)) -> None:
        super().__init__()
        poles, low_rank, drive = _legs(pairs)
        low, high = map(math.log, step_range)
        self.log_decay = nn.Parameter(torch.tensor(np.log(-np.real(poles))).float().repeat(channels, 1))
        self.frequency = nn.Parameter(torch.tensor(np.imag(poles)).float().repeat(channels, 1))
        self.low_rank = nn.Parameter(_parts(low_rank, channels))
        self.drive = nn.Parameter(_parts(drive, channels))
        self.readout = nn.Parameter(torch.empty(channels, pairs, 2))
        self.log_step = nn.Parameter(torch.empty(channels))
        self.skip = nn.Parameter(torch.empty(channels))
        if not self.skip.is_meta:
            nn.init.normal_(self.readout, std=math.sqrt(0.5))
            nn.init.uniform_(self.log_step, low, high)
            nn.init.normal_(self.skip)

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        """Convolve a sweep [B, L, H] with the kernel."""
        length = u.shape[1]
        # Spectra lose all precision in half floats, whatever the layers around use.
        with torch.autocast(u.device.type, enabled=False):
            kernel = self.kernel(length).to(torch.float32)
            signal = u.to(torch.float32).transpose(1, 2)
            # Padding to 2 L makes the circular convolution of the FFT a linear one.
            spectrum = torch.fft.rfft(signal, n=2 * length) * torch.fft.rfft(kernel, n=2 * length)
            y = torch.fft.irfft(spectrum, n=2 * length)[..., :length].transpose(1, 2)
            y = y + self.skip.to(torch.float32) * u.to(torch.float32)
        return y.to(u.dtype)

    def kernel(self, length: int) -> torch.Tensor:
        """Return the response [H, L] in double precision to one unit of input at step 0, without the skip."""
        rows = max(1, _BLOCK // (self.frequency.shape[1] * (length + 1)))
        parts = zip(*(part.split(rows) for part in self._double()), strict=True)
        return torch.cat([_kernel(part, length) for part in parts])

    def system(self) -> System:
        """Return the discretised system for :meth:`step`, in the precision of the parameters."""
        poles, low_rank, drive, readout, step = self._double()
        half = (step / 2)[:, None]
        inverse = 1.0 / (1.0 - half * poles)
        # M = (I − Δ/2 A)⁻¹ = diag(inverse) − left · P* diag(inverse), with sums over conjugate states too.
        strength = half / (1.0 + half * _both(low_rank.conj() * inverse * low_rank))
        left = strength * inverse * low_rank
        row = low_rank.conj() * inverse
        # Ā = 2 M − I keeps the form: diagonal 2 inverse − 1, correction −2 left · row.
        driven = inverse * drive - left * _both(row * drive)
        parts = (2 * inverse - 1, 2 * left, row, step[:, None] * driven, readout)
        return System(*(torch.view_as_real(part).to(self.skip.dtype) for part in parts))

    def transition(self) -> torch.Tensor:
        """Return Ā [H, 2 N, 2 N] of all states, the conjugate ones last, complex in double precision."""
        poles, low_rank, _, _, step = self._double()
        column = torch.cat((low_rank, low_rank.conj()), 1)
        a = torch.diag_embed(torch.cat((poles, poles.conj()), 1)) - column[:, :, None] * column[:, None].conj()
        half, identity = step[:, None, None] / 2 * a, torch.eye(column.shape[1], dtype=a.dtype, device=a.device)
        return torch.linalg.solve(identity - half, identity + half)

    def init_state(self, batch: int) -> tuple[torch.Tensor, System]:
        """Return the empty memory [batch, H, N, 2] and the discretised system."""
        return self.skip.new_zeros(batch, *self.readout.shape), self.system()

    def step(self, u: torch.Tensor, memory: torch.Tensor, system: System) -> tuple[torch.Tensor, torch.Tensor]:
        """Advance by one step of input [B, H]; return the answer [B, H] and the next memory [B, H, N, 2]."""
        # x ← Ā x + B̄ u with Ā diagonal less rank one; twice the real part stands for the conjugate states.
        seen = 2 * _real_product(system.right, memory).sum(-1)
        decayed = _product(system.decay, memory) - system.left * seen[..., None, None]
        memory = decayed + system.drive * u[..., None, None]
        return 2 * _real_product(system.readout, memory).sum(-1) + self.skip * u, memory

    def _double(self) -> tuple[torch.Tensor, ...]:
        """Return Λ, P, B, C [H, N] complex and Δ [H], in double precision."""
        poles = torch.complex(-torch.exp(self.log_decay.double()), self.frequency.double())
        others = (torch.view_as_complex(item.double()) for item in (self.low_rank, self.drive, self.readout))
        return (poles, *others, torch.exp(self.log_step.double()))


def _kernel(system: Sequence[torch.Tensor], length: int) -> torch.Tensor:
    """Return the kernel [H, L] of systems given by Λ, P, B, C [H, N] and Δ [H]."""
    poles, low_rank, drive, readout, step = system
    points = 2 * length
    radius = _WRAPPED ** (1.0 / points)
    turns = torch.arange(length + 1, device=step.device, dtype=torch.float64) * (-2 * math.pi / points)
    z = torch.polar(torch.full_like(turns, radius), turns)
    # (I − Ā z)⁻¹ B̄ = Δ (D + Δ/2 (1 + z) P P*)⁻¹ B with the diagonal D = (1 − z) − Δ/2 (1 + z) Λ.
    half = (step / 2)[:, None] * (1 + z)
    inverse = 1.0 / ((1 - z)[None, None] - half[:, None] * poles[..., None])
    mirrored = 1.0 / ((1 - z)[None, None] - half[:, None] * poles.conj()[..., None])

    def total(weights: torch.Tensor) -> torch.Tensor:
        """Sum over all states, the conjugate ones included, of weights / D: [H, frequencies]."""
        pair = torch.stack((weights, weights.conj()), 1)[:, :, None]
        return (pair[:, 0] @ inverse + pair[:, 1] @ mirrored)[:, 0]

    row = low_rank.conj()
    # Sherman-Morrison with c = Δ/2 (1 + z): (D + c P P*)⁻¹ = D⁻¹ − c D⁻¹P P*D⁻¹ / (1 + c P*D⁻¹P).
    correction = half / (1.0 + half * total(row * low_rank))
    response = total(readout * drive) - correction * total(readout * low_rank) * total(row * drive)
    # The samples on the circle are the transform of K_k |z|^k: transformed back, the damping is divided out.
    wrapped = torch.fft.irfft(step[:, None] * response, n=points)[:, :length]
    return wrapped * radius ** -torch.arange(length, device=step.device, dtype=torch.float64)


def _both(values: torch.Tensor) -> torch.Tensor:
    """Sum [H, N] over the states and their conjugates: [H, 1]."""
    return 2 * values.real.sum(-1, keepdim=True)


def _product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Multiply complex numbers given as real and imaginary parts [..., 2]."""
    return torch.stack((_real_product(a, b), a[..., 0] * b[..., 1] + a[..., 1] * b[..., 0]), -1)


def _real_product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return a[..., 0] * b[..., 0] - a[..., 1] * b[..., 1]


def _parts(values: NDArray[Any], channels: int) -> torch.Tensor:
    return torch.view_as_real(torch.tensor(values).to(torch.complex64)).repeat(channels, 1, 1)


def _legs(pairs: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return Λ, P and B [pairs] of HiPPO-LegS in normal-plus-low-rank form, the poles with positive frequency.

    A_nk = −√((2n+1)(2k+1)) below the diagonal, −(n+1) on it; A + P Pᵀ with P_n = √(n + 1/2) is −1/2 plus a
    skew-symmetric matrix, which a unitary matrix diagonalises (Gu et al. 2022, appendix C).
    """
    order = np.arange(2 * pairs)
    scale = np.sqrt(2 * order + 1.0)
    low_rank = scale / math.sqrt(2.0)
    matrix = -np.tril(np.outer(scale, scale), -1) - np.diag(order + 1.0)
    skew = matrix + np.outer(low_rank, low_rank) + 0.5 * np.eye(2 * pairs)
    # −i times a real skew-symmetric matrix is Hermitian: real frequencies in pairs ±ω and a unitary basis.
    frequencies, basis = np.linalg.eigh(-1j * skew)
    retained = frequencies > 0
    into = basis.conj().T[retained]
    return -0.5 + 1j * frequencies[retained], into @ low_rank, into @ scale
