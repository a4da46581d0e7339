from __future__ import annotations

import dataclasses

import pytest
import torch

from brainbench.core.contracts import CHANNELS, GRID_SHAPE
from brainbench.core.errors import UsageError
from brainbench.models.encoders import GPTAttender, zhuang_graph
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.network import EncoderAttenderDecoder, Normaliser
from brainbench.models.parts import make_decoder
from brainbench.models.registry import load_model
from tests.factories.training_sweeps import SCALE, random_sweeps


def test_the_physical_scale_makes_typical_forces_and_moments_one():
    x = torch.tensor(([1e-4] * 3 + [1e-6] * 3) * 5).view(1, 1, 30, 1, 1).expand(2, 3, 30, 5, 7)
    torch.testing.assert_close(Normaliser.physical()(x), torch.ones(2, 3, 30, 5, 7))


def test_offset_and_scale_belong_to_their_channel():
    y = Normaliser([2.0, 4.0], [1.0, -1.0])(torch.tensor([3.0, 3.0]).view(1, 2, 1, 1).expand(1, 2, 5, 7))
    assert y[0, :, 0, 0].tolist() == [1.0, 1.0]


def test_numbers_are_saved_but_not_trained():
    normaliser = Normaliser.physical()
    assert set(normaliser.state_dict()) == {"scale", "offset"}
    assert not list(normaliser.parameters())


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_a_scale_that_gives_no_numbers_is_refused(scale):
    with pytest.raises(UsageError, match="scale of a normaliser"):
        Normaliser([1.0, scale])
    with pytest.raises(UsageError, match="offset of a normaliser"):
        Normaliser([1.0], [float("inf")])


def _network(*, gpt=False, **options):
    encoder = TemporalGraph(zhuang_graph("intersection", layer_norm=True, small=True))
    return EncoderAttenderDecoder(encoder, GPTAttender(96, 32, blocks=2) if gpt else None, **options).eval()


def test_the_answer_is_decoded_from_the_last_step_in_physical_units():
    network, x = _network(), random_sweeps(2, 6)
    with torch.no_grad():
        scaled = x / SCALE
        expected = network.decoder(network.encoder(scaled)[:, -1])
        torch.testing.assert_close(network(x), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("gpt", [False, True])
def test_a_stream_gives_the_sweeps_answer_at_every_step(gpt):
    network, x = _network(gpt=gpt), random_sweeps(2, 6)
    with torch.no_grad():
        state = network.init_state(2)
        for t in range(x.shape[1]):
            y, state = network.step(x[:, t], state)
            torch.testing.assert_close(y, network(x[:, : t + 1]), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("gpt", [False, True])
def test_activations_come_in_the_order_of_the_layers(gpt):
    network = _network(gpt=gpt)
    with torch.no_grad():
        activations = network.activations(x := random_sweeps(2, 6))
        y = network(x)
    assert tuple(activations) == network.layers
    assert network.layers[0] == "encoder.conv1"
    assert network.layers[-1] == "decoder"
    assert ("attender.lm_head" in network.layers) is gpt
    assert all(value.shape[:2] == (2, 6) for value in activations.values())
    torch.testing.assert_close(activations["decoder"][:, -1], y, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("layers", [["encoder.fc8"], ["decoder"], ["attender.block2"], ["decoder", "encoder.conv1"]])
def test_a_choice_of_layers_equals_the_whole(layers):
    network, x = _network(gpt=True), random_sweeps(2, 6)
    with torch.no_grad():
        some, every = network.activations(x, layers), network.activations(x)
    assert set(some) == set(layers)
    for name, value in some.items():
        torch.testing.assert_close(value, every[name])


def test_an_unknown_layer_names_the_nearest():
    with pytest.raises(UsageError, match=r"did you mean 'encoder\.conv3'"):
        _network().activations(random_sweeps(2, 6), ["conv3"])


def test_the_specification_says_what_goes_in():
    plain, attended = _network().spec, _network(gpt=True).spec
    assert plain.input_shape == (30, *GRID_SHAPE)
    assert plain.channels[:7] == (*(f"0.{name}" for name in CHANNELS), "1.Fx")
    assert plain.units[:6] == ("N", "N", "N", "N·m", "N·m", "N·m")
    assert plain.sample_rate == pytest.approx(1000 / 45)
    assert plain.causal
    assert (plain.latency, plain.outputs) == (3, 117)
    assert (plain.max_steps, attended.max_steps) == (None, 32)
    with pytest.raises(dataclasses.FrozenInstanceError):
        plain.outputs = 3


def test_the_answer_is_blind_to_steps_within_the_latency():
    network = _network()
    with torch.no_grad():
        short = network(random_sweeps(2, 3))
        assert torch.equal(short, network(random_sweeps(2, 3)))
        assert not torch.equal(network(random_sweeps(2, 4)), network(random_sweeps(2, 4)))


def test_any_decoder_fits():
    network = _network(decoder=make_decoder("mlp", 96, 4))
    assert network(random_sweeps(2, 6)).shape == (2, 4)
    assert network.spec.outputs == 4
    with pytest.raises(UsageError, match="Identity has none"):
        _network(decoder=torch.nn.Identity())


@pytest.mark.parametrize("shape", [(2, 6, 6, 5, 7), (2, 30, 5, 7), (2, 0, 30, 5, 7), (2, 6, 30, 7, 5)])
def test_a_wrong_stimulus_is_told_what_is_expected_and_received(shape):
    with pytest.raises(UsageError) as caught:
        _network()(torch.zeros(shape))
    assert "[batch, time, 30, 5, 7]" in str(caught.value)
    assert f"received {list(shape)}" in str(caught.value)


def test_a_wrong_step_is_told_what_is_expected_and_received():
    network = _network()
    with pytest.raises(UsageError, match=r"received \[2, 6, 30, 5, 7\]"):
        network.step(random_sweeps(2, 6), network.init_state(2))


def test_a_network_in_half_precision_is_refused_which_loses_small_moments():
    stimuli = torch.randn(2, 4, 30, 5, 7, generator=torch.Generator().manual_seed(0))
    stimuli *= torch.tensor(([1e-5] * 3 + [1e-7] * 3) * 5)[:, None, None]
    network = load_model("zhuang-small", seed=0).eval()
    with torch.no_grad():
        expected = network(stimuli)
        rounded = network.to(torch.bfloat16)(stimuli.bfloat16()).float()
        assert float((rounded - expected).abs().max() / expected.abs().max()) < 0.02
        with pytest.raises(UsageError, match=r"\(float16\) is too coarse.*take bfloat16"):
            network.to(torch.float16)(stimuli.half())
