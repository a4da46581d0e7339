"""One node of a graph: resizing, pooling, feedback and dropout."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn import functional

from brainbench.models.encoders import zhuang_graph
from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node, Pool
from brainbench.models.graph.temporal_graph import TemporalGraph

UNROLLS = ("biological", "full")


def _uneven():
    """Two grids, feedback across them, a pool and a node that reads the stimulus and feedback."""
    return GraphSpec(
        nodes=(
            Node(
                "low", Convolution(3, (3, 3), padding="same"), Memory("time-decay", tau=0.5), pool=Pool("max", (2, 2))
            ),
            Node("high", Convolution(4, (2, 2), (1, 1), "valid", activation="ELU"), activation=None),
            Node("out", Dense(5, activation="Tanh"), activation=None),
        ),
        edges=(Edge("low", "high"), Edge("high", "low", feedback=True), Edge("high", "out"), Edge("low", "out")),
        inputs=("low",),
        output="out",
        input_shape=(2, 8, 6),
    )


@pytest.mark.parametrize("unroll", UNROLLS)
def test_resizing_pooling_and_feedback_follow_the_equations(unroll):
    # "out" takes its grid from "high", the latest feedforward predecessor; feedback to "low" is enlarged.
    graph = TemporalGraph(_uneven()).eval()
    low, high, out = (graph.node(name).operation for name in ("low", "high", "out"))
    x = torch.randn(2, 4, 2, 8, 6)

    def resized(values, grid):
        return functional.interpolate(values, size=grid, mode="bilinear", antialias=True)

    with torch.no_grad():
        y, activations = graph(x, unroll=unroll, return_activations=True)
        a, b, trace = torch.zeros(2, 3, 4, 3), torch.zeros(2, 4, 3, 2), 0.0
        for t in range(4):
            seen = torch.cat((x[:, t], resized(b, (8, 6))), 1)
            trace = functional.conv2d(seen, low.weight, low.bias, padding=1) + 0.5 * trace
            new_a = functional.max_pool2d(torch.relu(trace), 2)
            source = a if unroll == "biological" else new_a
            new_b = functional.elu(functional.conv2d(source, high.weight, high.bias))
            top, bottom = (b, a) if unroll == "biological" else (new_b, new_a)
            flat = torch.cat((top, resized(bottom, (3, 2))), 1).flatten(1)
            expected = torch.tanh(functional.linear(flat, out.weight, out.bias))
            a, b = new_a, new_b
            torch.testing.assert_close(activations["low"][:, t], a, atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(activations["high"][:, t], b, atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(y[:, t], expected, atol=1e-5, rtol=1e-4)


def test_resizing_keeps_a_constant_map():
    graph = TemporalGraph(_uneven())
    enlarged = torch.cat(graph.node("low").resized([torch.zeros(1, 2, 8, 6), torch.full((1, 4, 3, 2), 7.0)]), 1)
    torch.testing.assert_close(enlarged[:, 2:], torch.full((1, 4, 8, 6), 7.0))


def test_dropout_acts_in_training_alone():
    spec = GraphSpec((Node("a", Dense(200, dropout=0.5)),), (), ("a",), "a", (2, 5, 7))
    graph, x = TemporalGraph(spec), torch.randn(1, 1, 2, 5, 7)
    assert not torch.equal(graph.train()(x), graph(x))
    assert torch.equal(graph.eval()(x), graph(x))


def test_a_node_that_draws_random_numbers_draws_them_for_every_stimulus():
    spec = zhuang_graph("ugrnn", small=True)
    nodes = tuple(
        dataclasses.replace(node, operation=dataclasses.replace(node.operation, dropout=0.5)) for node in spec.nodes
    )
    graph = TemporalGraph(dataclasses.replace(spec, nodes=nodes)).train()
    graph.node("conv6").operation.bias.data.fill_(1.0)
    with torch.no_grad():
        y = graph(torch.zeros(4, 3, 30, 5, 7), return_activations=("fc7",))[1]["fc7"]
    assert not torch.equal(y[0], y[1])
