"""Simulated whiskers in PyTorch: results as tensors that are differentiable by what the jobs were built from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from brainbench.stimuli.gradients.run import Build, GradientRun

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.stimuli.engines.fidelity import Fidelity


class TorchTrace(NamedTuple):
    """Results of one whisker, float64, on the device of the parameters; NaN where they cannot be trusted."""

    wrench: torch.Tensor
    """[n, 6] force (N) and moment (N·m) of the whisker on its base."""
    link_positions: torch.Tensor
    """[n, links + 1, 3] joints and tip (m)."""
    contact_wrench: torch.Tensor
    """[n, 6] force (N) and moment about the base point (N·m) of all contacts on the whisker."""


class SimulateJobs(torch.autograd.Function):
    """Simulation of jobs as a function of parameters; use :func:`simulate_tensors`."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, build: Build, options: dict[str, Any]) -> tuple[torch.Tensor, ...]:
        """Simulate; return three tensors of each job."""
        run = GradientRun(build, values.detach().cpu().double().numpy(), **options)
        ctx.run = run
        ctx.like = values
        ctx.set_materialize_grads(False)
        return tuple(
            torch.as_tensor(array, dtype=torch.float64, device=values.device)
            for trace in run.traces
            for array in (trace.wrench, trace.link_positions, trace.contact_wrench)
        )

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        """Return the gradient by the values."""
        arrays: list[NDArray[np.float64] | None] = [
            None if grad is None else grad.detach().cpu().double().numpy() for grad in grads
        ]
        gradient = ctx.run.gradient(arrays[0::3], arrays[1::3], arrays[2::3])
        return torch.as_tensor(gradient.values, dtype=ctx.like.dtype, device=ctx.like.device), None, None


def simulate_tensors(
    build: Build,
    values: torch.Tensor,
    *,
    scales: Sequence[float] | None = None,
    fidelity: Fidelity | str = "balanced",
    device: str = "auto",
) -> list[TorchTrace]:
    """Simulate jobs and return results that can be differentiated by the parameters they were built from.

    Args:
        build: jobs from the values [p]; only the values carry gradients.
        values: tensor [p] on any device; computed in double precision.
        scales, fidelity, device: as for :class:`brainbench.stimuli.gradients.GradientRun`; ``device`` is that of the
            solver.
    """
    options = {"scales": scales, "fidelity": fidelity, "device": device}
    found = SimulateJobs.apply(values, build, options)
    return [TorchTrace(*found[i : i + 3]) for i in range(0, len(found), 3)]
