"""A network that was scored against a brain, as the tactile front end of a policy.

Readings [B, S, N, C] → :class:`~robotics_bridge.policies.encoders.taxel_grid.TaxelGrid` → the encoder's clock → hand
calibration → the network's own normaliser, encoder and attender → features [B, F], one step at a time, with all memory
in one array [B, H]: zeros are the state before the first step and rows are independent.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import nn

from brainbench.core.contracts import GRID_SHAPE
from brainbench.core.errors import UsageError, check_name
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.registry import load_model
from brainbench.models.streaming import StreamingStep
from robotics_bridge.policies.encoders.calibration import HandCalibration
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid
from robotics_bridge.policies.encoders.timing import TIMES, Resampler, Time

Learning = Literal["frozen", "finetuned"]
LEARNING = ("frozen", "finetuned")


class FrontEnd(nn.Module):
    """A network of :func:`brainbench.load_model` that reads a hand.

    Args:
        model: The network, or its name for :func:`brainbench.load_model` with seed, pretrained weights and options.
        grid: The map from taxels to its input.
        time: ``native`` or ``resampled`` (:mod:`~robotics_bridge.policies.encoders.timing`).
        learning: ``frozen`` computes no gradients and never leaves evaluation mode.
        calibration: What a unit of force is to the network.
    """

    gain: torch.Tensor
    """[30, 1, 1]: factor of each channel, of the hand calibration."""

    def __init__(
        self,
        model: nn.Module | str,
        grid: TaxelGrid,
        *,
        time: Time = "native",
        learning: Learning = "frozen",
        calibration: HandCalibration | None = None,
        seed: int = 0,
        pretrained: str | os.PathLike[str] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        check_name("time of an encoder", time, TIMES)
        check_name("way of learning of an encoder", learning, LEARNING)
        network, name = model, type(model).__name__
        if isinstance(model, str):
            network, name = load_model(model, seed=seed, pretrained=pretrained, **(options or {})), model
        if not isinstance(network, EncoderAttenderDecoder) or network.spec.input_shape[1:] != GRID_SHAPE:
            raise UsageError(
                f"A front end needs an encoder-attender-decoder network of steps [30, 5, 7]; received {name!r}."
            )
        if network.spec.max_steps is not None:
            raise UsageError(
                f"A policy runs without end, but this network remembers at most {network.spec.max_steps} steps; "
                "use one without a 'gpt' attender."
            )
        self.grid: TaxelGrid = grid
        self.learning: Learning = learning
        self.step: StreamingStep = StreamingStep(network)
        self.sub_steps: int = network.spec.sub_steps
        gains = torch.tensor((calibration or HandCalibration()).gains(self.sub_steps)).view(-1, 1, 1)
        self.register_buffer("gain", gains, persistent=False)
        values = network.spec.input_shape[0] // self.sub_steps * GRID_SHAPE[0] * GRID_SHAPE[1]
        self.resampler = Resampler(values, sub_steps=self.sub_steps) if time == "resampled" else None
        self.features: int = network.features
        """F."""
        held = self.features + self.resampler.state_size if self.resampler is not None else 0
        self.state_size: int = self.step.state_size + held
        """H."""
        # What classifies is no part of the features.
        network.decoder.requires_grad_(False)
        if learning == "frozen":
            self.step.requires_grad_(False)
            self.train(False)

    def train(self, mode: bool = True) -> FrontEnd:
        """Set training mode; a frozen network stays in evaluation mode."""
        super().train(mode and self.learning != "frozen")
        return self

    def stimulus(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the network's input [B, 30, 5, 7] of readings [B, S, N, C], in the units of its own stimuli."""
        if taxels.ndim == 4 and taxels.shape[1] != self.sub_steps:
            raise UsageError(f"The encoder takes {self.sub_steps} sub-steps; received {taxels.shape[1]} readings.")
        return self.grid(taxels) * self.gain

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (features [B, F], h_out [B, H]) of one control step.

        With ``resampled`` time the features are those of the last step that the encoder completed, zeros before.
        """
        with torch.set_grad_enabled(torch.is_grad_enabled() and self.learning != "frozen"):
            stimulus = self.stimulus(taxels)
            if self.resampler is None:
                return self.step(stimulus, h_in)
            sizes = [self.step.state_size, self.features, self.resampler.state_size]
            state, held, clock = h_in.split(sizes, 1)
            readings, new, clock = self.resampler(stimulus.unflatten(1, (self.sub_steps, -1)).flatten(2), clock)
            features, after = self.step(readings.reshape(stimulus.shape), state)
            # The network is stepped in every row; rows whose resampled step is not complete keep their old state. A
            # branch would make rows depend on each other.
            features, state = torch.where(new, features, held), torch.where(new, after, state)
            return features, torch.cat((state, features, clock), 1)

    def init_state(self, batch: int) -> torch.Tensor:
        """Return the state [B, H] before the first step: zeros."""
        return self.gain.new_zeros(batch, self.state_size)
