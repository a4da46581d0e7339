from __future__ import annotations

import math
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.core.runs.log import read_log
from brainbench.models.cells import CELLS
from brainbench.models.ops.layers import copy_named
from brainbench.models.recipes import OPTIMIZERS
from brainbench.models.registry import load_model
from brainbench.models.training import objectives
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.objectives import (
    LARS,
    Gradients,
    autoencoder_loss,
    fuse,
    make_learner,
    make_optimizer,
    nt_xent,
    rate_factor,
    simsiam_loss,
)
from brainbench.models.training.trainer import train
from tests.factories.training_sweeps import sweeps, tiny

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


class _Named(nn.Module):
    """A network of which only the sizes count."""

    encode = normaliser = None

    def __init__(self, features, channels=30):
        super().__init__()
        self.features, self.spec = features, SimpleNamespace(input_shape=(channels, 5, 7))


@pytest.mark.parametrize(("objective", "parameters"), [("simclr", 1_315_072), ("simsiam", 11_556_352), ("ae", 289_665)])
def test_heads_have_the_published_parameters(objective, parameters):
    with torch.device("meta"):
        learner = make_learner(objective, _Named(512))
    assert sum(parameter.numel() for parameter in learner.parameters()) == parameters


def test_heads_have_the_published_shapes():
    features = torch.randn(4, 96)
    assert make_learner("simclr", _Named(96)).head["layers"](features).shape == (4, 128)
    siamese = make_learner("simsiam", _Named(96)).head
    assert (found := siamese["projector"](features)).shape == siamese["predictor"](found).shape == (4, 2048)
    assert make_learner("ae", _Named(96)).reconstruct(features.view(2, 2, 96)).shape == (2, 2, 30, 5, 7)
    with pytest.raises(UsageError, match=r"channels .*received 1"):
        make_learner("ae", _Named(96, channels=1))


def test_steps_are_reconstructed_each_from_its_own_features():
    learner, features = make_learner("ae", _Named(8)), torch.randn(2, 3, 8)
    with torch.no_grad():
        every = learner.reconstruct(features)
        torch.testing.assert_close(every[:, 1], learner.reconstruct(features[:, 1:2])[:, 0])


def test_a_plain_network_can_only_be_trained_supervised():
    class Plain(nn.Module):
        def forward(self, x):
            return x.flatten(1)[:, :3]

    assert make_learner("supervised", Plain())((torch.zeros(2, 1, 6, 5, 7),), torch.tensor([0, 1])) > 0
    with pytest.raises(UsageError, match=r"SimCLR .* Plain"):
        make_learner("simclr", Plain())


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
    # Whoever makes an optimiser has a configuration, which refuses them.
    with pytest.raises(UsageError, match=r"'larz'.*'lars'"):
        TrainingConfig("zhuang", optimizer="larz")
    with pytest.raises(UsageError, match="received nan"):
        TrainingConfig("zhuang", learning_rate=math.nan)
    with pytest.raises(UsageError, match="received -1"):
        TrainingConfig("zhuang", learning_rate=-1)
    with pytest.raises(UsageError, match=r"'stepp'.*'step'"):
        TrainingConfig("zhuang", schedule="stepp")
    with pytest.raises(UsageError, match="objective 'simclear'"):
        TrainingConfig("zhuang", "simclear")


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


@pytest.mark.slow
@pytest.mark.parametrize("model", ["zhuang-small", "resnet18-small"])
def test_a_run_of_recorded_steps_ends_with_the_weights_of_a_plain_one(model, tmp_path, monkeypatch):
    monkeypatch.setattr(objectives, "fuse", lambda module: None)
    finals = []
    for how in ("off", "graphs"):
        # 20 sweeps in batches of 8: the last batch of each epoch has another shape than the recorded one.
        config = TrainingConfig.published(
            model, "supervised", epochs=2, batch_size=8, precision="float32", decoder="linear", compile=how
        )
        result = train(config, tiny(train=20), out=tmp_path / how, device="cpu")
        assert result.status == "finished"
        finals.append((tmp_path / how / "best" / "model.safetensors").read_bytes())
    assert finals[0] == finals[1]


