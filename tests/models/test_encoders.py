import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.encoders import ResNet18Encoder, S4Encoder, zhuang_graph
from brainbench.models.graph.temporal_graph import TemporalGraph

CELLS = ["time-decay", "ugrnn", "gru", "intersection", "lstm"]


def _count(spec):
    with torch.device("meta"):
        return sum(parameter.numel() for parameter in TemporalGraph(spec).parameters())


@pytest.mark.parametrize(
    ("cell", "layer_norm", "parameters"),
    [
        ("time-decay", False, 23_460_072),
        ("ugrnn", False, 30_688_416),
        ("gru", False, 34_302_592),
        ("intersection", False, 37_916_768),
        ("lstm", False, 37_916_768),
        ("intersection", True, 37_928_800),
    ],
)
def test_parameters_equal_the_published_counts(cell, layer_norm, parameters):
    assert _count(zhuang_graph(cell, layer_norm)) == parameters


@pytest.mark.parametrize(("cell", "norms"), [("ugrnn", 2), ("gru", 3), ("lstm", 5)])
def test_layer_norm_adds_a_scale_and_a_shift_per_gate_and_channel(cell, norms):
    channels = 96 + 128 + 256 + 384 + 384 + 256
    assert _count(zhuang_graph(cell, True)) - _count(zhuang_graph(cell)) == 2 * norms * channels


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("cell", CELLS)
def test_the_graph_is_the_published_one_at_either_size(cell, small):
    spec = zhuang_graph(cell, small=small)
    inputs, outputs = spec.shapes()
    feedback = {(edge.source, edge.target) for edge in spec.edges if edge.feedback}
    assert feedback == {(f"conv{a}", f"conv{b}") for a, b in ((3, 2), (4, 2), (4, 3), (5, 3), (5, 4), (6, 4), (6, 5))}
    assert {edge.source for edge in spec.predecessors["fc7"]} == {"conv2", "conv4", "conv6"}
    widths = [18, 24, 48, 72, 72, 48] if small else [96, 128, 256, 384, 384, 256]
    assert [outputs[f"conv{i + 1}"] for i in range(6)] == [(width, 4, 6) for width in widths]
    assert outputs["fc7"] + outputs["fc8"] == ((192, 96) if small else (1024, 512))
    assert inputs["fc7"][0] * 24 == (3456 if small else 18_432)


def test_memory_sits_on_every_node_with_time_decay_and_on_convolutions_with_gates():
    decay, gated = zhuang_graph(), zhuang_graph("gru")
    assert all(node.memory is not None for node in decay.nodes)
    assert [node.name for node in gated.nodes if node.memory is None] == ["fc7", "fc8"]


def test_biases_start_at_zero_and_a_tenth():
    graph = TemporalGraph(zhuang_graph("lstm", small=True))
    assert all(not graph.node(f"conv{i + 1}").operation.bias.any() for i in range(6))
    assert torch.equal(graph.node("fc7").operation.bias, torch.full((192,), 0.1))
    assert all(not module.conv.bias.any() for module in graph.modules() if hasattr(module, "conv"))


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


def test_parameters_equal_the_published_count_of_s4():
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


def test_a_wrong_stimulus_is_refused_of_s4():
    with pytest.raises(UsageError, match=r"received \[1, 30, 5, 7\]"):
        S4Encoder(small=True)(torch.zeros(1, 30, 5, 7))
