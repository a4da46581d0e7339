r"""Convolutional recurrent cells.

Every cell maps an input x [B, C, H, W] and a state s to an output y [B, out, H, W] and the next state. The input's
share of the gates can be computed for all time steps at once (:meth:`Cell.project`).
Gates come from one fused "same" convolution of cat(x, s). ``layer_norm`` normalises each gate's
pre-activation over channels at every place (Ba et al. 2016). A gate that keeps the old state carries a
fixed +1 inside its sigmoid, so that a fresh cell remembers: it passes on 1 − σ(1) = 27 % of what is new,
and untrained gated networks answer ever more softly with depth. Biases start at zero.

Equations: UGRNN and IntersectionRNN, Collins et al. 2017; GRU, Cho et al. 2014; LSTM, Hochreiter and Schmidhuber 1997,
Gers et al. 2000. Order and names of the gates follow PyTorchTNN, whose weights :meth:`load_tnn_state` reads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, cast

import torch
from torch import nn

from brainbench.core.errors import UsageError, check_number
from brainbench.models.ops import dispatch
from brainbench.models.ops.dispatch import DeferredNormGrad
from brainbench.models.ops.layers import ChannelNorm, Conv2d, load_named

__all__ = ["GRU", "LSTM", "UGRNN", "IntersectionRNN", "TimeDecay"]

FORGET_BIAS = 1.0  # added inside the sigmoid of every gate that keeps the old state

Projected = tuple[torch.Tensor, ...]  # one step of the result of project

CellStep = tuple[torch.Tensor, torch.Tensor]
"""An output y [B, out, H, W] and the next state [B, state channels, H, W]."""


class Cell(nn.Module):
    """Base of all cells: channels of x and y, the state's shape, zero initial states and PyTorchTNN's names."""

    state_factor: ClassVar[int] = 1
    """Channels of the state per output channel."""
    keeps_channels: ClassVar[bool] = False
    """True where the input itself is part of the output."""
    tnn_names: ClassVar[Mapping[str, str]] = {}
    """Our submodule names → PyTorchTNN's."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        name = type(self).__name__
        for channels in (in_channels, out_channels):
            check_number(f"channels of {name}", channels, least=1, whole=True)
        if self.keeps_channels and in_channels != out_channels:
            raise UsageError(
                f"{name} mixes its input into its output, so both need the same channels; received {in_channels} in "
                f"and {out_channels} out."
            )
        self.in_channels, self.out_channels = in_channels, out_channels

    def initial_state(self, batch: int, *spatial: int) -> torch.Tensor:
        """Return the zero state [batch, state channels, *spatial], of the parameters' kind and device."""
        return next(self.parameters()).new_zeros(batch, self.state_factor * self.out_channels, *spatial)

    def project(self, x: torch.Tensor) -> Projected:
        """Return what the input alone adds to the gates, for any number of inputs [N, C, H, W] at once.

        ``forward(x, state, projected)`` then computes the recurrence only. A cell without gates has nothing to add.
        """
        del x
        return ()

    def load_tnn_state(self, state: Mapping[str, Any]) -> None:
        """Load arrays or tensors under PyTorchTNN's parameter names, such as ``conv.weight``."""
        load_named(self.tnn_parameters(), state, what=type(self).__name__)

    def tnn_parameters(self) -> dict[str, torch.Tensor]:
        """Return the parameters under PyTorchTNN's names."""
        renamed = {}
        for name, value in self.named_parameters():
            owner, _, leaf = name.rpartition(".")
            renamed[f"{self.tnn_names[owner]}.{leaf}" if owner else leaf] = value
        return renamed

    def _check(self, x: torch.Tensor, state: torch.Tensor | None) -> torch.Tensor:
        name = type(self).__name__
        if x.ndim < 2 or x.shape[1] != self.in_channels:
            raise UsageError(f"{name} expects [batch, {self.in_channels}, rows, columns]; received {list(x.shape)}.")
        expected = (x.shape[0], self.state_factor * self.out_channels, *x.shape[2:])
        if state is None:
            return x.new_zeros(expected)
        if tuple(state.shape) != expected:
            raise UsageError(f"{name} expects a state of shape {list(expected)}; received {list(state.shape)}.")
        return state


class TimeDecay(Cell):
    """Leaky trace: s ← x + τ s, y = s, with one scalar τ that starts at ``tau``, on any [B, C, ...].

    Training changes τ if it is ``trainable``. There is no gate to normalise, so ``layer_norm`` normalises the output
    (y = LN(s)); the trace itself stays as it is, or it would forget how strong the stimulus was.
    ``kernel_size`` is unused.
    """

    keeps_channels = True
    tnn_names: ClassVar[Mapping[str, str]] = {"norm": "norm"}

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        kernel_size: Any = None,
        layer_norm: bool = False,
        tau: float = 0.0,
        trainable: bool = True,
    ) -> None:
        super().__init__(in_channels, out_channels)
        check_number("The time decay tau", tau)
        self.tau = nn.Parameter(torch.tensor(float(tau)), requires_grad=trainable)
        self.norm = ChannelNorm(out_channels) if layer_norm else nn.Identity()

    def forward(self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()) -> CellStep:
        """Return (y, state), both [B, C, ...]."""
        del projected
        # s_t = x_t + τ s_{t−1}: linear, so the trace of one input decays as τ to the power of the steps since.
        state = x + self.tau * self._check(x, state)
        return self.norm(state), state


