"""The protocols of the parts of an encoder-attender-decoder network.

Letters: B batch, T time step, (C, H, W) one step of the stimulus, F features. A part is also a
:class:`torch.nn.Module`; its streaming state is a value that only the part itself looks into.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import TYPE_CHECKING, Any, Protocol

from brainbench.core.errors import UsageError

if TYPE_CHECKING:
    import torch


class Part(Protocol):
    """A causal map over time that can be run on a sweep or streamed."""

    layers: tuple[str, ...]
    """Names of what it can return, from input to output."""

    @property
    def features(self) -> int:
        """Number of features of one answer."""
        ...

    def multiply_adds(self) -> int:
        """Return the multiply-adds of matrix products and convolutions in the first step of one stimulus."""
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
