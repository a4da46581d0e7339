"""Encoder-attender-decoder networks of touch.

A sweep [B, T, 30, 5, 7] in SI is normalised, encoded, optionally read by an attender, and decoded at the
last step to [B, classes]. Everything is causal: :meth:`EncoderAttenderDecoder.step` streams.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn

from brainbench.core.contracts import CHANNELS, SUB_STEP_SECONDS, SUB_STEPS
from brainbench.core.errors import UsageError, check_each, check_number
from brainbench.models.graph.spec import Unroll
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.parts import AllStepsDecoder, Attender, Encoder, make_decoder, multiply_adds

FORCE_SCALE = 1e-4  # N that become 1: the order of a whisker's base force in contact
MOMENT_SCALE = 1e-6  # N·m that become 1
PUBLISHED_FORCE_SCALE = 1e-3  # N that become 1 in the published networks, which saw mN and µN·m


class Normaliser(nn.Module):
    """(x − offset) / scale per channel of [B, T, C, H, W] or [B, C, H, W], in SI; buffers, not parameters.

    Without an offset silence stays silence.
    """

    scale: torch.Tensor
    offset: torch.Tensor

    def __init__(self, scale: Sequence[float], offset: Sequence[float] | None = None) -> None:
        super().__init__()
        for value in scale:
            check_number("A scale of a normaliser", value, above=0)
        for value in offset or ():
            check_number("An offset of a normaliser", value)
        self.register_buffer("scale", torch.tensor(scale).view(-1, 1, 1))
        self.register_buffer("offset", torch.tensor(offset or [0.0] * len(scale)).view(-1, 1, 1))

    @classmethod
    def physical(cls, sub_steps: int = 5, force: float = FORCE_SCALE) -> Normaliser:
        """Return the fixed scale of untrained models: forces / 1e-4 N, moments / 1e-6 N·m, sub-step-major."""
        return cls([force if name.startswith("F") else MOMENT_SCALE for name in CHANNELS] * sub_steps)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the normalised stimulus, same shape."""
        if torch.float16 in (x.dtype, self.scale.dtype):
            raise UsageError(
                "Half precision (float16) is too coarse for moments about 1e-6 N·m: take bfloat16, or single precision."
            )
        return (x - self.offset) / self.scale


@dataclass(frozen=True)
class ModelSpec:
    """Contract of deployment: the input that a model expects, and when it answers."""

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

    def trained_on(self, data: Mapping[str, Any]) -> ModelSpec:
        """Return the contract of a network after training on data whose card tells other time steps or axes."""
        rate = 1.0 / data["time_step"] if "time_step" in data else self.sample_rate
        frame = self.frame.replace("world", str(data.get("axes", "world")), 1)
        return replace(self, sample_rate=rate, frame=frame)


@dataclass(frozen=True)
class NetworkState:
    """State of a network between two steps."""

    encoder: Any
    attender: Any
    """None without an attender."""
    decoder: Any = None
    """State of an all-steps decoder; None for others."""