# PyTorch's compiler uses a part of PyTorch that PyTorch has deprecated.
@pytest.mark.filterwarnings("ignore:.*torch.jit.script_method.*:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")
@pytest.mark.slow
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("name", [name for name in CELLS if name != "time-decay"])
def test_a_fused_cell_computes_what_the_plain_one_does(name, layer_norm):
    torch.manual_seed(0)
    cell = CELLS[name](8, 8, kernel_size=2, layer_norm=layer_norm)
    x, state = torch.randn(3, 8, 4, 6, requires_grad=True), torch.randn(3, 8 * cell.state_factor, 4, 6)

    def results():
        cell.zero_grad()
        x.grad = None
        y, after = cell(x, state)
        (y.sum() + after.square().sum()).backward()
        return [y.detach(), after.detach(), x.grad, *(parameter.grad for parameter in cell.parameters())]

    plain = results()
    fuse(cell)
    torch.testing.assert_close(results(), plain, atol=1e-4, rtol=1e-4)
    fuse(cell, False)
    assert not any(part in vars(cell) for part in cell.fused_parts)
    torch.testing.assert_close(results(), plain)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The AccumulateGrad node's stream:UserWarning")
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("objective", ["supervised", "simclr"])
def test_a_recorded_step_gives_the_gradients_of_a_plain_one_at_the_same_weights(objective, device):
    # In double precision, where nothing that training does to rounding hides a fault or looks like one.
    learner = make_learner(objective, load_model("zhuang-ugrnn-small", classes=3, decoder="linear")).train()
    learner = learner.double().to(device)
    parts = {"clip": 1.0, "autocast": nullcontext}
    plain, recorded = (Gradients(learner, learner, record=record, **parts) for record in (False, True))
    optimizer = torch.optim.SGD(learner.parameters(), lr=0.1)
    for number in range(5):
        # The fourth batch has another shape than the recorded one.
        views = [sweeps(6 if number == 3 else 8, 10 * number + view)[0].double().to(device) for view in (0, 1)]
        labels = (torch.arange(len(views[0])) % 3).to(device)
        given = tuple(views[: 2 if objective == "simclr" else 1])
        found = []
        for step in (plain, recorded):
            state = {name: value.clone() for name, value in learner.named_buffers()}
            loss, norm = step(given, labels)
            rows = [parameter.grad.clone() for parameter in learner.parameters() if parameter.grad is not None]
            found.append([loss.clone(), norm.clone(), *rows])
            copy_named(dict(learner.named_buffers()), state)
        torch.testing.assert_close(found[1], found[0], rtol=1e-8, atol=1e-12)
        assert found[0][1] > 0
        optimizer.step()


# What PyTorch itself warns of while it compiles and records (seen with 2.11); none of it changes a number.
@pytest.mark.filterwarnings("ignore:.*torch.jit.script_method.*:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")
@pytest.mark.filterwarnings("ignore:The AccumulateGrad node's stream:UserWarning")
@pytest.mark.gpu
@pytest.mark.parametrize("objective", ["supervised", "simclr"])
def test_recorded_steps_learn_on_a_gpu_as_plain_ones_do(objective, tmp_path):
    losses = []
    for how in ("off", "graphs"):
        config = TrainingConfig.published(
            "zhuang-ugrnn-small", objective, epochs=4, batch_size=8, precision="float32", compile=how, probe_epochs=3
        )
        result = train(config, tiny(), out=tmp_path / how, device="cuda")
        assert result.status == "finished"
        losses.append([line["loss"] for line in read_log(tmp_path / how, "epoch")])
    # Fused cells round otherwise, which training multiplies from epoch to epoch: to 5 % in the fourth (seen on an H200,
    # where the first three agreed). That single steps are right is told by the test above.
    assert losses[1][0] == pytest.approx(losses[0][0], rel=0.01)
    assert losses[1] == pytest.approx(losses[0], rel=0.15)
