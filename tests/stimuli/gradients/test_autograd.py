"""Simulated whiskers in PyTorch."""

import numpy as np
import pytest
import torch

from brainbench.stimuli.gradients import GradientRun, JobParameters
from brainbench.stimuli.gradients.autograd import simulate_tensors
from brainbench.stimuli.objects.obstacle import Capsule
from tests.factories.gradients import COARSE, touching_job

POST = Capsule((11e-3, 2.2e-3, -8e-3), (11e-3, 2.2e-3, 8e-3), 5e-4)
PARAMETERS = JobParameters([touching_job(POST, friction=0.2)], ("young_modulus", "object.y"))
SCALES = PARAMETERS.scales.tolist()


def _simulate(values: torch.Tensor, device: str = "cpu"):
    return simulate_tensors(PARAMETERS.build, values, scales=SCALES, fidelity=COARSE, device=device)[0]


def test_a_loss_of_all_outputs_has_the_gradient_of_the_run():
    values = torch.tensor(PARAMETERS.values, requires_grad=True)
    trace = _simulate(values)
    loss = 1e6 * trace.wrench[:, 4].sum() + (trace.link_positions[-1] ** 2).sum() + 1e3 * trace.contact_wrench.sum()
    loss.backward()
    run = GradientRun(PARAMETERS.build, PARAMETERS.values, scales=SCALES, fidelity=COARSE)
    weights = [np.zeros((30, 6)), np.zeros_like(run.traces[0].link_positions), np.full((30, 6), 1e3)]
    weights[0][:, 4] = 1e6
    weights[1][-1] = 2 * run.traces[0].link_positions[-1]
    expected = run.gradient(*[[weight] for weight in weights]).values
    np.testing.assert_allclose(values.grad.numpy(), expected, rtol=1e-12)


def test_an_output_that_a_loss_leaves_out_costs_nothing_and_types_are_kept():
    values = torch.tensor(PARAMETERS.values, dtype=torch.float32, requires_grad=True)
    trace = _simulate(values)
    assert trace.wrench.dtype == torch.float64
    trace.contact_wrench[:, 0].sum().backward()
    assert values.grad.dtype == torch.float32
    assert torch.isfinite(values.grad).all()
    assert values.grad.abs().min() > 0


KEPT = (-4.116244407e-15, 0.005230297674)
"""What a processor gave, for machines whose Warp compiles for GPUs alone."""


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_every_device_gives_the_gradient_that_is_kept(device: str):
    values = torch.tensor(PARAMETERS.values, device=device, requires_grad=True)
    _simulate(values, device).wrench[:, 5].sum().backward()
    found = values.grad.cpu().numpy()
    kept = ", ".join(f"{value:.10g}" for value in found)
    np.testing.assert_allclose(found, KEPT, rtol=1e-5, err_msg=f"If that is meant, write KEPT = ({kept}).")
