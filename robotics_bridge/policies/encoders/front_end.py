"""A network that was scored against a brain, as the tactile front end of a policy.

Readings [B, S, N, C] → :class:`~robotics_bridge.policies.encoders.taxel_grid.TaxelGrid` → the encoder's clock → hand
calibration → the network's own normaliser, encoder and attender → features [B, F], one step at a time, with all memory
in one array [B, H]: zeros are the state before the first step and rows are independent. An encoder has sub-steps of
9 ms in steps of 45 ms, control steps have five sub-steps of 5 ms: ``native`` time gives it every control step as one
of its own (time runs 1.8 times faster than in its training), ``resampled`` time its own sub-steps (:class:`Resampler`).
Letters: B batch, S sub-step, K sub-steps remembered, V values of a sub-step.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import torch
from torch import nn

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, SUB_STEP_SECONDS
from brainbench.core.errors import DataError, UsageError, check_name
from brainbench.core.limits import Positive, limited
from brainbench.models.export import StreamingStep
from brainbench.models.network import FORCE_SCALE, MOMENT_SCALE, EncoderAttenderDecoder
from brainbench.models.registry import load_model
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid

_TOUCHING = 1e-3  # cells below this share of the strongest one do not count as touched


@dataclass(frozen=True)
@limited(of="{} of a hand calibration")
class HandCalibration:
    """Force and moment of one site of a hand that look to the encoder as its own unit.

    One number for all three axes of each kind, so that directions are kept. The encoder's own normaliser, per channel,
    follows; one that was fitted to whiskers therefore sees values of the size that it was fitted to.
    """

    force: Positive = 0.5
    """N that count as :data:`~brainbench.models.network.FORCE_SCALE`."""
    moment: Positive = 5e-3
    """N·m that count as :data:`~brainbench.models.network.MOMENT_SCALE`."""

    @classmethod
    def fit(cls, grid: torch.Tensor) -> HandCalibration:
        """Return the calibration at which touched sites of recorded grids [..., S·6, 5, 7] have an rms of one unit."""
        if grid.ndim < 3 or grid.shape[-2:] != GRID_SHAPE or grid.shape[-3] % len(CHANNELS):
            raise UsageError(f"A recording has the shape [..., S·6, 5, 7]; received {list(grid.shape)}.")
        if not torch.isfinite(grid).all():
            raise DataError("The recording holds values that are not finite, so the hand cannot be calibrated on it.")
        cells = grid.double().reshape(-1, len(CHANNELS), GRID_SHAPE[0] * GRID_SHAPE[1]).transpose(1, 2).flatten(0, 1)
        # Silent sites are left out: their share depends on the recording and would set the unit.
        strength = cells[:, :3].norm(dim=1)
        touched = cells[strength > _TOUCHING * strength.max()]
        if not len(touched):
            raise DataError("Nothing touches the hand in this recording, so it cannot be calibrated on it.")
        force, moment = (float(part.pow(2).mean().sqrt()) for part in (touched[:, :3], touched[:, 3:]))
        if not moment > 0:
            raise DataError("The recording holds forces without any moment; calibrate on readings of a whole grid.")
        return cls(force, moment)

    def gains(self, sub_steps: int) -> list[float]:
        """Return the factor of each channel (sub-step-major) from SI on the hand to SI at a whisker's base."""
        force, moment = FORCE_SCALE / self.force, MOMENT_SCALE / self.moment
        return [force if name.startswith("F") else moment for name in CHANNELS] * sub_steps


Time = Literal["native", "resampled"]
TIMES = ("native", "resampled")
CONTROL_SUB_STEP = 0.005  # seconds between readings of the tactile sensors (200 Hz physics)


class Resampler(nn.Module):
    """Turns control steps [B, S, V] into an encoder's steps [B, S, V], with all memory in one array per row.

    Row by row, time starts at the reset (a state of zeros); before it nothing touches. Of q control steps p complete a
    step of the encoder (5 of 9). A step shows what was felt up to 45 ms · (its number).
    """

    weights: torch.Tensor
    """[q, S, K]: interpolation at each phase; zeros where no step ends."""

    def __init__(self, values: int, *, sub_steps: int = 5) -> None:
        super().__init__()
        ratio = Fraction(CONTROL_SUB_STEP / SUB_STEP_SECONDS).limit_denominator(1000)
        self.values, self.sub_steps = values, sub_steps
        self.advance, self.cycle = ratio.numerator, ratio.denominator
        # How far before the last reading sample i of a step lies, counted in readings.
        oldest = (self.advance - 1) * sub_steps / self.advance + (sub_steps - 1) * self.cycle / self.advance
        remembered = max(int(oldest) + 2, sub_steps)
        self.past = remembered - sub_steps
        weights = torch.zeros(self.cycle, sub_steps, remembered)
        for phase in range(self.advance):
            for sample in range(sub_steps):
                parts = phase * sub_steps + (sub_steps - 1 - sample) * self.cycle
                # Times as whole numbers of 1/p readings: no rounding decides which readings a sample lies between.
                whole, rest = divmod(parts, self.advance)
                weights[phase, sample, remembered - 1 - whole] += 1 - rest / self.advance
                if rest:
                    weights[phase, sample, remembered - 2 - whole] += rest / self.advance
        self.register_buffer("weights", weights, persistent=False)
        self.state_size: int = 1 + self.past * values
        """Numbers of state per row: the phase and the readings before."""

    def forward(self, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return (step [B, S, V], whether it is a new one [B, 1] bool, state [B, state_size])."""
        # The phase advances by p of q per control step; a step of the encoder is complete where it wraps around.
        phase = torch.remainder(state[:, :1] + self.advance, self.cycle)
        past = state[:, 1:].unflatten(1, (self.past, self.values))
        window = torch.cat((past, x), 1)
        chosen = self.weights[phase[:, 0].round().long()]
        after = torch.cat((phase, window[:, self.sub_steps :].flatten(1)), 1)
        return chosen @ window, phase < self.advance - 0.5, after


Learning = Literal["frozen", "finetuned"]
LEARNING = ("frozen", "finetuned")


class FrontEnd(nn.Module):
    """A network of :func:`brainbench.load_model` that reads a hand.

    Args:
        model: The network, or its name for :func:`brainbench.load_model` with seed, pretrained weights and options.
        grid: The map from taxels to its input.
        time: ``native`` or ``resampled`` (:mod:`~robotics_bridge.policies.encoders.front_end`).
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
