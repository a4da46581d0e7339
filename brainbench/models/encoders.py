"""Encoders, from a stimulus [B, T, C, H, W] to features [B, T, F], and attenders, from these to features [B, T, W].

The recurrent convolutional network of Zhuang et al. (2017), with any cell; a ResNet18 of every time step on its own,
which is the feedforward control without any memory (He et al. 2016); and a structured state-space encoder (S4: Gu, Goel
& Ré 2022, with the stable form A = Λ − P P* of Goel et al. 2022).

Attenders look back over the whole sweep: a causal transformer answers at an action token after every step; selective
state spaces (Mamba: Gu & Dao 2023) solve a sweep by a parallel scan, on CUDA by the kernel of ``mamba_ssm`` where that
package is installed, with equal results.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from itertools import pairwise
from typing import Any, NamedTuple, cast

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError, check_number
from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node
from brainbench.models.ops import dispatch
from brainbench.models.ops.layers import RECTIFIER_GAIN, Conv2d, Linear
from brainbench.models.ops.state_space import StateSpace, System, linear_scan
from brainbench.models.parts import check_sweep, run_layers, wanted

INPUT_SHAPE = (30, 5, 7)  # five sub-steps of six channels (sub-step-major) on the whisker grid

_FEEDBACK = ((3, 2), (4, 2), (4, 3), (5, 3), (5, 4), (6, 4), (6, 5))
_FULL = (96, 128, 256, 384, 384, 256)


def small_width(full: int) -> int:
    """Return the width of a ``-small`` variant: 3/16 of the full one, in every encoder."""
    return full * 3 // 16


def zhuang_graph(
    cell: str = "time-decay", layer_norm: bool = False, small: bool = False, *, feedforward: bool = False
) -> GraphSpec:
    """Return the encoder's graph with a cell of :mod:`brainbench.models.cells`.

    It has 512 features, or 96 when ``small`` (every width × 3/16, about 1.3 M parameters with the largest cell).
    Six 2×2 convolutions (the first "valid", 5 × 7 → 4 × 6, the others "same"), two dense layers, feedback
    3→2, 4→2, 4→3, 5→3, 5→4, 6→4, 6→5 and skips conv2, conv4 → fc7. With the time-decay cell every node has a
    memory, as published; with a gated cell the convolutions carry it and the dense layers have none.
    ``feedforward`` keeps nodes, skips and timing and drops memory and feedback; cell and layer norm then have no
    meaning.
    """
    scaled = small_width if small else int
    # A memory checks its own kind.
    memory = None if feedforward else Memory(cell, layer_norm=layer_norm)  # pyright: ignore[reportArgumentType]
    names = [f"conv{index}" for index in range(1, 7)]
    nodes = [
        Node(name, Convolution(scaled(width), padding="valid" if name == "conv1" else "same"), memory)
        for name, width in zip(names, _FULL, strict=True)
    ]
    # Gated memories are convolutional and need a grid, which dense layers lack; a trace needs none.
    dense = Memory() if cell == "time-decay" and not feedforward else None
    nodes += [Node("fc7", Dense(scaled(1024)), dense), Node("fc8", Dense(scaled(512)), dense)]
    # Skips bring early responses to the dense layers before the last convolution has answered.
    forward = [*pairwise(names), ("conv2", "fc7"), ("conv4", "fc7"), ("conv6", "fc7")]
    edges = [Edge(*ends) for ends in (*forward, ("fc7", "fc8"))]
    if not feedforward:
        edges += [Edge(f"conv{source}", f"conv{target}", feedback=True) for source, target in _FEEDBACK]
    return GraphSpec(tuple(nodes), tuple(edges), ("conv1",), "fc8", INPUT_SHAPE)


_WIDTHS = (64, 128, 256, 512)


class BasicBlock(nn.Module):
    """Two 3×3 convolutions with batch norm around a shortcut, [B, C, H, W] → [B, out, H', W']."""

    def __init__(self, in_channels: int, out_channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = _convolution(in_channels, out_channels, 3, stride)
        self.norm1 = nn.BatchNorm2d(out_channels)
        self.conv2 = _convolution(out_channels, out_channels, 3, 1)
        self.norm2 = nn.BatchNorm2d(out_channels)
        self.shortcut = nn.Sequential()
        if stride != 1 or in_channels != out_channels:
            self.shortcut.append(_convolution(in_channels, out_channels, 1, stride))
            self.shortcut.append(nn.BatchNorm2d(out_channels))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the rectified sum [B, C, H, W] of the branch and the shortcut."""
        # He et al. 2016: the branch learns the difference from the shortcut, so gradients pass by it undiminished.
        y = self.norm2(self.conv2(torch.relu(self.norm1(self.conv1(x)))))
        return torch.relu(y + self.shortcut(x))