class EncoderAttenderDecoder(nn.Module):
    """Normaliser → encoder → attender → decoder; [B, T, C, H, W] in SI → [B, classes].

    The encoder gives features [B, T, F], which the attender (None: nothing) maps to [B, T, W]. The decoder ends in a
    linear layer; None is the linear one to 117 classes. None as normaliser is :meth:`Normaliser.physical`. Only a
    temporal graph can be unrolled otherwise than biologically.

    ``layers`` lists what :meth:`activations` can return, from stimulus to output.
    """

    def __init__(
        self,
        encoder: Encoder,
        attender: Attender | None = None,
        decoder: nn.Module | None = None,
        *,
        normaliser: Normaliser | None = None,
        unroll: Unroll = "biological",
    ) -> None:
        super().__init__()
        field, latency = encoder.receptive_field, encoder.latency
        self._unroll: dict[str, Any] = {}
        if isinstance(encoder, TemporalGraph):
            self._unroll = {"unroll": unroll}
            field = encoder.spec.receptive_field(unroll)
            latency = encoder.spec.first_response(unroll)[encoder.spec.output]
        elif unroll != "biological":
            raise UsageError(f"Only temporal graphs can be unrolled otherwise; {type(encoder).__name__} cannot.")
        self.normaliser = normaliser or Normaliser.physical(SUB_STEPS)
        self.encoder = encoder
        self.attender = attender
        self.decoder = decoder or make_decoder("linear", self.features)
        linear = [module for module in self.decoder.modules() if isinstance(module, nn.Linear)]
        if not linear:
            raise UsageError(f"A decoder must end in a linear layer; {type(self.decoder).__name__} has none.")
        every = isinstance(self.decoder, AllStepsDecoder)
        limits = [attender.max_steps if attender is not None else None, self.decoder.steps if every else None]
        self.spec = ModelSpec(
            input_shape=encoder.input_shape,
            channels=tuple(f"{sub_step}.{name}" for sub_step in range(SUB_STEPS) for name in CHANNELS),
            units=tuple("N" if name.startswith("F") else "N·m" for name in CHANNELS) * SUB_STEPS,
            frame="world axes; action of the whisker on its base, about the base point",
            sample_rate=1.0 / (SUB_STEPS * SUB_STEP_SECONDS),
            sub_steps=SUB_STEPS,
            causal=True,
            receptive_field=None if attender is not None or every else field,
            latency=latency,
            max_steps=min((limit for limit in limits if limit is not None), default=None),
            outputs=linear[-1].out_features,
        )
        attended = [f"attender.{name}" for name in attender.layers] if attender is not None else []
        self.layers: tuple[str, ...] = (*(f"encoder.{name}" for name in encoder.layers), *attended, "decoder")

    @property
    def features(self) -> int:
        """Number of features that the decoder reads at one step."""
        return self.encoder.features if self.attender is None else self.attender.features

    @property
    def unroll(self) -> Unroll:
        """Unrolling of the encoder's graph."""
        return self._unroll.get("unroll", "biological")

    def encode(self, x: torch.Tensor, *, last: bool = False) -> torch.Tensor:
        """Return the features [B, T, F] of sweeps in SI, which the decoder or the head of another objective reads.

        With ``last`` those of the last step [B, F] alone, which spares what no later step reads.
        """
        if self.spec.max_steps is not None and x.ndim == 5 and x.shape[1] > self.spec.max_steps:
            # Said before the encoder has worked for nothing.
            raise UsageError(f"The model remembers at most {self.spec.max_steps} steps; the sweep has {x.shape[1]:,}.")
        x = self._normalise(x)
        if last and self.attender is None and isinstance(self.encoder, TemporalGraph):
            return self.encoder(x, **self._unroll, last=True)
        features = self.encoder(x, **self._unroll)
        features = features if self.attender is None else self.attender(features)
        return features[:, -1] if last else features

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the decoder's output at the last step [B, classes]."""
        return self.decoder(self.encode(x, last=not isinstance(self.decoder, AllStepsDecoder)))

    def activations(self, x: torch.Tensor, layers: Collection[str] | None = None) -> dict[str, torch.Tensor]:
        """Return ``{layer: [B, T, ...]}`` for the layers asked for (all by default), in the order of ``layers``.

        The decoder is applied at every step; attender layers are read at the action tokens.
        """
        wanted = self.layers if layers is None else tuple(layers)
        check_each("layer", wanted, self.layers)
        features, activities = _named(self.encoder, self._normalise(x), "encoder", wanted, **self._unroll)
        if self.attender is not None and any(not name.startswith("encoder.") for name in wanted):
            features, attended = _named(self.attender, features, "attender", wanted)
            activities |= attended
        if "decoder" in wanted:
            answer = self.decoder.every_step if isinstance(self.decoder, AllStepsDecoder) else self.decoder
            activities["decoder"] = answer(features)
        return {name: activities[name] for name in self.layers if name in wanted}

    def multiply_adds(self) -> int:
        """Return the multiply-adds of matrix products and convolutions in the first time step of one stimulus."""
        return multiply_adds(self, *self.spec.input_shape)

    def init_state(self, batch: int) -> NetworkState:
        """Return the state before the first step of so many sweeps; UsageError where that is no whole number."""
        check_number("batch of a state", batch, least=0, whole=True)
        attender, decoder = self.attender, self.decoder
        return NetworkState(
            self.encoder.init_state(batch),
            attender.init_state(batch) if attender is not None else None,
            decoder.init_state(batch) if isinstance(decoder, AllStepsDecoder) else None,
        )

    def step(self, x: torch.Tensor, state: NetworkState) -> tuple[torch.Tensor, NetworkState]:
        """Advance by one time step [B, C, H, W] in SI; return the decoder's output [B, classes] and the state.

        After t steps the output equals :meth:`forward` of the sweep's first t steps.
        """
        features, state = self.encode_step(x, state)
        if isinstance(self.decoder, AllStepsDecoder):
            y, decoder = self.decoder.step(features, state.decoder)
            return y, replace(state, decoder=decoder)
        return self.decoder(features), state

    def encode_step(self, x: torch.Tensor, state: NetworkState) -> tuple[torch.Tensor, NetworkState]:
        """Advance as :meth:`step` does, without the decoder; return the features [B, F] and the state."""
        if x.ndim != 4 or tuple(x.shape[1:]) != self.spec.input_shape:
            raise UsageError(f"A step expects {self._expected('batch')}; received {list(x.shape)}.")
        features, encoder = self.encoder.step(self.normaliser(x), state.encoder, **self._unroll)
        attender = state.attender
        if self.attender is not None and attender is not None:
            features, attender = self.attender.step(features, attender)
        return features, NetworkState(encoder, attender, state.decoder)

    def _normalise(self, x: torch.Tensor) -> torch.Tensor:
        if x.ndim != 5 or tuple(x.shape[2:]) != self.spec.input_shape or x.shape[1] < 1:
            raise UsageError(
                f"The model expects {self._expected('batch', 'time')} ({self.spec.sub_steps} sub-steps × "
                f"{len(CHANNELS)} channels on the whisker grid, SI units); received {list(x.shape)}."
            )
        # On CUDA the check would make the processor wait for all work that is queued on the device, and in a compiled
        # step it would break the graph. In training a stimulus that is not finite shows in the loss, which is checked.
        quick = x.is_cuda or self.training or torch.compiler.is_compiling() or torch.compiler.is_exporting()
        if not quick and not torch.isfinite(x).all():
            count = int((~torch.isfinite(x)).sum())
            raise UsageError(
                f"{count:,} of {x.numel():,} values of the stimulus are not finite (NaN or infinite); a missing "
                "whisker is zero, and an unstable simulation must be left out."
            )
        return self.normaliser(x)

    def _expected(self, *leading: str) -> str:
        return f"[{', '.join((*leading, *map(str, self.spec.input_shape)))}]"


def _named(
    module: Encoder | Attender, x: torch.Tensor, prefix: str, wanted: Collection[str], **options: Any
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    inner = [name.removeprefix(f"{prefix}.") for name in wanted if name.startswith(f"{prefix}.")]
    features, activities = module(x, return_activations=inner, **options) if inner else (module(x, **options), {})
    return features, {f"{prefix}.{name}": value for name, value in activities.items()}
