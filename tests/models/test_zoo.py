"""The contract that every architecture of the registry keeps."""

import pytest
import torch

from brainbench.models.registry import describe_model, list_models, load_model

SMALL = list_models("*-small*")
FULL = [name for name in list_models() if name not in SMALL]
# Attenders do not know their encoder's cell, so one of them stands for all in the default run.
QUICK = [name for name in FULL if not name.endswith("+gpt")] + ["zhuang-intersection-ln+gpt"]
SCALE = torch.tensor(([1e-4] * 3 + [1e-6] * 3) * 5)[:, None, None]


def _sweep(batch, steps):
    return torch.randn(batch, steps, 30, 5, 7) * SCALE


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
        state = model.init_state(len(x))
        for t in range(x.shape[1]):
            streamed, state = model.step(x[:, t], state)
            torch.testing.assert_close(streamed, activations["decoder"][:, t], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(streamed, y, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", SMALL)
def test_a_small_model_keeps_the_contract(name):
    _keeps_the_contract(load_model(name), _sweep(2, 6))


@pytest.mark.parametrize("name", QUICK)
def test_a_full_model_keeps_the_contract(name):
    _keeps_the_contract(load_model(name), _sweep(1, 3))


@pytest.mark.slow
@pytest.mark.parametrize("name", FULL)
def test_a_full_model_keeps_the_contract_over_a_whole_sweep(name):
    _keeps_the_contract(load_model(name), _sweep(2, 22))


def _gradients_arrive(model, steps):
    model.train()
    model(_sweep(2, steps)).square().sum().backward()
    silent = [name for name, value in model.named_parameters() if value.grad is None or not value.grad.any()]
    assert silent == []
    assert all(torch.isfinite(value.grad).all() for value in model.parameters())


@pytest.mark.parametrize("name", SMALL)
def test_gradients_reach_every_parameter(name):
    # conv6 first answers at step 5 and reaches the output three steps later.
    _gradients_arrive(load_model(name), 10)


@pytest.mark.slow
@pytest.mark.parametrize("name", FULL)
def test_gradients_reach_every_parameter_of_a_full_model(name):
    _gradients_arrive(load_model(name), 10)


@pytest.mark.parametrize("name", SMALL)
def test_a_small_model_is_small(name):
    assert describe_model(name).parameters <= 2_500_000


@pytest.mark.parametrize("name", SMALL)
def test_weights_survive_saving(name, tmp_path):
    from safetensors.torch import save_file

    model = load_model(name, seed=1)
    save_file(model.state_dict(), tmp_path / "model.safetensors")
    loaded = load_model(f"{name}.supervised", seed=2, pretrained=tmp_path / "model.safetensors")
    x = _sweep(1, 4)
    with torch.no_grad():
        assert torch.equal(loaded(x), model(x))


@pytest.mark.parametrize("name", SMALL)
def test_different_stimuli_stay_different_in_every_layer(name):
    # An untrained network is a baseline only if it does not wash its stimuli out.
    with torch.no_grad():
        activations = load_model(name).activations(_sweep(4, 12))
    for layer, values in activations.items():
        flat = values.flatten(1)
        spread, size = flat.std(0).pow(2).mean().sqrt(), flat.pow(2).mean().sqrt()
        assert spread > 1e-3 * size, layer