class ResNet18Encoder(nn.Module):
    """Features [B, T, F] of a sweep [B, T, C, H, W], each step alone: eight basic blocks, 11,523,840 parameters.

    The first convolution takes all channels of a step; the last layer gives the features.

    With ``small`` all widths × 3/16 (F = 96 instead of 512; 0.4 M parameters). In training, batch norm pools over batch
    and time.
    """

    layers: tuple[str, ...] = ("conv1", "layer1", "layer2", "layer3", "layer4", "fc")
    input_shape: tuple[int, int, int] = INPUT_SHAPE
    latency: int = 0
    receptive_field: int | None = 1

    def __init__(self, *, small: bool = False) -> None:
        super().__init__()
        widths = [small_width(width) if small else width for width in _WIDTHS]
        self.features = widths[-1]
        first = _convolution(self.input_shape[0], widths[0], 7, 2)
        self.conv1 = nn.Sequential(first, nn.BatchNorm2d(widths[0]), nn.ReLU(), nn.MaxPool2d(3, 2, 1))
        for index, (before, width) in enumerate(pairwise((widths[0], *widths)), start=1):
            stride = 1 if index == 1 else 2
            blocks = nn.Sequential(BasicBlock(before, width, stride), BasicBlock(width, width, 1))
            self.add_module(f"layer{index}", blocks)
        self.fc = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), Linear(self.features, self.features))

    def forward(self, x: torch.Tensor, *, return_activations: bool | Collection[str] = False) -> Any:
        """Return the features [B, T, F], with activations also ``{layer: [B, T, ...]}``."""
        check_sweep(x, self.input_shape, "The ResNet")
        leading = x.shape[:2]
        layers = ((name, self.get_submodule(name)) for name in self.layers)
        # Steps are independent images here, so batch and time are one axis.
        y, activations = run_layers(x.flatten(0, 1), layers, return_activations)
        y = y.unflatten(0, leading)
        if return_activations is False:
            return y
        return y, {name: value.unflatten(0, leading) for name, value in activations.items()}

    def init_state(self, batch: int) -> tuple[()]:
        """Return the state before the first step: there is none to keep."""
        del batch
        return ()

    def step(self, x: torch.Tensor, state: tuple[()]) -> tuple[torch.Tensor, tuple[()]]:
        """Return the features [B, F] of one step [B, C, H, W] and the (empty) state."""
        return self(x[:, None])[:, 0], state


