import pytest
import torch
from torch import nn

from brainbench.models.ops.seeding import seeded
from brainbench.models.registry import load_model
from brainbench.models.training.initial_state import draw_silent_biases
from brainbench.models.training.objectives import make_learner
from brainbench.models.training.trainer import train
from tests.factories.training_sweeps import sweeps
from tests.models.training.test_trainer import _config

NORMALISED = ("zhuang-intersection-ln-small", "zhuang-gru-ln-small", "s4-small+gpt")


def _late_touch(silent=14, loud=8):
    """Sweeps of nothing at first, as before an object arrives."""
    x, labels = sweeps(4, 0, steps=silent + loud)
    x[:, :silent] = 0.0
    return x, labels


def _gradient_norm(model):
    x, labels = _late_touch()
    loss, _ = make_learner("supervised", model.train())((x,), labels)
    loss.backward()
    return torch.stack([p.grad.norm() for p in model.parameters() if p.grad is not None]).norm()


@pytest.mark.parametrize("name", NORMALISED)
def test_silence_before_touch_explodes_the_gradient_of_layer_norm_unless_biases_are_drawn(name):
    assert not _gradient_norm(load_model(name, classes=3)) < 1e6
    model = load_model(name, classes=3)
    with seeded(0):
        assert draw_silent_biases(model) > 0
    assert _gradient_norm(model) < 1e3


def test_biases_lie_where_pytorch_draws_them_and_repeat_with_the_seed():
    def drawn(seed):
        layer = nn.Sequential(nn.Conv2d(3, 200, 2), nn.LayerNorm(2))
        nn.init.zeros_(layer[0].bias)
        with seeded(seed):
            assert draw_silent_biases(layer) == 1
        return layer[0].bias.detach()

    bound = 12**-0.5
    assert drawn(0).abs().max() <= bound
    assert drawn(0).std() == pytest.approx(bound / 3**0.5, rel=0.1)
    assert torch.equal(drawn(0), drawn(0))
    assert not torch.equal(drawn(0), drawn(1))


def test_networks_without_layer_norm_and_biases_that_are_there_stay_as_they_are():
    model = load_model("zhuang-small", classes=3)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    assert draw_silent_biases(model) == 0
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    layer = nn.Sequential(nn.Linear(2, 2), nn.LayerNorm(2))
    nn.init.ones_(layer[0].bias)
    assert draw_silent_biases(layer) == 0
    assert layer[0].bias.tolist() == [1.0, 1.0]


def test_a_run_of_a_layer_normalised_network_on_late_touch_trains(tmp_path):
    from brainbench.models.training.batches import ArrayData

    data = ArrayData(("front", "middle", "back"), train=_late_touch())
    config = _config(model="zhuang-intersection-ln-small", epochs=1, batch_size=4)
    result = train(config, data, out=tmp_path, device="cpu")
    assert result.status == "finished", result.reason
