from __future__ import annotations

import copy
import dataclasses
import json
import logging

import numpy as np
import pytest
import torch
from torch.nn import functional

from brainbench.core.errors import DataError, UsageError
from brainbench.models.encoders import zhuang_graph
from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node, Pool
from brainbench.models.graph.temporal_graph import TemporalGraph, needed_steps

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


def test_a_chain_that_draws_random_numbers_draws_them_for_every_stimulus():
    nodes = Node("a", Convolution(4)), Node("b", Convolution(4), chain=(Convolution(4, dropout=0.5, bias=1.0),))
    edges = Edge("a", "b"), Edge("b", "a", feedback=True)
    graph = TemporalGraph(GraphSpec(nodes, edges, ("a",), "b", (2, 5, 7))).train()
    graph.node("b").operation.bias.data.fill_(1.0)
    with torch.no_grad():
        silent = graph(torch.zeros(4, 1, 2, 5, 7))[:, 0]
    assert not torch.equal(silent[0], silent[1])


def test_what_no_answer_reads_is_left_out():
    spec = zhuang_graph("intersection")
    steps = needed_steps(spec, "biological", 22, whole=(), last=("fc8",))
    assert steps["fc8"] == (21, 22)
    assert steps["fc7"] == (20, 21)
    # Convolutions remember, so they start at 0; those of the last two steps come too late.
    assert {steps[f"conv{i}"] for i in (2, 4, 6)} == {(0, 20)}
    assert steps["conv3"] == steps["conv5"] == (0, 19)
    assert steps["conv1"] == (0, 19)


def test_a_feedforward_network_needs_its_receptive_field_alone():
    steps = needed_steps(zhuang_graph(feedforward=True), "biological", 22, whole=(), last=("fc8",))
    assert steps["conv6"] == (19, 20)
    assert steps["conv2"] == (15, 20)
    assert steps["conv1"] == (14, 19)


def test_everything_is_needed_when_everything_is_wanted():
    spec = zhuang_graph("gru")
    assert set(needed_steps(spec, "full", 5, whole=spec.order, last=()).values()) == {(0, 5)}


def test_a_sweep_shorter_than_the_latency_reaches_nothing():
    steps = needed_steps(zhuang_graph("gru"), "biological", 2, whole=("fc8",), last=())
    assert steps["fc8"] == (0, 2)
    assert steps["fc7"] == (0, 1)
    assert steps["conv1"] == (0, 0)


@pytest.fixture
def published(reference):
    with np.load(reference / "tnn" / "minizhuang_ugrnn.npz") as stored:
        return dict(stored)


def _weights(data):
    return {key.removeprefix("w/"): data[key] for key in data if key.startswith("w/")}


def _loaded(data, **options):
    graph = TemporalGraph.from_config(json.loads(str(data["config_json"])), **options)
    graph.load_tnn_state(_weights(data))
    return graph.eval()


@pytest.mark.shared
@pytest.mark.parametrize(("unroll", "key"), [("biological", "y_bio"), ("full", "y_full_unroll")])
def test_outputs_equal_pytorchtnn(published, unroll, key):
    with torch.no_grad():
        y = _loaded(published)(torch.from_numpy(published["x"]), unroll=unroll)
    np.testing.assert_allclose(y, published[key], atol=1e-5, rtol=0)


@pytest.mark.shared
def test_activations_equal_pytorchtnn(published):
    graph = _loaded(published)
    with torch.no_grad():
        _, activations = graph(torch.from_numpy(published["x"]), return_activations=True)
    assert list(activations) == list(graph.layers)
    for node, values in activations.items():
        np.testing.assert_allclose(values, published[f"act/{node}"].swapaxes(0, 1), atol=1e-5, rtol=0)


@pytest.mark.shared
def test_the_shape_can_be_given_instead_of_taken_from_the_weights(published, tmp_path):
    file = tmp_path / "graph.json"
    file.write_text(str(published["config_json"]))
    graph = TemporalGraph.from_config(file, input_shape=(6, 5, 7))
    graph.load_tnn_state(_weights(published))
    assert graph.init_state(1).outputs["conv1"].shape == (1, 3, 4, 6)
    with torch.no_grad():
        y = graph(torch.from_numpy(published["x"]))
    np.testing.assert_allclose(y, published["y_bio"], atol=1e-5, rtol=0)


@pytest.mark.shared
def test_weights_for_another_stimulus_shape_are_announced_and_checked(published, caplog):
    with caplog.at_level(logging.WARNING):
        graph = _loaded(published)
    assert "[3, 6, 6]" in caplog.text
    with pytest.raises(UsageError, match=r"input_shape .*from_config"):
        graph.init_state(1)
    with pytest.raises(UsageError, match=r"\[6, 9, 9\]: node 'fc7'"):
        graph(torch.zeros(1, 2, 6, 9, 9))
    graph(torch.zeros(1, 2, 6, 5, 7))
    assert graph.input_shape == (6, 5, 7)
    with pytest.raises(UsageError, match=r"= \[6, 5, 7\]; received \[6, 7, 5\]"):
        graph(torch.zeros(1, 2, 6, 7, 5))


@pytest.mark.shared
def test_parameters_that_do_not_fit_are_named_and_change_nothing(published):
    graph = TemporalGraph.from_config(json.loads(str(published["config_json"])))
    before = copy.deepcopy(graph.state_dict())
    weights = _weights(published)
    weights["fc8._pre_memory.lin.wieght"] = weights.pop("fc8._pre_memory.lin.weight")
    weights["conv3._recurrent_cell.conv.bias"] = np.zeros(7)
    with pytest.raises(DataError) as caught:
        graph.load_tnn_state(weights)
    assert "missing 'fc8._pre_memory.lin.weight'" in str(caught.value)
    assert "'fc8._pre_memory.lin.wieght' → 'fc8._pre_memory.lin.weight'" in str(caught.value)
    assert "'conv3._recurrent_cell.conv.bias' has shape [7], expected [16]" in str(caught.value)
    assert all(torch.equal(value, before[name]) for name, value in graph.state_dict().items())


