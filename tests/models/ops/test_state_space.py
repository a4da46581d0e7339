from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from brainbench.models.ops.state_space import StateSpace, _legs, linear_scan


def _one_after_the_other(a, b):
    h = [b[:, 0]]
    for t in range(1, b.shape[1]):
        h.append(a[:, t] * h[-1] + b[:, t])
    return torch.stack(h, 1)


@pytest.mark.parametrize("steps", [1, 2, 3, 4, 5, 7, 22, 64, 100])
def test_the_parallel_recurrence_equals_the_sequential_one(steps):
    a, b = torch.rand(2, steps, 3, 4, dtype=torch.float64), torch.randn(2, steps, 3, 4, dtype=torch.float64)
    torch.testing.assert_close(linear_scan(a, b), _one_after_the_other(a, b))


@pytest.mark.parametrize("steps", [1, 2, 5, 8])
def test_its_gradient_equals_finite_differences(steps):
    a = torch.rand(2, steps, 3, dtype=torch.float64, requires_grad=True)
    b = torch.randn(2, steps, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(linear_scan, (a, b))


def test_a_constant_decay_has_the_geometric_sum():
    h = linear_scan(torch.full((1, 50, 1), 0.5, dtype=torch.float64), torch.ones(1, 50, 1, dtype=torch.float64))
    expected = 2.0 * (1.0 - 0.5 ** torch.arange(1, 51, dtype=torch.float64))
    torch.testing.assert_close(h[0, :, 0], expected)


def _dense(space, channel):
    """The system of one channel in dense matrices with all states: A, B, C, step."""
    poles = -np.exp(space.log_decay[channel].double().numpy()) + 1j * space.frequency[channel].double().numpy()
    low_rank, drive, readout = (
        torch.view_as_complex(item[channel].double()).numpy() for item in (space.low_rank, space.drive, space.readout)
    )

    def whole(values):
        return np.concatenate((values, values.conj()))

    p = whole(low_rank)
    matrix = np.diag(whole(poles)) - np.outer(p, p.conj())
    return matrix, whole(drive), whole(readout), float(space.log_step[channel].double().exp())


@pytest.fixture
def space():
    with torch.no_grad():
        made = StateSpace(3, 4, step_range=(0.05, 0.5))
        made.low_rank.add_(0.3 * torch.randn_like(made.low_rank))
        made.drive.add_(0.3 * torch.randn_like(made.drive))
    return made


@torch.no_grad()
def test_the_kernel_equals_powers_of_the_dense_bilinear_system(space):
    kernel = space.kernel(40).numpy()
    for channel in range(3):
        matrix, drive, readout, step = _dense(space, channel)
        eye = np.eye(len(matrix))
        inverse = np.linalg.inv(eye - step / 2 * matrix)
        state, expected = inverse @ (step * drive), []
        for _ in range(40):
            expected.append((readout @ state).real)
            state = inverse @ (eye + step / 2 * matrix) @ state
        np.testing.assert_allclose(kernel[channel], expected, atol=1e-9, rtol=1e-8)


@torch.no_grad()
@pytest.mark.parametrize("length", [1, 2, 7, 22, 300])
def test_the_convolution_equals_the_recurrence(length):
    space, u = StateSpace(8, 32), torch.randn(2, length, 8)
    expected = space(u)
    memory, system = space.init_state(2)
    for t in range(length):
        y, memory = space.step(u[:, t], memory, system)
        torch.testing.assert_close(y, expected[:, t], atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_a_long_kernel_begins_with_the_short_one(space):
    torch.testing.assert_close(space.kernel(500)[:, :20], space.kernel(20), atol=1e-9, rtol=1e-8)


def test_gradients_of_the_kernel_are_those_of_finite_differences():
    space = StateSpace(1, 2, step_range=(0.1, 0.5)).double()
    names = [name for name, _ in space.named_parameters() if name != "skip"]
    values = tuple(getattr(space, name).detach().requires_grad_() for name in names)
    assert torch.autograd.gradcheck(lambda *new: _kernel_of(space, names, new), values, atol=1e-6)


def _kernel_of(space, names, values):
    clone = StateSpace(1, 2).double()
    for name, value in zip(names, values, strict=True):
        delattr(clone, name)
        setattr(clone, name, value)
    return clone.kernel(5)


def test_legs_is_similar_to_its_normal_plus_low_rank_form():
    # Eigenvalues of the HiPPO-LegS matrix are −1, −2, …, −2N (Gu et al. 2020).
    poles, low_rank, _ = _legs(3)
    p = np.concatenate((low_rank, low_rank.conj()))
    matrix = np.diag(np.concatenate((poles, poles.conj()))) - np.outer(p, p.conj())
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(matrix).real), -np.arange(6.0, 0.0, -1.0), atol=1e-8)


@torch.no_grad()
def test_a_single_real_mode_decays_as_the_bilinear_rule_says():
    space = StateSpace(1, 1)
    for name in ("low_rank", "drive", "readout"):
        getattr(space, name).zero_()
    space.drive[..., 0], space.readout[..., 0] = 1.0, 0.5
    space.frequency.zero_()
    space.log_decay.fill_(math.log(2.0))
    space.log_step.fill_(math.log(0.1))
    ratio, first = (1 - 0.1) / (1 + 0.1), 0.1 / (1 + 0.1)
    expected = first * ratio ** torch.arange(30, dtype=torch.float64)
    torch.testing.assert_close(space.kernel(30)[0], expected, atol=1e-7, rtol=1e-6)
