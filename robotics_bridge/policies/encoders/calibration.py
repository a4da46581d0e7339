"""Calibration of a hand's newtons for an encoder that was made for whiskers of a few micronewtons."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from brainbench.core.contracts import CHANNELS, GRID_SHAPE
from brainbench.core.errors import DataError, UsageError
from brainbench.core.reading.ranges import check_fields
from brainbench.models.normaliser import FORCE_SCALE, MOMENT_SCALE

_TOUCHING = 1e-3
"""Cells below this share of the strongest one do not count as touched."""


@dataclass(frozen=True)
class HandCalibration:
    """Force and moment of one site of a hand that look to the encoder as its own unit.

    One number for all three axes of each kind, so that directions are kept. The encoder's own normaliser, per channel,
    follows; one that was fitted to whiskers therefore sees values of the size that it was fitted to.
    """

    force: float = 0.5
    """N that count as :data:`~brainbench.models.normaliser.FORCE_SCALE`."""
    moment: float = 5e-3
    """N·m that count as :data:`~brainbench.models.normaliser.MOMENT_SCALE`."""

    def __post_init__(self) -> None:
        check_fields(self, "force", "moment", above=0, of="The {} of a hand calibration")

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
