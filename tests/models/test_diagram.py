"""Diagrams name the layers that are scored and hold every connection of the network."""

import pytest
from torch import nn

from brainbench.models.diagram import graph_of
from brainbench.models.registry import load_model


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
