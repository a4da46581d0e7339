"""The encoder's clock: sub-steps of 9 ms in steps of 45 ms, against control steps of five 5 ms sub-steps.

``native`` gives the encoder every control step as one of its steps (time runs 1.8 times faster than in its training);
:class:`Resampler` gives it its own sub-steps, taken by linear interpolation, and a step only when 45 ms have passed.
Letters: B batch, S sub-step, K sub-steps remembered, V values of a sub-step.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Literal

import torch
from torch import nn

from brainbench.core.contracts import SUB_STEP_SECONDS

Time = Literal["native", "resampled"]
TIMES = ("native", "resampled")
CONTROL_SUB_STEP = 0.005
"""Seconds between readings of the tactile sensors (200 Hz physics)."""


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
        kept = max(int(oldest) + 2, sub_steps)
        self.past = kept - sub_steps
        weights = torch.zeros(self.cycle, sub_steps, kept)
        for phase in range(self.advance):
            for sample in range(sub_steps):
                parts = phase * sub_steps + (sub_steps - 1 - sample) * self.cycle
                # Times as whole numbers of 1/p readings: no rounding decides which readings a sample lies between.
                whole, rest = divmod(parts, self.advance)
                weights[phase, sample, kept - 1 - whole] += 1 - rest / self.advance
                if rest:
                    weights[phase, sample, kept - 2 - whole] += rest / self.advance
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
