"""The parts of an encoder-attender-decoder network: their protocols, and decoders.

A part is a :class:`torch.nn.Module` whose streaming state is a value that only the part itself looks into. A decoder
takes the features of one step [..., F], or of all steps so far.

Letters: B batch, T time step, (C, H, W) one step of the stimulus, F features.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Protocol

import torch
from torch import nn
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from brainbench.core.errors import UsageError, check_name, check_number
from brainbench.models.ops.layers import RECTIFIER_GAIN, Linear, perceptron
from brainbench.models.ops.state_space import StateSpace


class Part(Protocol):
    """A causal map over time that can be run on a sweep or streamed."""

    layers: tuple[str, ...]
    """Names of what it can return, from input to output."""

    @property
    def features(self) -> int:
        """Number of features of one answer."""
        ...

    def init_state(self, batch: int) -> Any:
        """Return the state before the first step, on the device and in the precision of the weights."""
        ...

    def step(self, x: torch.Tensor, state: Any) -> tuple[torch.Tensor, Any]:
        """Advance by one step; return the answer [B, F] and the next state."""
        ...

    def __call__(self, x: torch.Tensor, *, return_activations: bool | Collection[str] = False) -> Any:
        """Return the answers [B, T, F], with activations also ``{layer: [B, T, ...]}``."""
        ...


class Encoder(Part, Protocol):
    """Maps a sweep [B, T, C, H, W] to features [B, T, F]."""

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """(C, H, W) of one step of the stimulus."""
        ...

    @property
    def latency(self) -> int:
        """Steps before the stimulus can show in the features."""
        ...

    @property
    def receptive_field(self) -> int | None:
        """Steps of the stimulus that an answer can depend on, latency included; None: all so far."""
        ...


class Attender(Part, Protocol):
    """Maps features [B, T, F] to [B, T, W], remembering what it needs."""

    @property
    def max_steps(self) -> int | None:
        """Longest sweep it can read; None: any."""
        ...


def multiply_adds(part: Any, *shape: int) -> int:
    """Return the multiply-adds of matrix products, convolutions and state spaces in the first step of one stimulus.

    ``shape`` is that of a step [B, *shape]. The weights may lie on the device ``meta``.
    """
    from brainbench.models.activations import evaluating

    counter = FlopCounterMode(display=False)
    # PyTorch does not count its fused attention on the CPU; two stimuli, since one alone has kernels of its own.
    with evaluating(part), torch.no_grad(), sdpa_kernel(SDPBackend.MATH), counter:
        part.step(next(part.parameters()).new_zeros(2, *shape), part.init_state(2))
    # Streamed number by number, short convolutions and state spaces are not counted: of each conjugate pair 4 for the
    # transition, 2 each for row, column, input and readout.
    streamed = sum(module.weight.numel() for module in part.modules() if isinstance(module, nn.Conv1d))
    streamed += sum(12 * module.frequency.numel() for module in part.modules() if isinstance(module, StateSpace))
    return counter.get_total_flops() // 4 + streamed  # a multiply-add is two FLOPs


def run_layers(
    x: torch.Tensor, layers: Iterable[tuple[str, Callable[..., torch.Tensor]]], returned: bool | Collection[str]
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Pass ``x`` through named layers in turn; return the answer and those of the layers that were asked for."""
    activities: dict[str, torch.Tensor] = {}
    for name, layer in layers:
        x = layer(x)
        if returned is True or (returned and name in returned):
            activities[name] = x
    return x, activities


def check_sweep(x: torch.Tensor, input_shape: tuple[int, int, int], who: str) -> None:
    """Raise :class:`UsageError` unless ``x`` is a sweep [B, T, C, H, W] of steps of ``input_shape``."""
    if x.ndim != 5 or tuple(x.shape[2:]) != input_shape:
        raise UsageError(f"{who} expects [batch, time, {', '.join(map(str, input_shape))}]; received {list(x.shape)}.")


def wanted(layers: tuple[str, ...], returned: bool | Collection[str]) -> Collection[str]:
    """Return the layers that ``return_activations`` asks for: all, none, or those named."""
    if isinstance(returned, bool):
        return layers if returned else ()
    return returned


CLASSES = 117  # Object categories of the whisking data set (Zhuang et al. 2017).


class AllStepsDecoder(nn.Module):
    """The MLP decoder of all steps at once: features [B, T, F] of at most ``steps`` steps → [B, classes].

    What the published feedforward networks without an attender decode with, as their last step alone sees 45 ms of
    touch (12,120,181 parameters for 512 features and 22 steps). Steps that have not come yet count as zeros, so the
    answer after every step is defined and a stream needs only the running sum of the first layer.
    """

    def __init__(self, features: int, classes: int = CLASSES, *, steps: int = 22) -> None:
        super().__init__()
        self.steps = steps
        self.features = features
        self.first = Linear(steps * features, 1024, gain=RECTIFIER_GAIN)
        self.rest = nn.Sequential(nn.ReLU(), *perceptron(1024, 512, classes))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the answer [B, classes] after the last step of [B, T, F]."""
        self._check(features.shape[1])
        missing = self.steps - features.shape[1]
        padded = functional.pad(features, (0, 0, 0, missing)) if missing else features
        return self.rest(self.first(padded.flatten(1)))

    def every_step(self, features: torch.Tensor) -> torch.Tensor:
        """Return the answers [B, T, classes] after every step of [B, T, F]."""
        self._check(features.shape[1])
        weight = self.first.weight.view(-1, self.steps, self.features)[:, : features.shape[1]]
        parts = torch.einsum("btf,otf->bto", features, weight.to(features.dtype))
        return self.rest(parts.cumsum(1) + self.first.bias)

    def init_state(self, batch: int) -> tuple[torch.Tensor, int]:
        """Return the state before the first step: the first layer's sum [B, 1024] and the number of steps seen."""
        return self.first.weight.new_zeros(batch, 1024), 0

    def step(
        self, features: torch.Tensor, state: tuple[torch.Tensor, int]
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, int]]:
        """Advance by one step of features [B, F]; return the answer [B, classes] and the next state."""
        total, seen = state
        self._check(seen + 1)
        weight = self.first.weight.view(-1, self.steps, self.features)[:, seen]
        total = total + functional.linear(features, weight)
        return self.rest(total + self.first.bias), (total, seen + 1)

    def _check(self, steps: int) -> None:
        if steps > self.steps:
            raise UsageError(
                f"The all-steps decoder was built for {self.steps} steps and received step {steps}; shorten the "
                "sweep, start again from init_state, or use the linear or mlp decoder."
            )


DECODERS: Mapping[str, Callable[..., nn.Module]] = {
    "linear": Linear,
    "mlp": lambda features, classes: perceptron(features, 1024, 512, classes),
    "all-steps": AllStepsDecoder,
}
"""Decoders by name; each takes (features, classes). ``linear`` is one layer (60,021 parameters for 512 features),
``mlp`` linear layers 1024, 512 and ``classes`` with ReLU between (1,110,133)."""


def make_decoder(name: str, features: int, classes: int = CLASSES) -> nn.Module:
    """Build a decoder of :data:`DECODERS` by name."""
    check_name("decoder", name, DECODERS)
    check_number("The number of classes of a decoder", classes, least=2, whole=True)
    return DECODERS[name](features, classes)