def _small(cell="ugrnn", **options):
    return TemporalGraph(zhuang_graph(cell, small=True, **options)).eval()


@pytest.mark.parametrize(
    ("unroll", "expected"),
    [
        ("biological", {f"conv{i + 1}": i for i in range(6)} | {"fc7": 2, "fc8": 3}),
        ("full", {f"conv{i + 1}": 0 for i in range(6)} | {"fc7": 0, "fc8": 0}),
    ],
)
def test_nodes_first_respond_when_the_published_table_says(unroll, expected):
    graph = _small("time-decay")
    x = torch.randn(1, 8, 30, 5, 7)
    changed = x.clone()
    changed[:, 0] += 1.0
    with torch.no_grad():
        _, before = graph(x, unroll=unroll, return_activations=True)
        _, after = graph(changed, unroll=unroll, return_activations=True)
    differs = {node: (before[node] != after[node]).flatten(2).any(2)[0] for node in before}
    assert {node: int(steps.nonzero()[0]) for node, steps in differs.items()} == expected
    assert graph.spec.first_response(unroll) == expected


def test_silent_nodes_still_carry_their_bias():
    graph = _small("time-decay")
    graph.node("conv6").operation.bias.data.fill_(0.25)
    with torch.no_grad():
        _, activations = graph(torch.zeros(1, 1, 30, 5, 7), return_activations=True)
    torch.testing.assert_close(activations["conv6"], torch.full((1, 1, 48, 4, 6), 0.25))
    torch.testing.assert_close(activations["fc7"], torch.full((1, 1, 192), 0.1))


@pytest.mark.parametrize("unroll", UNROLLS)
@pytest.mark.parametrize("cell", ["time-decay", "ugrnn", "intersection", "gru", "lstm"])
def test_a_step_equals_the_sweep(cell, unroll):
    graph = _small(cell, layer_norm=cell != "time-decay")
    x = torch.randn(2, 7, 30, 5, 7)
    with torch.no_grad():
        expected, activations = graph(x, unroll=unroll, return_activations=True)
        state = graph.init_state(2)
        for t in range(x.shape[1]):
            y, state = graph.step(x[:, t], state, unroll=unroll)
            torch.testing.assert_close(y, expected[:, t], atol=1e-5, rtol=1e-4)
            for node, value in state.outputs.items():
                torch.testing.assert_close(value, activations[node][:, t], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("unroll", UNROLLS)
def test_stimuli_do_not_mix(unroll):
    graph = _small("intersection")
    x = torch.randn(3, 5, 30, 5, 7)
    with torch.no_grad():
        together = graph(x, unroll=unroll)
        alone = torch.cat([graph(row[None], unroll=unroll) for row in x])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-4)


def test_only_the_nodes_asked_for_are_returned():
    graph = _small()
    y, activations = graph(torch.randn(1, 2, 30, 5, 7), return_activations=("fc7", "conv3"))
    assert list(activations) == ["conv3", "fc7"]
    assert y.shape == (1, 2, 96)
    with pytest.raises(UsageError, match=r"'conv33'.*'conv3'"):
        graph(torch.randn(1, 2, 30, 5, 7), return_activations=("conv33",))


@pytest.mark.parametrize("shape", [(1, 30, 5, 7), (1, 0, 30, 5, 7), (30, 5, 7)])
def test_a_sweep_without_time_is_refused(shape):
    with pytest.raises(UsageError, match=r"\[batch, time, channels"):
        _small()(torch.zeros(shape))


def test_a_step_with_time_is_refused():
    graph = _small()
    with pytest.raises(UsageError, match=r"steps of shape \[channels, rows, columns\]"):
        graph.step(torch.zeros(1, 1, 30, 5, 7), graph.init_state(1))


@pytest.mark.parametrize("unroll", UNROLLS)
@pytest.mark.parametrize("cell", ["time-decay", "gru", "intersection"])
@pytest.mark.parametrize("steps", [1, 2, 3, 4, 5, 9])
def test_the_last_answer_alone_equals_the_last_of_all(cell, unroll, steps):
    graph, x = _small(cell), torch.randn(2, steps, 30, 5, 7)
    with torch.no_grad():
        every = graph(x, unroll=unroll)
        torch.testing.assert_close(graph(x, unroll=unroll, last=True), every[:, -1], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("spec", [zhuang_graph("lstm", True, True), _uneven()], ids=["zhuang", "uneven"])
@pytest.mark.parametrize("last", [False, True])
def test_gradients_are_those_of_streaming_step_by_step(spec, last):
    graph = TemporalGraph(spec).double()
    x = torch.randn(3, 9, *spec.input_shape, dtype=torch.float64)
    weights = torch.randn(9, dtype=torch.float64)
    weights[:-1] *= not last
    state, outputs = graph.init_state(3), []
    for t in range(9):
        y, state = graph.step(x[:, t], state)
        outputs.append(y)
    (torch.stack(outputs, 1) * weights[:, None]).square().sum().backward()
    expected = {name: value.grad.clone() for name, value in graph.named_parameters()}
    graph.zero_grad()
    y = graph(x, last=True)[:, None] * weights[-1] if last else graph(x) * weights[:, None]
    y.square().sum().backward()
    for name, value in graph.named_parameters():
        torch.testing.assert_close(value.grad, expected[name], msg=name)
