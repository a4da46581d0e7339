"""Speed against accuracy of a network: precision, unrolling and number of steps.

Every setting is compared with the same network in float32, unrolled biologically over all steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, limited
from brainbench.models.graph.spec import Unroll
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.registry import load_model
from brainbench.tradeoffs.study import Row, Study

REPEATS = 5  # sweeps that are timed, after one that is not


@dataclass(frozen=True)
@limited
class ModelSetting:
    """One way to run a network."""

    precision: Literal["float32", "bf16", "int8"] = "float32"
    """``bf16`` computes in mixed precision; ``int8`` stores weights in 8 bits, with one scale per output channel, and
    computes in float32."""
    unroll: Unroll = "biological"
    steps: Count = 22
    """The sweep's last steps that are shown."""


class Reduced(nn.Module):
    """A network run in one setting; it can be scored and extracted from like the network itself."""

    def __init__(self, name: str, setting: ModelSetting, *, seed: int = 0) -> None:
        super().__init__()
        model = load_model(name, seed=seed)
        if not isinstance(model, EncoderAttenderDecoder):
            raise UsageError(f"{name!r} is no encoder-attender-decoder network, so its settings cannot be changed.")
        if setting.unroll != "biological":
            if not isinstance(model.encoder, TemporalGraph):
                raise UsageError(f"The encoder of {name!r} knows one unrolling only; leave out {setting.unroll!r}.")
            model = load_model(name, seed=seed, unroll=setting.unroll)
        if setting.precision == "int8":
            round_weights(model)
        self.model: Any = model
        self.setting = setting
        self.layers: tuple[str, ...] = self.model.layers
        self.spec = self.model.spec

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the answer [B, classes] to the sweep's last steps."""
        with self._precision(x):
            return self.model(x[:, -self.setting.steps :]).float()

    def activations(self, x: torch.Tensor, layers: Collection[str] | None = None) -> dict[str, torch.Tensor]:
        """Return ``{layer: [B, steps, ...]}`` of the sweep's last steps."""
        with self._precision(x):
            return self.model.activations(x[:, -self.setting.steps :], layers)

    def stored_bytes(self) -> int:
        """Return the size of the weights as they would be stored."""
        size = {"float32": 4, "bf16": 2, "int8": 1}[self.setting.precision]
        return sum(p.numel() * (size if p.ndim > 1 else 4) for p in self.model.parameters())

    def _precision(self, x: torch.Tensor) -> Any:
        return torch.autocast(x.device.type, torch.bfloat16, enabled=self.setting.precision == "bf16")


@torch.no_grad()
def round_weights(model: nn.Module) -> None:
    """Round every weight of more than one axis to 8 bits, symmetrically, with one scale per output channel."""
    for weight in model.parameters():
        if weight.ndim > 1:
            scale = weight.flatten(1).abs().amax(1).clamp_min(1e-30).view(-1, *(1,) * (weight.ndim - 1)) / 127
            weight.copy_((weight / scale).round() * scale)


def study(
    name: str,
    settings: Sequence[ModelSetting],
    sweeps: Any,
    *,
    seed: int = 0,
    more: Callable[[Reduced], Mapping[str, Any]] = lambda network: {},
) -> Study:
    """Return the study of a network on sweeps [K, T, C, H, W] in SI.

    A row has the setting, the ``error`` (relative difference of the answers from those of the reference setting on all
    steps), the median time ``ms`` of one sweep at batch 1 with its ``p99_ms``, the stored size, and what ``more`` tells
    of the network in that setting.
    """
    x = torch.as_tensor(sweeps, dtype=torch.float32)
    for setting in settings:
        if x.ndim != 5 or x.shape[1] < setting.steps:
            raise UsageError(f"{setting.steps} steps cannot be taken from sweeps of shape {list(x.shape)}.")

    def measure(row: Mapping[str, Any]) -> Row:
        reduced = Reduced(name, ModelSetting(**row), seed=seed)
        with torch.no_grad():
            expected, answers, times = load_model(name, seed=seed)(x), reduced(x), []
            for _ in range(REPEATS + 1):
                start = time.perf_counter()
                reduced(x[:1])
                times.append((time.perf_counter() - start) * 1e3)
        error = float((answers - expected).norm() / expected.norm().clamp_min(1e-30))
        p50, p99 = (float(value) for value in np.percentile(times[1:], [50, 99]))
        measured = {"error": error, "ms": p50, "p99_ms": p99, "stored_bytes": reduced.stored_bytes()}
        return {"setting": dict(row), **measured, **more(reduced)}

    return Study("brainbench tradeoff model", [asdict(setting) for setting in settings], measure)
