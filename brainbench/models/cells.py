r"""Convolutional recurrent cells.

Every cell maps an input x [B, C, H, W] and a state s to an output y [B, out, H, W] and the next state. The input's
share of the gates can be computed for all time steps at once (:meth:`Cell.project`).
Gates come from one fused "same" convolution of cat(x, s). ``layer_norm`` normalises each gate's
pre-activation over channels at every place (Ba et al. 2016). A gate that keeps the old state carries a
fixed +1 inside its sigmoid, so that a fresh cell remembers: it passes on 1 − σ(1) = 27 % of what is new,
and untrained gated networks answer ever more softly with depth. Biases start at zero.

Equations: UGRNN and IntersectionRNN, Collins et al. 2017; GRU, Cho et al. 2014; LSTM, Hochreiter and
Schmidhuber 1997, Gers et al. 2000. Order and names of the gates follow PyTorchTNN, whose weights
:meth:`load_tnn_state` reads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, cast

import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.models.ops.layers import Conv2d, pair
from brainbench.models.ops.parameters import load_named

if TYPE_CHECKING:
    from brainbench.models.ops.gates import DeferredNormGrad

FORGET_BIAS = 1.0

Projected = tuple[torch.Tensor, ...]
"""What :meth:`Cell.project` gives, one step of it."""


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of [B, C, ...], separately at every place."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Normalise [B, C, ...] over C."""
        return super().forward(input.movedim(1, -1)).movedim(-1, 1)


class Cell(nn.Module):
    """What all cells share: the state's shape, zero initial states and PyTorchTNN's names.

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate over channels.

    Raises:
        UsageError: there is no channel.
    """

    state_factor: ClassVar[int] = 1
    """Channels of the state per output channel."""
    tnn_names: ClassVar[Mapping[str, str]] = {}
    """Our submodule names → PyTorchTNN's."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        if in_channels < 1 or out_channels < 1:
            raise UsageError(f"{type(self).__name__} needs channels ≥ 1; received {in_channels} and {out_channels}.")
        self.in_channels = in_channels
        self.out_channels = out_channels

    def initial_state(
        self,
        batch: int,
        *spatial: int,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> torch.Tensor:
        """Return the zero state [batch, state channels, *spatial], like the parameters unless told otherwise."""
        like = next(self.parameters())
        shape = (batch, self.state_factor * self.out_channels, *spatial)
        return torch.zeros(shape, device=device or like.device, dtype=dtype or like.dtype)

    def project(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return what the input alone adds to the gates, for any number of inputs [N, C, H, W] at once.

        ``forward(x, state, projected)`` then computes the recurrence only. A cell without gates has nothing to add.
        """
        del x
        return ()

    def load_tnn_state(self, state: Mapping[str, Any]) -> None:
        """Load arrays or tensors under PyTorchTNN's parameter names, such as ``conv.weight``.

        Raises:
            DataError: a name is missing or unexpected, or a shape differs.
        """
        load_named(self.tnn_parameters(), state, what=f"{type(self).__name__}")

    def tnn_parameters(self) -> dict[str, torch.Tensor]:
        """Return the parameters under PyTorchTNN's names."""
        renamed = {}
        for name, value in self.named_parameters():
            owner, _, leaf = name.rpartition(".")
            renamed[f"{self.tnn_names[owner]}.{leaf}" if owner else leaf] = value
        return renamed

    def _check(self, x: torch.Tensor, state: torch.Tensor | None) -> torch.Tensor:
        if x.ndim < 2 or x.shape[1] != self.in_channels:
            raise UsageError(
                f"{type(self).__name__} expects [batch, {self.in_channels}, rows, columns]; received {list(x.shape)}."
            )
        if state is None:
            return self.initial_state(x.shape[0], *x.shape[2:], device=x.device, dtype=x.dtype)
        expected = (x.shape[0], self.state_factor * self.out_channels, *x.shape[2:])
        if tuple(state.shape) != expected:
            raise UsageError(
                f"{type(self).__name__} expects a state of shape {list(expected)}; received {list(state.shape)}."
            )
        return state


