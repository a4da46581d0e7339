"""Encoder-attender-decoder networks of touch.

A sweep [B, T, 30, 5, 7] in SI is normalised, encoded by a temporal graph, optionally read by an attender,
and decoded at the last step to [B, classes]. Everything is causal: :meth:`EAD.step` streams.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from brainbench.errors import UsageError, unknown_name
from brainbench.models.attenders.gpt import GPTAttender, GPTState
from brainbench.models.decoders import linear_decoder
from brainbench.models.graph import GraphState, TemporalGraph
from brainbench.models.normaliser import Normaliser
from brainbench.types import CHANNELS

SUB_STEPS = 5
SUB_STEP_SECONDS = 0.009


@dataclass(frozen=True)
class ModelSpec:
    """What a model expects and when it answers: the contract of deployment."""

    input_shape: tuple[int, int, int]
    """(C, H, W) of one time step."""
    channels: tuple[str, ...]
    """Names of the C channels, such as ``0.Fx``: sub-step, then component."""
    units: tuple[str, ...]
    """SI unit of each channel."""
    frame: str
    """Frame and sign of the channels."""
    sample_rate: float
    """Time steps per second [Hz]."""
    sub_steps: int
    """Samples within a time step."""
    causal: bool
    receptive_field: int | None
    """Steps that an answer can depend on; None: all so far."""
    latency: int
    """Steps before the stimulus can show in the output."""
    max_steps: int | None
    """Longest sweep; None: any."""
    outputs: int
    """Number of outputs."""


@dataclass(frozen=True)
class EADState:
    """What a network carries from one step to the next."""

    encoder: GraphState
    attender: GPTState | None


class EAD(nn.Module):
    """Normaliser → encoder → attender → decoder; [B, T, C, H, W] in SI → [B, classes].

    Args:
        encoder: A graph whose output is [B, T, F].
        attender: Maps [B, T, F] to [B, T, W]; None passes the features on.
        decoder: Maps features to outputs, ending in a linear layer; None is the linear decoder to 117 classes.
        normaliser: None is :meth:`Normaliser.physical`.

    ``layers`` lists what :meth:`activations` can return, from stimulus to output.
    """

    def __init__(
        self,
        encoder: TemporalGraph,
        attender: GPTAttender | None = None,
        decoder: nn.Module | None = None,
        *,
        normaliser: Normaliser | None = None,
    ) -> None:
        super().__init__()
        (features,) = encoder.spec.shapes()[1][encoder.spec.output]
        self.normaliser = normaliser or Normaliser.physical(SUB_STEPS)
        self.encoder = encoder
        self.attender = attender
        self.decoder = decoder or linear_decoder(attender.features if attender is not None else features)
        self.spec = ModelSpec(
            input_shape=encoder.input_shape,
            channels=tuple(f"{sub_step}.{name}" for sub_step in range(SUB_STEPS) for name in CHANNELS),
            units=tuple("N" if name.startswith("F") else "N·m" for name in CHANNELS) * SUB_STEPS,
            frame="world axes; action of the whisker on its base, about the base point",
            sample_rate=1.0 / (SUB_STEPS * SUB_STEP_SECONDS),
            sub_steps=SUB_STEPS,
            causal=True,
            receptive_field=None,
            latency=encoder.spec.first_response()[encoder.spec.output],
            max_steps=attender.max_steps if attender is not None else None,
            outputs=_outputs(self.decoder),
        )
        attended = [f"attender.{name}" for name in attender.layers] if attender is not None else []
        self.layers: tuple[str, ...] = (*(f"encoder.{name}" for name in encoder.layers), *attended, "decoder")

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the decoder's output at the last step [B, classes].

        Raises:
            UsageError: ``x`` is not [B, T, C, H, W] as :attr:`spec` says, or too long for the attender.
        """
        features = self.encoder(self._normalise(x))
        if self.attender is not None:
            features = self.attender(features)
        return self.decoder(features[:, -1])

    def activations(self, x: torch.Tensor, layers: Collection[str] | None = None) -> dict[str, torch.Tensor]:
        """Return ``{layer: [B, T, ...]}`` for the layers asked for (all by default), in the order of ``layers``.

        The decoder is applied at every step; attender layers are read at the action tokens.

        Raises:
            UsageError: a layer does not exist, or as for :meth:`forward`.
        """
        wanted = self.layers if layers is None else tuple(layers)
        for name in wanted:
            if name not in self.layers:
                raise unknown_name("layer", name, self.layers)
        features, found = _named(self.encoder, self._normalise(x), "encoder", wanted)
        if self.attender is not None and any(not name.startswith("encoder.") for name in wanted):
            features, attended = _named(self.attender, features, "attender", wanted)
            found |= attended
        if "decoder" in wanted:
            found["decoder"] = self.decoder(features)
        return {name: found[name] for name in self.layers if name in wanted}

    def multiply_adds(self) -> int:
        """Return the multiply-adds of matrix products and convolutions in the first time step of one stimulus."""
        attender = self.attender.multiply_adds() if self.attender is not None else 0
        decoder = sum(module.weight.numel() for module in self.decoder.modules() if isinstance(module, nn.Linear))
        return self.encoder.multiply_adds() + attender + decoder

    def init_state(
        self, batch: int, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> EADState:
        """Return the state before the first step."""
        attender = self.attender
        return EADState(
            self.encoder.init_state(batch, device=device, dtype=dtype),
            attender.init_state(batch, device=device, dtype=dtype) if attender is not None else None,
        )

    def step(self, x: torch.Tensor, state: EADState) -> tuple[torch.Tensor, EADState]:
        """Advance by one time step [B, C, H, W] in SI; return the decoder's output [B, classes] and the state.

        After t steps the output equals :meth:`forward` of the sweep's first t steps.
        """
        if x.ndim != 4 or tuple(x.shape[1:]) != self.spec.input_shape:
            raise UsageError(f"A step expects {self._expected('batch')}; received {list(x.shape)}.")
        features, encoder = self.encoder.step(self.normaliser(x), state.encoder)
        attender = state.attender
        if self.attender is not None and attender is not None:
            features, attender = self.attender.step(features, attender)
        return self.decoder(features), EADState(encoder, attender)

    def _normalise(self, x: torch.Tensor) -> torch.Tensor:
        if x.ndim != 5 or tuple(x.shape[2:]) != self.spec.input_shape or x.shape[1] < 1:
            raise UsageError(
                f"The model expects {self._expected('batch', 'time')} ({self.spec.sub_steps} sub-steps × "
                f"{len(CHANNELS)} channels on the whisker grid, SI units); received {list(x.shape)}."
            )
        return self.normaliser(x)

    def _expected(self, *leading: str) -> str:
        return f"[{', '.join((*leading, *map(str, self.spec.input_shape)))}]"


def _outputs(decoder: nn.Module) -> int:
    linear = [module for module in decoder.modules() if isinstance(module, nn.Linear)]
    if not linear:
        raise UsageError(f"A decoder must end in a linear layer; received {type(decoder).__name__} without any.")
    return linear[-1].out_features


def _named(
    module: TemporalGraph | GPTAttender, x: torch.Tensor, prefix: str, wanted: Collection[str]
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    inner = [name.removeprefix(f"{prefix}.") for name in wanted if name.startswith(f"{prefix}.")]
    result: Any = module(x, return_activations=inner) if inner else (module(x), {})
    features, found = result
    activations: Mapping[str, torch.Tensor] = found
    return features, {f"{prefix}.{name}": value for name, value in activations.items()}
