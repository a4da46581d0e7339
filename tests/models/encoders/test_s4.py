import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.encoders.s4 import S4Encoder


def test_parameters_equal_the_published_count():
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in S4Encoder().parameters()) == 3_434_496


@torch.no_grad()
def test_a_stream_equals_the_convolution():
    encoder, x = S4Encoder(small=True).eval(), torch.randn(2, 60, 30, 5, 7)
    expected, state = encoder(x), encoder.init_state(2)
    for t in range(60):
        y, state = encoder.step(x[:, t], state)
        torch.testing.assert_close(y, expected[:, t], atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_every_block_ends_in_its_norm():
    activations = S4Encoder(small=True).eval()(torch.randn(2, 9, 30, 5, 7), return_activations=True)[1]
    for index in range(1, 5):
        stream = activations[f"block{index}"]
        torch.testing.assert_close(stream.mean(-1), torch.zeros(2, 9), atol=1e-5, rtol=0.0)
        torch.testing.assert_close(stream.var(-1, unbiased=False), torch.ones(2, 9), atol=1e-3, rtol=0.0)


@torch.no_grad()
def test_dropout_acts_in_training_alone():
    encoder, x = S4Encoder(small=True, dropout=0.5).train(), torch.randn(1, 4, 30, 5, 7)
    assert not torch.equal(encoder(x), encoder(x))
    assert torch.equal(encoder.eval()(x), encoder(x))


@torch.no_grad()
def test_the_future_does_not_show():
    encoder, x = S4Encoder(small=True).eval(), torch.randn(1, 9, 30, 5, 7)
    later = x.clone()
    later[:, 6:] += 3.0
    torch.testing.assert_close(encoder(x)[:, :6], encoder(later)[:, :6], atol=1e-5, rtol=1e-5)
    assert not torch.allclose(encoder(x)[:, 6], encoder(later)[:, 6], atol=1e-2)


def test_a_wrong_stimulus_is_refused():
    with pytest.raises(UsageError, match=r"received \[1, 30, 5, 7\]"):
        S4Encoder(small=True)(torch.zeros(1, 30, 5, 7))
