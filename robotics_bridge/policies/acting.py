"""A trained network that only acts: flat observations → normaliser → multilayer perceptron → mean actions.

Its parameters have the names of rsl_rl's ``MLPModel``, so weights of training fit, and no package for training is
needed. Letters: B environment, n numbers of all groups, A action.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

from robotics_bridge.policies.encoders.arms import perceptron

_LEAST = 1e-2
"""Added to the deviations, as rsl_rl does."""


class ObservationNormaliser(nn.Module):
    """Centre and scale observations [B, n] by the mean and deviation that were seen in training."""

    _mean: torch.Tensor
    _std: torch.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        for name, value in (("_mean", 0.0), ("_var", 1.0), ("_std", 1.0)):
            self.register_buffer(name, torch.full((1, size), value))
        self.register_buffer("count", torch.tensor(0))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the normalised observations [B, n]."""
        return (x - self._mean) / (self._std + _LEAST)


class ActingModel(nn.Module):
    """The part of rsl_rl's ``MLPModel`` that acts, with its arguments; ``distribution_cfg`` is not used."""

    def __init__(
        self,
        obs: Mapping[str, torch.Tensor],
        obs_groups: Mapping[str, Sequence[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: Sequence[int],
        activation: str = "elu",
        obs_normalization: bool = True,
        distribution_cfg: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if activation != "elu":
            raise ValueError(f"The activation is 'elu'; received {activation!r}.")
        self.distribution = None
        self.obs_groups, size = self._get_obs_dim(obs, obs_groups, obs_set)
        self.obs_normalization = obs_normalization
        self.obs_normalizer = ObservationNormaliser(size) if obs_normalization else nn.Identity()
        self.mlp = perceptron(self._get_latent_dim() or size, hidden_dims, output_dim)

    def forward(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the mean actions [B, A]."""
        return self.mlp(self.get_latent(obs))

    def get_latent(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the normalised observations [B, n]."""
        return self.obs_normalizer(torch.cat([obs[name] for name in self.obs_groups], dim=-1))

    def reset(self, dones: torch.Tensor | None = None) -> None:
        """Forget nothing: there is no memory."""

    def _get_obs_dim(
        self, obs: Mapping[str, torch.Tensor], obs_groups: Mapping[str, Sequence[str]], obs_set: str
    ) -> tuple[list[str], int]:
        names = list(obs_groups[obs_set])
        return names, sum(obs[name].shape[-1] for name in names)

    def _get_latent_dim(self) -> int:
        return 0