class TimeDecay(Cell):
    """Leaky trace: s ← x + τ s, y = s, with one trainable scalar τ that starts at zero.

    There is no gate to normalise, so ``layer_norm`` normalises the output (y = LN(s)); the trace itself
    stays as it is, or it would forget how strong the stimulus was. Works on any [B, C, ...].
    ``kernel_size`` is accepted for a uniform signature and unused.

    Args:
        in_channels: C.
        out_channels: C again.
        kernel_size: Unused.
        layer_norm: Normalise the output over channels.
        tau: τ before training.

    Raises:
        UsageError: the numbers of channels differ.
    """

    tnn_names: ClassVar[Mapping[str, str]] = {"norm": "norm"}

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        kernel_size: int | tuple[int, int] | None = None,
        layer_norm: bool = False,
        tau: float = 0.0,
    ) -> None:
        super().__init__(in_channels, out_channels)
        if in_channels != out_channels:
            raise UsageError(f"TimeDecay keeps its channels; received {in_channels} in and {out_channels} out.")
        self.tau = nn.Parameter(torch.tensor(float(tau)))
        self.norm = ChannelNorm(out_channels) if layer_norm else nn.Identity()

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, C, ...]."""
        del projected
        state = x + self.tau * self._check(x, state)
        return self.norm(state), state


class GatedCell(Cell):
    """A cell with one fused convolution for all its gates.

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate over channels.
    """

    gates: ClassVar[tuple[str, ...]] = ()
    fused_parts: ClassVar[tuple[str, ...]] = ("settle",)

    def __init__(
        self, in_channels: int, out_channels: int, *, kernel_size: int | tuple[int, int], layer_norm: bool = False
    ) -> None:
        super().__init__(in_channels, out_channels)
        self.conv = self._convolution(len(self.gates), kernel_size)
        self.norms = nn.ModuleDict({name: ChannelNorm(out_channels) for name in self.gates} if layer_norm else {})

    def _convolution(self, gates: int, kernel_size: int | tuple[int, int]) -> Conv2d:
        size = pair(kernel_size, "kernel size of a cell")
        return Conv2d(self.in_channels + self.out_channels, gates * self.out_channels, kernel_size=size, gain=1.0)

    def project(self, x: torch.Tensor) -> Projected:
        """Return the input's share of the fused convolution, biases included, for inputs [N, C, H, W].

        Nothing where kernels of our own join input and memory without a copy of either
        (:mod:`brainbench.models.ops.dispatch`).
        """
        if self.conv.joins(x):
            return ()
        return (self.conv.share(x, 0, use_bias=True),)

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y [B, out, H, W], state [B, state channels, H, W])."""
        state = self._check(x, state)
        return self.settle(self._fused(self.conv, x, state, projected[:1]), x, state)

    def settle(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state) from the gates' pre-activations [B, gates × out, H, W]: all that follows the convolution.

        It reads every number a few times and computes little, so one fused kernel does it best: :meth:`fuse`.
        """
        raise NotImplementedError

    def fuse(self, on: bool = True) -> None:
        """Let PyTorch's compiler make what follows the convolutions into kernels of its own, or leave it to PyTorch."""
        for name in self.fused_parts:
            self.__dict__.pop(name, None)
            if on:
                setattr(self, name, torch.compile(getattr(self, name), dynamic=False))

    def _fused(self, conv: Conv2d, x: torch.Tensor, memory: torch.Tensor, projected: Projected) -> torch.Tensor:
        if projected:
            return projected[0] + conv.share(memory, self.in_channels, use_bias=False)
        return conv.join((x, memory))

    def _normalised(self, fused: torch.Tensor, names: tuple[str, ...]) -> list[torch.Tensor]:
        parts = fused.chunk(len(names), 1)
        if not self.norms:
            return list(parts)
        return [self.norms[name](part) for name, part in zip(names, parts, strict=True)]


class UGRNN(GatedCell):
    """Update-gate cell: g = σ(g' + 1), c = tanh(c'), s ← g s + (1 − g) c, y = s (Collins et al. 2017)."""

    gates = ("g", "c")
    tnn_names: ClassVar[Mapping[str, str]] = {"conv": "conv", "norms.g": "ln_g_act", "norms.c": "ln_c_act"}

    def settle(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, out, H, W], from the gates' pre-activations."""
        keep, candidate = self._normalised(fused, self.gates)
        keep = torch.sigmoid(keep + FORGET_BIAS)
        state = keep * state + (1 - keep) * torch.tanh(candidate)
        return state, state


class IntersectionRNN(GatedCell):
    """Cell gated through time and through depth (Collins et al. 2017).

    State: p = σ(p' + 1), s ← p s + (1 − p) tanh(m'). Output: q = σ(q' + 1), y = q x + (1 − q) relu(n').

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y; the same number.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate over channels.

    Raises:
        UsageError: the numbers of channels differ.
    """

    gates = ("gh", "h", "gy", "y")
    tnn_names: ClassVar[Mapping[str, str]] = {"conv": "conv"} | {f"norms.{name}": f"ln_{name}_act" for name in gates}

    def __init__(
        self, in_channels: int, out_channels: int, *, kernel_size: int | tuple[int, int], layer_norm: bool = False
    ) -> None:
        if in_channels != out_channels:
            raise UsageError(
                "IntersectionRNN mixes its input into its output, so both need the same channels; "
                f"received {in_channels} in and {out_channels} out."
            )
        super().__init__(in_channels, out_channels, kernel_size=kernel_size, layer_norm=layer_norm)

        self.tape: DeferredNormGrad | None = None
        """Where the steps of a pass leave the gradients of the norms; None outside of such a pass."""

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, out, H, W]."""
        state = self._check(x, state)
        fused = self._fused(self.conv, x, state, projected[:1])
        if self.tape is not None or (not projected and self.conv.joins(x)):
            from brainbench.models.ops.gates import settle

            return settle(self, fused, x, state)
        return self.settle(fused, x, state)

    def norm(self, gate: str) -> ChannelNorm:
        """Return the norm of a gate."""
        return cast(ChannelNorm, self.norms[gate])

    def settle(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, out, H, W], from the gates' pre-activations."""
        keep, candidate, through, output = self._normalised(fused, self.gates)
        keep = torch.sigmoid(keep + FORGET_BIAS)
        through = torch.sigmoid(through + FORGET_BIAS)
        y = through * x + (1 - through) * torch.relu(output)
        return y.to(x.dtype), keep * state + (1 - keep) * torch.tanh(candidate)


