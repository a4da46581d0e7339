import math

import pytest
import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.models.registry import load_model
from brainbench.models.training.objectives import autoencoder_loss, make_learner, nt_xent, simsiam_loss

NAMES = ["supervised", "simclr", "simsiam", "ae"]


def _learner(objective, name="zhuang-small"):
    return make_learner(objective, load_model(name, classes=3)).train()


def _batch(learner, batch=4, steps=9):
    return tuple(1e-4 * torch.randn(batch, steps, 30, 5, 7) for _ in range(learner.views)), torch.arange(batch) % 3


def test_nt_xent_is_the_sum_over_pairs_of_its_definition():
    first, second = torch.randn(5, 7), torch.randn(5, 7)
    z, total = functional.normalize(torch.cat((first, second)), dim=1), 0.0
    for i in range(10):
        others = [math.exp(float(z[i] @ z[k]) / 0.1) for k in range(10) if k != i]
        total -= math.log(math.exp(float(z[i] @ z[(i + 5) % 10]) / 0.1) / sum(others))
    assert float(nt_xent(first, second)) == pytest.approx(total / 10, rel=1e-5)


def test_mixed_precision_does_not_round_the_cosines_that_the_temperature_magnifies():
    generator = torch.Generator().manual_seed(0)
    first, second = torch.randn(2, 16, 8, generator=generator)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = nt_xent(first, second)
    assert torch.equal(mixed, nt_xent(first, second))


def test_equal_embeddings_of_all_cost_the_logarithm_of_the_choices():
    assert float(nt_xent(torch.ones(4, 8), torch.ones(4, 8))) == pytest.approx(math.log(7))


def test_simsiam_is_minus_one_when_predictions_are_right_and_stops_the_gradient():
    z1, z2 = torch.randn(3, 5, requires_grad=True), torch.randn(3, 5, requires_grad=True)
    assert simsiam_loss(2 * z2, z1, 3 * z1, z2).item() == pytest.approx(-1)
    p1, p2 = torch.randn(3, 5, requires_grad=True), torch.randn(3, 5, requires_grad=True)
    simsiam_loss(p1, z1, p2, z2).backward()
    assert z1.grad is None
    assert p1.grad is not None


def test_the_autoencoder_loss_weighs_error_and_sparsity():
    loss = autoencoder_loss(torch.zeros(2, 3), torch.full((2, 3), 2.0), torch.full((4,), -5.0))
    assert float(loss) == pytest.approx(0.5 * 4 + 1e-4 * 5)


@pytest.mark.parametrize("objective", NAMES)
def test_gradients_reach_what_an_objective_trains_and_nothing_else(objective):
    learner = _learner(objective)
    loss = learner(*_batch(learner))
    loss.backward()
    for name, parameter in learner.named_parameters():
        if parameter.requires_grad:
            assert parameter.grad is not None, name
            assert torch.isfinite(parameter.grad).all()
    frozen = {name for name, parameter in learner.named_parameters() if not parameter.requires_grad}
    assert frozen == (set() if objective == "supervised" else {"model.decoder.weight", "model.decoder.bias"})


@pytest.mark.slow
@pytest.mark.parametrize("objective", NAMES)
def test_ten_steps_on_one_batch_lower_the_loss(objective):
    learner = _learner(objective, "zhuang-ugrnn-ln-small")
    batch = _batch(learner)
    optimizer = torch.optim.Adam([p for p in learner.parameters() if p.requires_grad], lr=1e-3)
    losses = []
    # The first steps may raise it: which way depends on the processor's last digits.
    for _ in range(10):
        loss = learner(*batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]


def test_the_autoencoder_compares_features_with_the_step_they_can_know():
    learner = _learner("ae")
    assert learner.model.spec.latency == 3
    with pytest.raises(UsageError, match="3 steps; received 3"):
        learner(*_batch(learner, steps=3))


def test_a_plain_network_can_only_be_trained_supervised():
    class Plain(nn.Module):
        def forward(self, x):
            return x.flatten(1)[:, :3]

    assert make_learner("supervised", Plain())((torch.zeros(2, 1, 6, 5, 7),), torch.tensor([0, 1])) > 0
    with pytest.raises(UsageError, match=r"SimCLR .* Plain"):
        make_learner("simclr", Plain())
    with pytest.raises(UsageError, match="objective 'simclear'"):
        make_learner("simclear", Plain())