def _convolution(in_channels: int, out_channels: int, size: int, stride: int) -> Conv2d:
    shape: dict[str, Any] = {"kernel_size": (size, size), "stride": (stride, stride), "padding": (size // 2, size // 2)}
    return Conv2d(in_channels, out_channels, **shape, use_bias=False, gain=RECTIFIER_GAIN)


S4State = tuple[tuple[torch.Tensor, System], ...]
"""For every block the memory [B, width, pairs, 2] and the discretised system (constant while streaming)."""


class S4Block(nn.Module):
    """LayerNorm(x + GLU(GELU(state space(x)))), [B, T, width], as published.

    ``dropout`` is the share dropped while training, both after the GELU and of what is added.
    """

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.memory = StateSpace(width)
        self.mix = Linear(width, 2 * width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Process a sweep [B, T, width]."""
        return self._added(x, self.memory(x))

    def step(self, x: torch.Tensor, memory: torch.Tensor, system: System) -> tuple[torch.Tensor, torch.Tensor]:
        """Advance by one step [B, width]; return the answer and the next memory."""
        y, memory = self.memory.step(x, memory, system)
        return self._added(x, y), memory

    def _added(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        # State spaces keep channels apart; the gated linear unit mixes them at every step.
        y = self.dropout(functional.glu(self.mix(self.dropout(functional.gelu(y))), -1))
        return self.norm(x + y)


class S4Encoder(nn.Module):
    """Features [B, T, F] of a sweep [B, T, C, H, W], causally: a linear layer, four S4 blocks, a linear layer.

    A sweep is one convolution over time by FFT; a stream is the recurrence of the same system. 3,434,496 parameters.

    With ``small`` all widths × 3/16 (F = 96 instead of 512; 0.3 M parameters). ``dropout`` is as for :class:`S4Block`.
    """

    layers: tuple[str, ...] = ("embed", "block1", "block2", "block3", "block4", "fc")
    input_shape: tuple[int, int, int] = INPUT_SHAPE
    latency: int = 0
    receptive_field: int | None = None

    def __init__(self, *, small: bool = False, dropout: float = 0.2) -> None:
        super().__init__()
        check_number("The share dropped by S4", dropout, least=0, most=1)
        self.features = small_width(512) if small else 512
        self.embed = Linear(math.prod(self.input_shape), self.features, gain=RECTIFIER_GAIN)
        self.blocks: Any = nn.ModuleList(S4Block(self.features, dropout) for _ in range(len(self.layers) - 2))
        self.fc = Linear(self.features, self.features)

    def forward(self, x: torch.Tensor, *, return_activations: bool | Collection[str] = False) -> Any:
        """Return the features [B, T, F], with activations also ``{layer: [B, T, width]}``."""
        check_sweep(x, self.input_shape, "S4")
        layers = zip(self.layers, (self.embed, *self.blocks, self.fc), strict=True)
        y, activations = run_layers(x.flatten(2), layers, return_activations)
        return y if return_activations is False else (y, activations)

    def init_state(self, batch: int) -> S4State:
        """Return the state before the first step: empty memories and the systems discretised from the weights."""
        return tuple(block.memory.init_state(batch) for block in self.blocks)

    def step(self, x: torch.Tensor, state: S4State) -> tuple[torch.Tensor, S4State]:
        """Return the features [B, F] of one step [B, C, H, W] and the next state."""
        y, after = self.embed(x.flatten(1)), []
        for block, (memory, system) in zip(self.blocks, state, strict=True):
            y, memory = block.step(y, memory, system)
            after.append((memory, system))
        return self.fc(y), tuple(after)


# GPT-2 draws weights with standard deviation 0.02 at any width; gain/√fan_in is its width-aware form
# (0.02 ≈ gain 0.45 at 512), and residual branches shrink with depth so that the sum keeps its scale.
_TOKEN_STD = 0.02


GPTState = tuple[tuple[torch.Tensor, torch.Tensor], ...]
"""Keys and values of the tokens so far, one pair [B, heads, tokens, width/heads] per block."""


class GPTBlock(nn.Module):
    """Pre-norm attention and a four times wider MLP, each added to the stream [B, tokens, width].

    ``dropout`` is the share of the attention weights and of the added values that is dropped while training; what each
    of ``depth`` blocks adds is scaled by 1/√(2 depth).
    """

    def __init__(self, width: int, heads: int, dropout: float, depth: int) -> None:
        super().__init__()
        self.heads = heads
        self.dropout = dropout
        # Two branches of each block add to the stream: 2 · depth of them in all (GPT-2, Radford et al. 2019).
        residual = 1.0 / math.sqrt(2.0 * depth)
        self.norm_attention = nn.LayerNorm(width)
        self.query_key_value = Linear(width, 3 * width)
        self.project = Linear(width, width, gain=residual)
        self.norm_mlp = nn.LayerNorm(width)
        # The tanh form of GELU, as published.
        self.mlp = nn.Sequential(
            Linear(width, 4 * width), nn.GELU("tanh"), Linear(4 * width, width, gain=residual), nn.Dropout(dropout)
        )
        self.residual_dropout = nn.Dropout(dropout)

    def forward(
        self, x: torch.Tensor, past: tuple[torch.Tensor, torch.Tensor] | None = None
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        """Return the stream [B, T, F], and keys and values [B, heads, tokens, F / heads] of all tokens so far."""
        batch, tokens, width = x.shape
        fused = self.query_key_value(self.norm_attention(x)).view(batch, tokens, 3, self.heads, width // self.heads)
        query, key, value = fused.permute(2, 0, 3, 1, 4)
        mask = None
        if past is not None:
            seen = past[0].shape[2]
            key, value = torch.cat((past[0], key), 2), torch.cat((past[1], value), 2)
            # New tokens attend to all that came before and to themselves: a triangle moved by the tokens seen.
            mask = torch.ones(tokens, seen + tokens, dtype=torch.bool, device=x.device).tril(seen)
        dropped = self.dropout if self.training else 0.0
        attended = functional.scaled_dot_product_attention(query, key, value, mask, dropped, is_causal=mask is None)
        # Pre-norm: the stream itself is never normalised inside the blocks, so gradients pass through them unchanged.
        x = x + self.residual_dropout(self.project(attended.transpose(1, 2).reshape(batch, tokens, width)))
        return x + self.mlp(self.norm_mlp(x)), (key, value)


class GPTAttender(nn.Module):
    """Map features [B, T, F] to [B, T, width], causally, for at most ``context // 2`` steps.

    Tokens: x0, a, x1, a, … with one learned action token a; 22 steps make 44 tokens of a context of 65. Pre-norm blocks
    as in GPT-2 (Radford et al. 2019), learned positions, a head w → w without bias ("LM head").

    ``context`` counts tokens, two per step and one over; ``dropout`` is the share dropped while training. 25,778,688
    parameters for 512 → 512; 6,532,608 for 512 → 256.
    """

    def __init__(
        self, features: int, width: int, *, blocks: int = 8, heads: int = 4, context: int = 65, dropout: float = 0.1
    ) -> None:
        super().__init__()
        check_number("The share dropped by a GPT attender", dropout, least=0, most=1)
        if width < 1 or width % heads:
            raise UsageError(f"The width of a GPT attender must be a multiple of its {heads} heads; received {width}.")
        self.features = width
        self.context = context
        self.action = nn.Parameter(torch.empty(features))
        self.embed = Linear(features, width)
        self.positions = nn.Parameter(torch.empty(context, width))
        self.dropout = nn.Dropout(dropout)
        self.blocks: Any = nn.ModuleList(GPTBlock(width, heads, dropout, blocks) for _ in range(blocks))
        self.norm = nn.LayerNorm(width)
        self.lm_head = Linear(width, width, use_bias=False)
        for tokens in (self.action, self.positions):
            if not tokens.is_meta:
                nn.init.normal_(tokens, std=_TOKEN_STD)
        self.layers = (*(f"block{index}" for index in range(1, blocks + 1)), "lm_head")

    @property
    def max_steps(self) -> int:
        """Longest sweep that fits the context."""
        return self.context // 2

    def init_state(self, batch: int) -> GPTState:
        """Return the state before the first step: no tokens."""
        heads = self.blocks[0].heads
        empty = self.positions.new_zeros(batch, heads, 0, self.features // heads)
        return ((empty, empty),) * len(self.blocks)

    def step(self, x: torch.Tensor, state: GPTState) -> tuple[torch.Tensor, GPTState]:
        """Advance by one step of features [B, F]; return the answer [B, width] and the next state."""
        stream, after = self.tokens(x[:, None], state[0][0].shape[2]), []
        for block, past in zip(self.blocks, state, strict=True):
            stream, pair = block(stream, past)
            after.append(pair)
        return self.lm_head(self.norm(stream[:, 1])), tuple(after)

    def forward(self, x: torch.Tensor, *, return_activations: bool | Collection[str] = False) -> Any:
        """Return the answers [B, T, width], with activations also those at the action tokens of named layers."""
        stream = self.tokens(x, 0)
        names = wanted(self.layers, return_activations)
        activations = {}
        for name, block in zip(self.layers, self.blocks, strict=False):
            stream, _ = block(stream)
            if name in names:
                activations[name] = stream[:, 1::2]
        y = self.lm_head(self.norm(stream[:, 1::2]))
        if "lm_head" in names:
            activations["lm_head"] = y
        return y if return_activations is False else (y, activations)

    def tokens(self, x: torch.Tensor, start: int) -> torch.Tensor:
        """Return what the blocks see of features [B, T, F]: two tokens per step [B, 2 T, width], from ``start`` on."""
        batch, steps, features = x.shape
        if start + 2 * steps > self.context:
            raise UsageError(
                f"The GPT attender remembers at most {self.max_steps} steps (context {self.context} tokens, two per "
                f"step); received step {start // 2 + steps}. Shorten the sweep or start again from init_state."
            )
        # x₀, a, x₁, a, …: answers are read at the odd places, where the token itself carries no stimulus.
        pairs = torch.stack((x, self.action.to(x.dtype).expand(batch, steps, features)), 2)
        return self.dropout(self.embed(pairs.flatten(1, 2)) + self.positions[start : start + 2 * steps])


_STEP_RANGE = (1e-3, 1e-1)


class MambaMemory(NamedTuple):
    """Memory of a block between two steps."""

    recent: torch.Tensor
    """[B, inner, convolution − 1] the inputs of the short convolution, oldest first."""
    state: torch.Tensor
    """[B, inner, states] of the state space."""


MambaState = tuple[MambaMemory, ...]  # one memory per block


class MambaBlock(nn.Module):
    """x + selective state space(LayerNorm(x)), [B, T, width].

    Per inner channel and state: h_t = exp(Δ_t A) h_{t−1} + Δ_t B_t u_t, y_t = C_t · h_t + D u_t, where the step
    Δ_t and the vectors B_t, C_t are functions of the input; y is gated by SiLU of a second branch.

    Sizes are those of :class:`MambaAttender`; what each of ``depth`` blocks adds is scaled by 1/√depth.
    """

    def __init__(self, width: int, *, expansion: int, states: int, convolution: int, depth: int) -> None:
        super().__init__()
        inner, self.rank, self.states = expansion * width, math.ceil(width / 16), states
        self.norm = nn.LayerNorm(width)
        self.expand = Linear(width, 2 * inner, use_bias=False)
        self.convolution = nn.Conv1d(inner, inner, convolution, groups=inner)
        self.select = Linear(inner, self.rank + 2 * states, use_bias=False)
        self.step_size = Linear(self.rank, inner, gain=1.0 / math.sqrt(3.0))
        self.log_decay = nn.Parameter(torch.arange(1.0, states + 1).log().repeat(inner, 1))
        self.skip = nn.Parameter(torch.ones(inner))
        self.project = Linear(inner, width, use_bias=False, gain=1.0 / math.sqrt(depth))
        if not self.skip.is_meta:
            with torch.no_grad():
                low, high = map(math.log, _STEP_RANGE)
                # Δ is drawn log-uniformly; its inverse softplus is Δ + log(1 − e^−Δ).
                size = torch.empty(inner).uniform_(low, high).exp()
                # The softplus of this bias is the step size.
                self.step_size.bias.copy_(size + torch.log(-torch.expm1(-size)))

    def init_memory(self, batch: int) -> MambaMemory:
        """Return the memory before the first step, all zeros."""
        inner, _, size = self.convolution.weight.shape
        return MambaMemory(self.skip.new_zeros(batch, inner, size - 1), self.skip.new_zeros(batch, inner, self.states))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Process a sweep [B, T, width]."""
        u, gate = self.expand(self.norm(x)).chunk(2, -1)
        # Zeros before the first step alone make the short convolution causal.
        padded = functional.pad(u.transpose(1, 2), (self.convolution.kernel_size[0] - 1, 0))
        u = functional.silu(self.convolution(padded).transpose(1, 2))
        if (scan := dispatch.selective_scan(u)) is not None:
            return self._scanned(scan, x, u, gate)
        decay, drive, readout = self._selected(u)
        return self._out(x, linear_scan(decay, drive), readout, u, gate)

    def step(self, x: torch.Tensor, memory: MambaMemory) -> tuple[torch.Tensor, MambaMemory]:
        """Advance by one step [B, width]; return the answer and the next memory."""
        u, gate = self.expand(self.norm(x)).chunk(2, -1)
        # The stream keeps the last inputs, so its short convolution sees what the sweep's does.
        window = torch.cat((memory.recent.to(u.dtype), u[..., None]), -1)
        weight, bias = self.convolution.weight[:, 0], cast(torch.Tensor, self.convolution.bias)
        u = functional.silu((window * weight).sum(-1) + bias)
        decay, drive, readout = self._selected(u)
        h = decay * memory.state + drive
        return self._out(x, h, readout, u, gate), MambaMemory(window[..., 1:], h)

    def _selected(self, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return exp(Δ A) and Δ B u [..., inner, states], and C [..., states], in single precision or better."""
        size, drive, readout = self.select(u).split((self.rank, self.states, self.states), -1)
        # Products of many decays need more digits than half floats have.
        exact = torch.promote_types(u.dtype, torch.float32)
        size = functional.softplus(self.step_size(size)).to(exact)
        # exp(Δ A) with A = −exp(log_decay) < 0, so no state can grow; the input enters by Δ B (Gu & Dao 2023).
        decay = torch.exp(size[..., None] * -torch.exp(self.log_decay.to(exact)))
        return decay, (size * u.to(exact))[..., None] * drive.to(exact)[..., None, :], readout.to(exact)

    def _scanned(self, scan: Any, x: torch.Tensor, u: torch.Tensor, gate: torch.Tensor) -> torch.Tensor:
        """Answer by a kernel that scans, reads out and gates in one pass; it takes [B, channel, T]."""
        size, drive, readout = self.select(u).split((self.rank, self.states, self.states), -1)
        size = size @ self.step_size.weight.to(size.dtype).T
        u, size, drive, readout, gate = (part.transpose(1, 2).contiguous() for part in (u, size, drive, readout, gate))
        decay, bias = -torch.exp(self.log_decay.float()), self.step_size.bias.float()
        y = scan(u, size, decay, drive, readout, self.skip.float(), z=gate, delta_bias=bias, delta_softplus=True)
        return x + self.project(y.transpose(1, 2)).to(x.dtype)

    def _out(self, x: torch.Tensor, h: torch.Tensor, readout: torch.Tensor, u: torch.Tensor, gate: torch.Tensor) -> Any:
        """Read the states h [..., inner, states] out, gate them and add them to the stream."""
        y = (h * readout[..., None, :]).sum(-1).to(u.dtype) + self.skip * u
        return x + self.project(y * functional.silu(gate)).to(x.dtype)


class MambaAttender(nn.Module):
    """Map features [B, T, F] to [B, T, F], causally and for any number of steps; a stream is the recurrence.

    Pre-norm residual blocks and a final norm; 6,784,000 parameters at width 512.

    The inner width of a block is ``expansion`` times F, with ``states`` per inner channel; the short convolution sees
    ``convolution`` steps.
    """

    max_steps: int | None = None

    def __init__(
        self, features: int, *, blocks: int = 4, expansion: int = 2, states: int = 16, convolution: int = 4
    ) -> None:
        super().__init__()
        sizes = {"expansion": expansion, "states": states, "convolution": convolution}
        given = {"features": features, "blocks": blocks, **sizes}
        for name, value in given.items():
            check_number(f"{name} of a Mamba attender", value, least=1, whole=True)
        self.features = features
        self.blocks: Any = nn.ModuleList(MambaBlock(features, depth=blocks, **sizes) for _ in range(blocks))
        self.norm = nn.LayerNorm(features)
        self.layers: tuple[str, ...] = (*(f"block{index}" for index in range(1, blocks + 1)), "norm")

    def forward(self, x: torch.Tensor, *, return_activations: bool | Collection[str] = False) -> Any:
        """Return the answers [B, T, F], with activations also ``{layer: [B, T, F]}``."""
        layers = zip(self.layers, (*self.blocks, self.norm), strict=True)
        y, activations = run_layers(x, layers, return_activations)
        return y if return_activations is False else (y, activations)

    def init_state(self, batch: int) -> MambaState:
        """Return the state before the first step, all zeros."""
        return tuple(block.init_memory(batch) for block in self.blocks)

    def step(self, x: torch.Tensor, state: MambaState) -> tuple[torch.Tensor, MambaState]:
        """Advance by one step of features [B, F]; return the answer [B, F] and the next state."""
        after = []
        for block, memory in zip(self.blocks, state, strict=True):
            x, memory = block.step(x, memory)
            after.append(memory)
        return self.norm(x), tuple(after)