Pair = int | tuple[int, int]


class GatedCell(Cell):
    """A cell with one fused convolution for all its gates.

    ``kernel_size`` (one number, or rows and columns) is that of the gates' convolution; ``layer_norm`` normalises each
    gate over channels.
    """

    gates: ClassVar[tuple[str, ...]] = ()
    other_norms: ClassVar[tuple[str, ...]] = ()
    """Names of the norms beside those of the gates."""
    fused_parts: ClassVar[tuple[str, ...]] = ("apply_gates",)

    def __init__(self, in_channels: int, out_channels: int, *, kernel_size: Pair, layer_norm: bool = False) -> None:
        super().__init__(in_channels, out_channels)
        self.conv = self._convolution(len(self.gates), kernel_size)
        normalised = (*self.gates, *self.other_norms) if layer_norm else ()
        self.norms = nn.ModuleDict({name: ChannelNorm(out_channels) for name in normalised})

    def _convolution(self, gates: int, kernel_size: Pair) -> Conv2d:
        size = (kernel_size, kernel_size) if isinstance(kernel_size, int) else tuple(kernel_size)
        if len(size) != 2 or not all(isinstance(item, int) and item > 0 for item in size):
            raise UsageError(f"A kernel size is a positive integer or a pair of them; received {kernel_size!r}.")
        return Conv2d(self.in_channels + self.out_channels, gates * self.out_channels, kernel_size=size, gain=1.0)

    @property
    def convolutions(self) -> tuple[Conv2d, ...]:
        """Convolutions of the input and the memory, in the order of their use."""
        return (self.conv,)

    def project(self, x: torch.Tensor) -> Projected:
        """Return the input's part of every convolution, biases included, for inputs [N, C, H, W].

        Nothing where kernels of our own join input and memory without a copy of either
        (:mod:`brainbench.models.ops.dispatch`).
        """
        if dispatch.kernel_applies(self.conv, x):
            return ()
        return tuple(conv.conv_slice(x, 0, use_bias=True) for conv in self.convolutions)

    def forward(self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()) -> CellStep:
        """Return (y [B, out, H, W], state [B, state channels, H, W])."""
        state = self._check(x, state)
        # The gates read what the cell last answered, which is the last part of its state.
        return self.apply_gates(self._fused(self.conv, x, state.chunk(self.state_factor, 1)[-1], projected), x, state)

    def apply_gates(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> CellStep:
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
            # W [x, s] = W_x x + W_s s: the input's part was computed for all steps at once, only the memory's is left.
            return projected[0] + conv.conv_slice(memory, self.in_channels, use_bias=False)
        return dispatch.conv_concat(conv, (x, memory))

    def _normalised(self, fused: torch.Tensor, names: tuple[str, ...]) -> list[torch.Tensor]:
        # One convolution gives all gates; each is normalised by itself, as gates differ in scale.
        parts = fused.chunk(len(names), 1)
        if not self.norms:
            return list(parts)
        return [self.norms[name](part) for name, part in zip(names, parts, strict=True)]


class UGRNN(GatedCell):
    """Update-gate cell: g = σ(g' + 1), c = tanh(c'), s ← g s + (1 − g) c, y = s (Collins et al. 2017)."""

    gates = ("g", "c")
    tnn_names: ClassVar[Mapping[str, str]] = {"conv": "conv", "norms.g": "ln_g_act", "norms.c": "ln_c_act"}

    def apply_gates(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> CellStep:
        """Return (y, state), both [B, out, H, W], from the gates' pre-activations."""
        # Thesis, equation 3.1 and the text after it; the +1 favours keeping the state early in training.
        keep, candidate = self._normalised(fused, self.gates)
        keep = torch.sigmoid(keep + FORGET_BIAS)
        state = keep * state + (1 - keep) * torch.tanh(candidate)
        return state, state


class IntersectionRNN(GatedCell):
    """Cell gated through time and through depth (Collins et al. 2017), with as many channels of y as of x.

    State: p = σ(p' + 1), s ← p s + (1 − p) tanh(m'). Output: q = σ(q' + 1), y = q x + (1 − q) relu(n').
    """

    keeps_channels = True
    gates = ("gh", "h", "gy", "y")
    tnn_names: ClassVar[Mapping[str, str]] = {"conv": "conv"} | {f"norms.{name}": f"ln_{name}_act" for name in gates}
    deferred: DeferredNormGrad | None = None
    """Place for the gradients of the norms of each step; None outside of a deferring pass."""

    def forward(self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()) -> CellStep:
        """Return (y, state), both [B, out, H, W]."""
        state = self._check(x, state)
        fused = self._fused(self.conv, x, state, projected)
        # In the deferring pass of a convolution the gates' kernels write its gradient, so they run there too.
        if self.deferred is not None or (not projected and dispatch.kernel_applies(self.conv, x)):
            places: Any = None if self.deferred is None else (self.deferred, self.conv.deferred)
            return dispatch.fused_gates(fused, x, state, self.gate_norms, places)
        return self.apply_gates(fused, x, state)

    @property
    def gate_norms(self) -> list[ChannelNorm]:
        """Norms of the gates in their order; none without layer norm."""
        return [cast(ChannelNorm, self.norms[gate]) for gate in self.gates] if self.norms else []

    def apply_gates(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> CellStep:
        """Return (y, state), both [B, out, H, W], from the gates' pre-activations."""
        keep, candidate, through, output = self._normalised(fused, self.gates)
        keep = torch.sigmoid(keep + FORGET_BIAS)
        # Thesis, equations 3.2 and 3.3: one gate passes the state on in time, the other the input on in depth.
        through = torch.sigmoid(through + FORGET_BIAS)
        # h = y x + (1 − y) n and s = p s + (1 − p) m: early in training most of input and state passes.
        y = through * x + (1 - through) * torch.relu(output)
        return y.to(x.dtype), keep * state + (1 - keep) * torch.tanh(candidate)


class GRU(GatedCell):
    """Gated recurrent unit with two convolutions (Cho et al. 2014).

    r = σ(r' + 1), u = σ(u') from cat(x, s); c = tanh of a second convolution of cat(x, r s);
    s ← u s + (1 − u) c, y = s. The fixed +1 sits on the reset gate alone.
    """

    gates = ("r", "u")
    other_norms = ("c",)
    fused_parts = ("reset", "update")
    tnn_names: ClassVar[Mapping[str, str]] = {"conv": "conv_ru", "candidate": "conv_c"} | {
        f"norms.{name}": f"ln_{name}_pre" for name in "ruc"
    }

    def __init__(self, in_channels: int, out_channels: int, *, kernel_size: Pair, layer_norm: bool = False) -> None:
        super().__init__(in_channels, out_channels, kernel_size=kernel_size, layer_norm=layer_norm)
        self.candidate = self._convolution(1, kernel_size)

    @property
    def convolutions(self) -> tuple[Conv2d, ...]:
        """Convolutions of the gates and of the candidate."""
        return self.conv, self.candidate

    def forward(self, x: torch.Tensor, state: torch.Tensor | None = None, projected: Projected = ()) -> CellStep:
        """Return (y, state), both [B, out, H, W]."""
        state = self._check(x, state)
        remembered, keep = self.reset(self._fused(self.conv, x, state, projected[:1]), state)
        state = self.update(self._fused(self.candidate, x, remembered, projected[1:]), keep, state)
        return state, state

    def reset(self, fused: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (r s, u) from the gates' pre-activations."""
        reset, keep = self._normalised(fused, self.gates)
        # The +1 lets the old state into the candidate early in training; the update gate has none.
        return torch.sigmoid(reset + FORGET_BIAS) * state, torch.sigmoid(keep)

    def update(self, fused: torch.Tensor, keep: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Return the next state [B, C, H, W] from the candidate's pre-activation and the update gate u."""
        (candidate,) = self._normalised(fused, ("c",))
        # s ← u s + (1 − u) c (Cho et al. 2014): old state and candidate mix, so the state stays within ±1.
        return keep * state + (1 - keep) * torch.tanh(candidate)


class LSTM(GatedCell):
    """Long short-term memory; the state is cat(c, h) [B, 2 out, H, W].

    c ← c σ(f' + 1) + σ(i') tanh(j'), normalised too with ``layer_norm``; h = tanh(c) σ(o'); y = h.
    """

    state_factor = 2
    gates = ("i", "j", "f", "o")
    other_norms = ("c",)
    tnn_names: ClassVar[Mapping[str, str]] = {
        "conv": "conv",
        "norms.i": "ln_input",
        "norms.j": "ln_transform",
        "norms.f": "ln_forget",
        "norms.o": "ln_output",
        "norms.c": "ln_state",
    }

    def apply_gates(self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor) -> CellStep:
        """Return (y [B, out, H, W], state [B, 2 out, H, W]) from the gates' pre-activations."""
        del x
        # The state is cat(c, h), in the order of PyTorchTNN: the convolution has read h, and c is carried on here.
        memory = state.chunk(2, 1)[0]
        write, candidate, keep, read = self._normalised(fused, self.gates)
        # The +1 on the forget gate keeps the memory early in training; c is normalised before it is read and stored.
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
