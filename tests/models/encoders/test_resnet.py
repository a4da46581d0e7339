import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.encoders.resnet import ResNet18Encoder


def _encoder():
    return ResNet18Encoder(small=True).eval()


def test_parameters_equal_the_published_count():
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in ResNet18Encoder().parameters()) == 11_523_840


def test_every_step_is_seen_alone():
    encoder, x = _encoder(), torch.randn(2, 5, 30, 5, 7)
    changed = x.clone()
    changed[:, 2] += 1.0
    with torch.no_grad():
        before, after = encoder(x), encoder(changed)
    assert (before != after).any(2)[0].tolist() == [False, False, True, False, False]


def test_activations_are_the_stages_in_order():
    with torch.no_grad():
        y, activations = _encoder()(torch.randn(2, 3, 30, 5, 7), return_activations=True)
    assert tuple(activations) == ResNet18Encoder.layers
    assert {name: tuple(value.shape[2:]) for name, value in activations.items()} == {
        "conv1": (12, 2, 2),
        "layer1": (12, 2, 2),
        "layer2": (24, 1, 1),
        "layer3": (48, 1, 1),
        "layer4": (96, 1, 1),
        "fc": (96,),
    }
    assert torch.equal(activations["fc"], y)


def test_a_residual_block_that_adds_nothing_passes_its_input_on():
    encoder = _encoder()
    block = encoder.layer1[0]
    with torch.no_grad():
        block.norm2.weight.zero_()
        x = torch.rand(2, 12, 2, 2)
        assert torch.equal(block(x), x)


def test_a_wrong_stimulus_is_refused():
    with pytest.raises(UsageError, match=r"received \[1, 2, 6, 5, 7\]"):
        _encoder()(torch.zeros(1, 2, 6, 5, 7))
