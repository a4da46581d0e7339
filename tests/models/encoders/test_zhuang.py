import pytest
import torch

from brainbench.models.encoders.zhuang import zhuang_graph
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
