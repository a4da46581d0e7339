"""The update-gate cell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch

from brainbench.models.cells.cell import FORGET_BIAS
from brainbench.models.cells.gated import GatedCell


class UGRNN(GatedCell):
    """Update-gate cell: g = σ(g' + 1), c = tanh(c'), s ← g s + (1 − g) c, y = s (Collins et al. 2017)."""

    gates = ("g", "c")
    tnn_names: ClassVar[Mapping[str, str]] = {"conv": "conv", "norms.g": "ln_g_act", "norms.c": "ln_c_act"}

    def apply_gates(
        self, fused: torch.Tensor, x: torch.Tensor, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y, state), both [B, out, H, W], from the gates' pre-activations."""
        # Thesis, equation 3.1 and the text after it; the +1 favours keeping the state early in training.
        keep, candidate = self._normalised(fused, self.gates)
        keep = torch.sigmoid(keep + FORGET_BIAS)
        state = keep * state + (1 - keep) * torch.tanh(candidate)
        return state, state
