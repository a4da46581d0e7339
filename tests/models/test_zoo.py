"""The contract that every architecture of the registry keeps.

An attender does not know its encoder's cell, so at full size one cell stands for all with an attender.
"""

import copy

import pytest
import torch
from torch import nn

from brainbench.models.registry import describe_model, list_models, load_model
from brainbench.models.zoo import graph_of
from tests.factories.training_sweeps import random_sweeps

SMALL = list_models("*-small*")
FULL = [name for name in list_models() if name not in SMALL]
ENCODERS = [name for name in FULL if "+" not in name]
UNIQUE = [*ENCODERS, "zhuang-intersection-ln+gpt", "zhuang+mamba", "resnet18+gpt", "s4+mamba"]
UNIQUE_SMALL = ["-small+".join(name.split("+")) if "+" in name else f"{name}-small" for name in UNIQUE]
FEW = ["zhuang-intersection-ln+gpt", "zhuang+mamba", "zhuang-feedforward", "resnet18", "s4"]
# conv6 first answers at step 5 and reaches the output three steps later.
LONG_ENOUGH = 10


def _keeps_the_contract(model, x):
    """Shapes, names, finite and reproducible values; a stream gives the sweep's answer."""
    with torch.no_grad():
        y, activations = model(x), model.activations(x)
        assert y.shape == (len(x), 117)
        assert tuple(activations) == model.layers
        for values in activations.values():
            assert values.shape[:2] == x.shape[:2]
            assert torch.isfinite(values).all()
        assert torch.equal(model(x), y)
        assert model.spec.causal
        assert model.encode(x).shape == (*x.shape[:2], model.features)
        state = model.init_state(len(x))
        for t in range(x.shape[1]):
            streamed, state = model.step(x[:, t], state)
            torch.testing.assert_close(streamed, activations["decoder"][:, t], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(streamed, y, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", SMALL)
def test_a_small_model_keeps_the_contract(name):
    _keeps_the_contract(load_model(name), random_sweeps(2, 6))


@pytest.mark.parametrize("name", FEW)
def test_a_full_model_keeps_the_contract(name):
    _keeps_the_contract(load_model(name), random_sweeps(1, 3))


@pytest.mark.slow
@pytest.mark.parametrize("name", FULL)
def test_a_full_model_keeps_the_contract_over_a_whole_sweep(name):
    _keeps_the_contract(load_model(name), random_sweeps(2, 22))


def _gradients_arrive(model):
    model.train()
    model(random_sweeps(3, LONG_ENOUGH)).square().sum().backward()
    silent = [name for name, value in model.named_parameters() if value.grad is None or not value.grad.any()]
    assert silent == []
    assert all(torch.isfinite(value.grad).all() for value in model.parameters())


@pytest.mark.parametrize("name", UNIQUE_SMALL)
def test_gradients_reach_every_parameter(name):
    _gradients_arrive(load_model(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", FULL)
def test_gradients_reach_every_parameter_of_a_full_model(name):
    _gradients_arrive(load_model(name))


@pytest.mark.parametrize("name", SMALL)
def test_a_small_model_is_small(name):
    assert describe_model(name).parameters <= 2_500_000


def _survives_saving(name, folder):
    from safetensors.torch import save_file

    model = load_model(name, seed=1)
    save_file(model.state_dict(), folder / "model.safetensors")
    loaded = load_model(f"{name}.supervised", seed=2, pretrained=folder / "model.safetensors")
    x = random_sweeps(1, 4)
    with torch.no_grad():
        assert torch.equal(loaded(x), model(x))


@pytest.mark.parametrize("name", UNIQUE_SMALL)
def test_weights_survive_saving(name, tmp_path):
    _survives_saving(name, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", FULL)
def test_weights_of_a_full_model_survive_saving(name, tmp_path):
    _survives_saving(name, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", UNIQUE_SMALL)
def test_different_stimuli_stay_different_in_every_layer(name):
    # An untrained network is a baseline only if it does not wash its stimuli out.
    with torch.no_grad():
        activations = load_model(name).activations(random_sweeps(4, 12))
    for layer, values in activations.items():
        flat = values.flatten(1)
        spread, size = flat.std(0).pow(2).mean().sqrt(), flat.pow(2).mean().sqrt()
        assert spread > 1e-3 * size, layer


def _agrees_in_half_precision(name, steps):
    """Under autocast the answers stay within a few per cent: bfloat16 keeps 8 bits."""
    model, x = load_model(name), random_sweeps(2, steps)
    with torch.no_grad():
        exact = model(x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            rough = model(x)
    assert torch.isfinite(rough).all()
    assert (rough.float() - exact).norm() < 0.08 * exact.norm()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in UNIQUE_SMALL if "-ln" not in name or "+" not in name])
def test_half_precision_agrees(name):
    _agrees_in_half_precision(name, 6)


@pytest.mark.slow
@pytest.mark.parametrize("name", UNIQUE)
def test_half_precision_agrees_at_full_size_over_a_whole_sweep(name):
    _agrees_in_half_precision(name, 22)


@pytest.mark.parametrize("name", ["zhuang-intersection-ln-small", "resnet18-small", "s4-small", "zhuang-small+mamba"])
def test_a_model_can_be_copied_and_keeps_its_answer(name):
    model, x = load_model(name), random_sweeps(1, 4)
    with torch.no_grad():
        assert torch.equal(copy.deepcopy(model)(x), model(x))


def test_classes_decoder_and_unrolling_can_be_chosen():
    model = load_model("zhuang-ugrnn-small", classes=24, decoder="mlp", unroll="full")
    assert model.spec.outputs == 24
    assert model.spec.latency == 0
    x = random_sweeps(2, 3)
    with torch.no_grad():
        y, state = model(x), model.init_state(2)
        for t in range(3):
            streamed, state = model.step(x[:, t], state)
    torch.testing.assert_close(streamed, y, atol=1e-4, rtol=1e-4)


def test_the_all_steps_decoder_streams_and_states_its_length():
    model = load_model("resnet18-small", decoder="all-steps", classes=5)
    assert model.spec.max_steps == 22
    assert model.spec.receptive_field is None
    x = random_sweeps(2, 4)
    with torch.no_grad():
        activations, state = model.activations(x), model.init_state(2)
        for t in range(4):
            streamed, state = model.step(x[:, t], state)
            torch.testing.assert_close(streamed, activations["decoder"][:, t], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(streamed, model(x), atol=1e-4, rtol=1e-4)


def test_the_feedforward_control_sees_eight_steps_and_three_of_them_late():
    model = load_model("zhuang-feedforward-small")
    assert (model.spec.receptive_field, model.spec.latency) == (8, 3)
    x = random_sweeps(1, 12)
    x.requires_grad_()
    model(x).sum().backward()
    seen = x.grad.flatten(2).abs().sum(2)[0] > 0
    assert seen.nonzero()[:, 0].tolist() == [4, 6, 8]


@pytest.mark.parametrize(
    "name", ["zhuang-intersection-ln-small+gpt", "resnet18-small", "s4-small+mamba", "zhuang-feedforward-small"]
)
def test_nodes_are_the_layers_with_all_parameters_of_the_parts(name):
    model = load_model(name)
    graph = graph_of(model)
    assert graph is not None
    assert [node.name for node in graph.nodes] == ["input", *model.layers]
    ends = {end for edge in graph.edges for end in (edge.source, edge.target)}
    assert ends == {node.name for node in graph.nodes}
    counted = sum(node.parameters or 0 for node in graph.nodes)
    total = sum(parameter.numel() for parameter in model.parameters())
    # A transformer's embeddings belong to no layer; everything else is counted once.
    attender = sum(parameter.numel() for parameter in model.attender.parameters()) if model.attender else 0
    assert total - attender <= counted <= total


def test_the_published_feedback_is_there():
    graph = graph_of(load_model("zhuang-intersection-ln-small"))
    assert graph is not None
    feedback = {(edge.source[-5:], edge.target[-5:]) for edge in graph.edges if edge.feedback}
    published = {(3, 2), (4, 2), (4, 3), (5, 3), (5, 4), (6, 4), (6, 5)}
    assert feedback == {(f"conv{source}", f"conv{target}") for source, target in published}
    nodes = {node.name: node for node in graph.nodes}
    assert nodes["encoder.conv1"].shape == (18, 4, 6)
    assert nodes["encoder.conv3"].memory == "IntersectionRNN, LN"


def test_other_modules_have_no_graph():
    assert graph_of(nn.Linear(2, 2)) is None
