"""Choice of some environments of a batch. Letters: B environment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from brainbench.core.errors import UsageError

EnvIds = Sequence[int] | np.ndarray | torch.Tensor
"""Numbers of environments, or a mask [B] bool."""


def select_envs(env_ids: EnvIds | None, num_envs: int, device: torch.device | str) -> torch.Tensor:
    """Return a mask [B] bool of the chosen environments, a new one; None chooses all."""
    device = torch.device(device)
    if env_ids is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    chosen = torch.zeros(num_envs, dtype=torch.bool, device=device)
    numbers = torch.as_tensor(env_ids, device=device)
    if numbers.dtype == torch.bool:
        if numbers.shape != chosen.shape:
            raise UsageError(f"A mask has one bool per environment ({num_envs}); received {tuple(numbers.shape)}.")
        return chosen | numbers
    if numbers.numel():
        if numbers.is_floating_point() or numbers.is_complex():
            first = numbers.flatten()[0].item()
            raise UsageError(f"Environments to reset are whole numbers or a mask; received {first}.")
        if device.type == "cpu" and (outside := numbers[(numbers < 0) | (numbers >= num_envs)]).numel():
            raise UsageError(f"Environments to reset are 0 to {num_envs - 1}; received {outside[0].item()}.")
        chosen[numbers.long()] = True
    return chosen