class GRU(GatedCell):
    """Gated recurrent unit with two convolutions (Cho et al. 2014).

    r = σ(r' + 1), u = σ(u') from cat(x, s); c = tanh of a second convolution of cat(x, r s);
    s ← u s + (1 − u) c, y = s. The fixed +1 sits on the reset gate alone.

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate over channels.
    """

    gates = ("r", "u")
    fused_parts = ("remember", "settle")
    tnn_names: ClassVar[Mapping[str, str]] = {
        "conv": "conv_ru",
        "candidate": "conv_c",
        "norms.r": "ln_r_pre",
        "norms.u": "ln_u_pre",
        "norms.c": "ln_c_pre",
    }

    def __init__(
        self, in_channels: int, out_channels: int, *, kernel_size: int | tuple[int, int], layer_norm: bool = False
    ) -> None:
        super().__init__(in_channels, out_channels, kernel_size=kernel_size, layer_norm=layer_norm)
        self.candidate = self._convolution(1, kernel_size)
        if layer_norm:
            self.norms["c"] = ChannelNorm(out_channels)

    def project(self, x: torch.Tensor) -> Projected:
        """Return the input's shares of both convolutions, biases included, for inputs [N, C, H, W]; or nothing."""
        if self.conv.joins(x):
            return ()
        return self.conv.share(x, 0, use_bias=True), self.candidate.share(x, 0, use_bias=True)

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, out, H, W]."""
        state = self._check(x, state)
        remembered, keep = self.remember(self._fused(self.conv, x, state, projected[:1]), state)
        return self.settle(self._fused(self.candidate, x, remembered, projected[1:]), keep, state)

    def remember(self, fused: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (r s, u) from the gates' pre-activations."""
        reset, keep = self._normalised(fused, self.gates)
        return torch.sigmoid(reset + FORGET_BIAS) * state, torch.sigmoid(keep)

    def settle(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state) from the candidate's pre-activation and, in place of x, the update gate u."""
        (candidate,) = self._normalised(fused, ("c",))
        state = x * state + (1 - x) * torch.tanh(candidate)
        return state, state


class LSTM(GatedCell):
    """Long short-term memory; the state is cat(c, h) [B, 2 out, H, W].

    c ← c σ(f' + 1) + σ(i') tanh(j'), normalised too with ``layer_norm``; h = tanh(c) σ(o'); y = h.

    Args:
        in_channels: Channels of x.
        out_channels: Channels of y.
        kernel_size: One number or (rows, columns) of the gates' convolution.
        layer_norm: Normalise each gate and c over channels.
    """

    state_factor = 2
    gates = ("i", "j", "f", "o")
    tnn_names: ClassVar[Mapping[str, str]] = {
        "conv": "conv",
        "norms.i": "ln_input",
        "norms.j": "ln_transform",
        "norms.f": "ln_forget",
        "norms.o": "ln_output",
        "norms.c": "ln_state",
    }

    def __init__(
        self, in_channels: int, out_channels: int, *, kernel_size: int | tuple[int, int], layer_norm: bool = False
    ) -> None:
        super().__init__(in_channels, out_channels, kernel_size=kernel_size, layer_norm=layer_norm)
        if layer_norm:
            self.norms["c"] = ChannelNorm(out_channels)

    def forward(
        self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y [B, out, H, W], state [B, 2 out, H, W])."""
        state = self._check(x, state)
        return self.settle(self._fused(self.conv, x, state.chunk(2, 1)[1], projected[:1]), x, state)

    def settle(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y [B, out, H, W], state [B, 2 out, H, W]) from the gates' pre-activations."""
        del x
        memory = state.chunk(2, 1)[0]
        write, candidate, keep, read = self._normalised(fused, self.gates)
        memory = memory * torch.sigmoid(keep + FORGET_BIAS) + torch.sigmoid(write) * torch.tanh(candidate)
        (memory,) = self._normalised(memory, ("c",))
        hidden = torch.tanh(memory) * torch.sigmoid(read)
        return hidden, torch.cat((memory, hidden), 1)


CELLS: Mapping[str, Callable[..., Cell]] = {
    "time-decay": TimeDecay,
    "ugrnn": UGRNN,
    "intersection": IntersectionRNN,
    "gru": GRU,
    "lstm": LSTM,
}
"""Cells by the name that graphs and the registry use."""
