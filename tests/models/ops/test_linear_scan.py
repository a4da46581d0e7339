import pytest
import torch

from brainbench.models.ops.linear_scan import linear_scan


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
