"""A policy as one step with explicit memory, for files of other runtimes."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import torch
from torch import nn

if TYPE_CHECKING:
    from robotics_bridge.policies.student import TactilePolicy


class StepPolicy(nn.Module):
    """(group …, h_in [B, H]) → (actions [B, A], h_out [B, H]): a copy of the policy on the processor."""

    is_recurrent: bool = True

    def __init__(self, policy: TactilePolicy) -> None:
        super().__init__()
        # Its parts, and not the policy itself: what its distribution last drew hangs on a graph and cannot be copied.
        parts = (policy.obs_normalizer, policy.core, policy.mlp)
        self.normaliser, self.core, self.mlp = (copy.deepcopy(part).cpu().float().eval() for part in parts)
        sampled = policy.distribution
        self.output: nn.Module = nn.Identity() if sampled is None else sampled.as_deterministic_output_module().cpu()
        self.shapes: dict[str, tuple[int, ...]] = policy.shapes
        self.flat: tuple[str, ...] = tuple(policy.obs_groups)
        self.state_size: int = policy.core.state_size
        """H."""

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Advance by one control step; groups come in the order of :attr:`input_names`."""
        obs = dict(zip(self.shapes, inputs[:-1], strict=True))
        flat: list[torch.Tensor] = []
        if self.flat:
            sizes = [self.shapes[name][0] for name in self.flat]
            flat = list(self.normaliser(torch.cat([obs[name] for name in self.flat], -1)).split(sizes, -1))
        taxels = next((obs[name] for name in self.shapes if name not in self.flat), None)
        latent, h_out = self.core(flat, taxels, inputs[-1])
        return self.output(self.mlp(latent)), h_out

    def get_dummy_inputs(self, batch: int = 1) -> tuple[torch.Tensor, ...]:
        """Return inputs of zeros."""
        return (*(torch.zeros(batch, *shape) for shape in self.shapes.values()), torch.zeros(batch, self.state_size))

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs: groups, then memory."""
        return [*self.shapes, "h_in"]

    @property
    def output_names(self) -> list[str]:
        """Names of the outputs."""
        return ["actions", "h_out"]
