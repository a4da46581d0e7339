import math

import pytest
import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.models.recipes import OPTIMIZERS
from brainbench.models.training.optimizers import LARS, make_optimizer, rate_factor


def _stepped(weight, gradient, steps=1, **options):
    parameter = nn.Parameter(weight.clone())
    optimizer = LARS([{"params": [parameter], **options}], lr=0.5)
    for _ in range(steps):
        parameter.grad = gradient.clone()
        optimizer.step()
    return parameter.detach()


def test_lars_scales_a_step_to_the_norm_of_the_weights():
    weight, gradient = torch.tensor([[3.0, 4.0]]), torch.tensor([[0.0, 2.0]])
    update = gradient + 0.1 * weight
    trust = 0.01 * 5.0 / update.norm()
    expected = weight - 0.5 * trust * update
    torch.testing.assert_close(_stepped(weight, gradient, weight_decay=0.1, trust=0.01), expected)


def test_lars_keeps_momentum():
    weight, gradient = torch.tensor([2.0]), torch.tensor([1.0])
    # Biases step by lr × (1 + m), without decay or scaling.
    torch.testing.assert_close(_stepped(weight, gradient, 2, momentum=0.5), weight - 0.5 * (1.0 + 1.5))


def test_lars_ignores_the_length_of_a_gradient_but_for_biases():
    weight, gradient = torch.randn(4, 3), torch.randn(4, 3)
    long = _stepped(weight, 1e3 * gradient, weight_decay=0.0)
    torch.testing.assert_close(long, _stepped(weight, gradient, weight_decay=0.0))
    assert not torch.allclose(_stepped(weight[0], 1e3 * gradient[0]), _stepped(weight[0], gradient[0]))


def test_lars_moves_weights_that_start_at_zero():
    assert _stepped(torch.zeros(2, 2), torch.ones(2, 2)).abs().min() > 0
    assert torch.equal(_stepped(torch.ones(2, 2), torch.zeros(2, 2), weight_decay=0.0), torch.ones(2, 2))


@pytest.mark.parametrize("name", list(OPTIMIZERS))
def test_every_optimiser_descends_a_bowl(name):
    weight = nn.Parameter(torch.full((3, 3), 5.0))
    optimizer = make_optimizer(name, [weight], 0.1 if name != "lars" else 10.0)
    for _ in range(60):
        optimizer.zero_grad()
        weight.square().sum().backward()
        optimizer.step()
    assert weight.abs().max() < 5.0


def test_wrong_choices_are_refused():
    with pytest.raises(UsageError, match=r"'larz'.*'lars'"):
        make_optimizer("larz", [], 0.1)
    with pytest.raises(UsageError, match="received nan"):
        make_optimizer("sgd", [nn.Parameter(torch.zeros(1))], math.nan)
    with pytest.raises(UsageError, match="received -1"):
        make_optimizer("lars", [nn.Parameter(torch.zeros(1))], -1)
    with pytest.raises(UsageError, match=r"'stepp'.*'step'"):
        rate_factor("stepp", 0, epochs=1)


def test_schedules_follow_their_definitions():
    steps = [rate_factor("step", epoch, epochs=100) for epoch in (0, 29, 30, 59.9, 60, 90)]
    assert steps == pytest.approx([1, 1, 0.1, 0.1, 0.01, 0.001])
    assert rate_factor("constant", 77, epochs=100) == 1
    cosine = [rate_factor("cosine", epoch, epochs=100) for epoch in (0, 25, 50, 75, 100, 101)]
    assert cosine == pytest.approx([1, (2 + math.sqrt(2)) / 4, 0.5, (2 - math.sqrt(2)) / 4, 0, 0])
    warm = [rate_factor("cosine", epoch, epochs=100, warmup_epochs=10) for epoch in (0, 5, 10, 55, 100)]
    assert warm == pytest.approx([1e-4, 0.50005, 1, 0.5, 0])


def test_a_short_run_warms_up_for_at_most_half_of_it():
    assert rate_factor("cosine", 2, epochs=4, warmup_epochs=10) == pytest.approx(1)
