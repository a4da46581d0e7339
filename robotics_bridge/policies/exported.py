"""A policy as one step with explicit memory, for files of other runtimes."""

from __future__ import annotations

import copy
import math
import warnings
from typing import TYPE_CHECKING, Any

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


class JitPolicy(nn.Module):
    """forward(obs [1, D]) → actions [1, A]; D is all groups flattened, in the order of :attr:`StepPolicy.input_names`.

    The step is traced, since encoders are no TorchScript; what remembers is scripted, so ``torch.jit.script`` of the
    whole gives a file with ``forward`` and ``reset``.
    """

    def __init__(self, policy: TactilePolicy) -> None:
        super().__init__()
        step = _FlatStep(StepPolicy(policy))
        example = (torch.zeros(1, step.size), torch.zeros(1, step.step.state_size))
        with warnings.catch_warnings(), torch.no_grad():
            # PyTorch announces the end of TorchScript; the user who asks for it knows.
            warnings.simplefilter("ignore")
            self.step: Any = torch.jit.trace(step, example)
        self.register_buffer("hidden_state", torch.zeros(1, step.step.state_size))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Advance by one control step."""
        actions, after = self.step(obs, self.hidden_state)
        self.hidden_state[:] = after  # pyright: ignore[reportIndexIssue]
        return actions

    @torch.jit.export
    def reset(self) -> None:
        """Forget."""
        self.hidden_state[:] = 0.0  # pyright: ignore[reportIndexIssue]


class _FlatStep(nn.Module):
    def __init__(self, step: StepPolicy) -> None:
        super().__init__()
        self.step: StepPolicy = step
        self.sizes: list[int] = [math.prod(shape) for shape in step.shapes.values()]
        self.size: int = sum(self.sizes)

    def forward(self, obs: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        shapes = self.step.shapes.values()
        parts = [part.reshape(-1, *shape) for part, shape in zip(obs.split(self.sizes, 1), shapes, strict=True)]
        return self.step(*parts, h_in)
