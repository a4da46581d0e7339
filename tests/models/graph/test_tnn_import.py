import copy
import json

import pytest
import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import DataError, UsageError
from brainbench.models.graph.spec import Convolution, Dense, Memory, Pool
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.graph.tnn_import import read_graph


def _node(name, shape_from, **changes):
    node = {
        "name": name,
        "shape_from": shape_from,
        "harbor_policy": {"name": "ResizeConcat"},
        "pre_memory": {"name": "Conv2dCell", "out_channels": 4, "ksize": [3, 3], "padding": "same", "bias": 0.0},
        "recurrent_cell": {"name": "IdentityCell"},
        "post_memory": {"name": "ActivationLayer", "activation": "ReLU"},
        "out_channels": 4,
    }
    return node | changes


def _config(*nodes, edges=(("a", "b"),), **changes):
    nodes = nodes or (_node("a", None), _node("b", "a"))
    config = {
        "nodes": list(nodes),
        "edges": [{"from": source, "to": target} for source, target in edges],
        "input_nodes": ["a"],
        "output_node": nodes[-1]["name"],
        "input_shape": [3, 5, 7],
        "num_timesteps": 22,
    }
    return copy.deepcopy(config | changes)


def test_every_supported_module_is_read():
    cell = {"name": "LSTMCell", "out_channels": 4, "ksize": 2, "layernorm": True, "forget_bias": 1.0}
    decay = {"name": "TimeDecayRecurrentCell", "tau": 0.3, "trainable": True}
    pool = {"name": "MaxPool", "ksize": 2, "stride": 2, "padding": 0, "ceil_mode": True}
    average = {"name": "AdaptiveAvgPool", "output_size": [1, 1], "flatten": True}
    dense = {"name": "FullyConnected", "out_channels": 9, "bias": 0.1, "activation": None, "dropout": 0.5}
    nodes = (
        _node("a", None, recurrent_cell=cell, post_memory=pool),
        _node("b", "a", recurrent_cell=decay, post_memory=average, residual=None),
        _node("c", "b", pre_memory=dense, harbor_policy={"name": "Identity"}, out_channels=9),
    )
    spec = read_graph(_config(*nodes, edges=(("a", "b"), ("b", "c"))))
    a, b, c = spec.nodes
    assert a.operation == Convolution(4, (3, 3), (1, 1), "same", activation=None)
    assert a.memory == Memory("lstm", (2, 2), layer_norm=True)
    assert a.pool == Pool("max", (2, 2), (2, 2), (0, 0), ceil_mode=True)
    assert b.memory == Memory("time-decay", tau=0.3)
    assert b.pool == Pool("average", (1, 1), flatten=True)
    assert c.operation == Dense(9, bias=0.1, dropout=0.5, activation=None)
    assert not c.resize
    assert spec.shapes()[1] == {"a": (4, 3, 4), "b": (4,), "c": (9,)}


def test_initialisers_are_honoured():
    pre = {"name": "Conv2dCell", "out_channels": 4, "ksize": 2, "init_dict": {"method": "orthogonal_", "gain": 3.0}}
    graph = TemporalGraph.from_config(_config(_node("a", None, pre_memory=pre), edges=()))
    weight = graph.node("a").operation.weight.detach().flatten(1)
    assert (weight @ weight.T).diagonal().tolist() == pytest.approx([9.0] * 4, rel=1e-4)


def test_what_leads_back_in_the_listed_order_is_feedback():
    spec = read_graph(_config(edges=(("a", "b"), ("b", "a"))))
    assert {(e.source, e.target): e.feedback for e in spec.edges} == {("a", "b"): False, ("b", "a"): True}


def test_without_cycles_nothing_is_feedback_whatever_the_listed_order():
    nodes = (_node("b", "a"), _node("a", None))
    spec = read_graph(_config(*nodes, output_node="b"))
    assert spec.order == ("a", "b")
    assert not any(edge.feedback for edge in spec.edges)


def test_ff_order_decides_what_is_feedback():
    nodes = (_node("b", "a"), _node("a", None))
    spec = read_graph(_config(*nodes, edges=(("a", "b"), ("b", "a")), output_node="b", ff_order=["a", "b"]))
    assert spec.order == ("a", "b")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pre_memory": {"name": "Conv3dCell"}}, "Unknown module in the pre-memory of 'b' 'Conv3dCell'; did you mean"),
        ({"recurrent_cell": {"name": "UGRNN"}}, "cell in the recurrent cell of 'b' 'UGRNN'; did you mean 'UGRNNCell'"),
        ({"harbor_policy": {"name": "RGC"}}, "Unknown harbor policy of node 'b' 'RGC'"),
        ({"post_memory": {"name": "ResidualAdd"}}, "'b' 'ResidualAdd'"),
        ({"gain": 2}, "unsupported key 'gain' in node 'b'"),
        ({"out_channels": 5}, "Node 'b' has out_channels 5, its pre-memory 4"),
        ({"residual": True}, r"'residual': True .*'b'; .*None"),
    ],
)
def test_an_unsupported_node_is_refused_in_one_sentence(change, message):
    with pytest.raises((DataError, UsageError), match=message):
        read_graph(_config(_node("a", None), _node("b", "a", **change)))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("batchnorm", 5, r"'batchnorm' in the pre-memory of 'a' .* 4; found 5"),
        ("batchnorm", True, r"'batchnorm' .*'a' .* 4; found True"),
        ("use_bias", "false", r"'use_bias' .*'a' must be True or False; received 'false'"),
        ("bias", float("nan"), r"'bias' .*'a' must be a finite number; received nan"),
        ("dropout", True, r"'dropout' .*'a' .*at least 0 and at most 1; received True"),
        ("dropout", -1, r"'dropout' .*'a' .*; received -1"),
        ("out_channels", "4", r"'out_channels' .*'a' .*whole number.*; received '4'"),
        ("batchnorm_timevary", True, r"'batchnorm_timevary': True .*'a'"),
        ("dilation", 2, "'dilation': 2"),
        ("ksize", "3", r"'ksize' .*'a' .*'3'"),
        ("padding", "reflect", "Unknown 'padding' in the pre-memory of 'a' 'reflect'"),
        ("stride", 2, "'same' keeps the grid and needs stride 1"),
        ("init_dict", {"method": "kaiming"}, "'kaiming'; did you mean 'kaiming_normal_'"),
        ("colour", 1, "unsupported key 'colour' in the pre-memory of 'a'"),
    ],
)
def test_an_unsupported_operation_is_refused_in_one_sentence(key, value, message):
    node = _node("a", None)
    node["pre_memory"] = node["pre_memory"] | {key: value}
    with pytest.raises((DataError, UsageError), match=message):
        read_graph(_config(node, edges=()))


@pytest.mark.parametrize(
    ("part", "module", "message"),
    [
        ("recurrent_cell", {"name": "TimeDecayRecurrentCell", "trainable": "false"}, "'trainable' .*'a' .*'false'"),
        ("recurrent_cell", {"name": "TimeDecayRecurrentCell", "tau": "0.5"}, "'tau' .*'a' .*finite number.*'0.5'"),
        ("recurrent_cell", {"name": "TimeDecayRecurrentCell", "tau": float("nan")}, "'tau' .*'a' .*received nan"),
        ("recurrent_cell", {"name": "UGRNNCell", "ksize": 2, "layernorm": "no"}, "'layernorm' .*'a' .*'no'"),
        ("post_memory", {"name": "AdaptiveAvgPool", "flatten": "no"}, "'flatten' .*'a' .*'no'"),
        ("post_memory", {"name": "MaxPool", "ksize": 2, "ceil_mode": "false"}, "'ceil_mode' .*'a' .*'false'"),
    ],
)
def test_values_of_another_type_are_refused(part, module, message):
    with pytest.raises((DataError, UsageError), match=message):
        read_graph(_config(_node("a", None, **{part: module}), edges=()))


def test_a_dense_layer_has_the_batch_norm_that_is_asked_for():
    def read(norm):
        dense = {"name": "FullyConnected", "out_channels": 4, "batchnorm": norm}
        return read_graph(_config(_node("a", None, pre_memory=dense), edges=())).nodes[0].operation.batch_norm

    assert [read(norm) for norm in (None, False, True, 4)] == [False, False, True, True]
    for norm in (99, 0, "no"):
        with pytest.raises(DataError, match=r"'batchnorm' .*'a' .* 4; found"):
            read(norm)


@pytest.mark.parametrize("key", ["nodes", "edges", "input_nodes", "output_node", "input_shape"])
def test_a_missing_key_is_named(key):
    config = _config()
    del config[key]
    with pytest.raises(DataError, match=f"lacks '{key}' in"):
        read_graph(config)


@pytest.mark.parametrize("edges", [1.5, None, [3], "x"])
def test_edges_of_another_kind_are_refused(edges):
    with pytest.raises(DataError, match=r"edge|graph configuration"):
        read_graph({"nodes": [], "input_nodes": [], "output_node": "a", "input_shape": [3, 5, 7], "edges": edges})


def test_several_outputs_are_refused():
    with pytest.raises(UsageError, match=r"'output_node' .*must be a text; received \['a', 'b'\]"):
        read_graph(_config(output_node=["a", "b"]))


def test_an_incomplete_order_is_refused():
    with pytest.raises(DataError, match=r"'ff_order' .*\['a', 'b'\]"):
        read_graph(_config(ff_order=["a"]))


def _toml(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + "}"
    return json.dumps(value)


def test_a_file_is_read_and_a_bad_one_named(tmp_path):
    good, bad = tmp_path / "good.json", tmp_path / "bad.json"
    good.write_text(json.dumps(_config()))
    bad.write_text("{")
    assert read_graph(good) == read_graph(_config())
    toml = tmp_path / "good.toml"
    lines = ['edges = [{from = "a", to = "b"}]', 'input_nodes = ["a"]', 'output_node = "b"', "input_shape = [3, 5, 7]"]
    for node in _config()["nodes"]:
        lines += ["[[nodes]]", *(f"{key} = {_toml(value)}" for key, value in node.items() if value is not None)]
    toml.write_text("\n".join(lines))
    assert read_graph(toml) == read_graph(_config())
    with pytest.raises(DataError, match=r"bad\.json' .*JSON"):
        read_graph(bad)
    with pytest.raises(DataError, match=r"/none\.json'"):
        read_graph(tmp_path / "none.json")


NORMED = {"name": "Conv2dCell", "out_channels": 4, "ksize": 3, "padding": 1, "activation": "ReLU", "batchnorm": 4}
POOLED = {
    "name": "Sequential",
    "list_of_func_kwargs": [
        {"name": "MaxPool", "ksize": 2, "stride": 1},
        {"name": "Identity"},
        {"name": "AdaptiveAvgPool", "output_size": [2, 2]},
        {"name": "FullyConnected", "out_channels": 6, "activation": "Tanh", "batchnorm": True},
    ],
}


def _chained(memory="IdentityCell"):
    cell = {"name": memory} | ({"tau": 0.5, "trainable": False} if memory != "IdentityCell" else {})
    node = _node("a", None, pre_memory=NORMED, recurrent_cell=cell, post_memory=POOLED)
    return TemporalGraph.from_config(_config(node, edges=(), addnet={"l0": {}}, sep_num=22))


def test_batch_norms_and_chains_have_the_names_of_pytorchtnn():
    norm = ["weight", "bias", "running_mean", "running_var", "num_batches_tracked"]
    last = "a._post_memory.sequential_mem.3"
    assert list(_chained("TimeDecayRecurrentCell").tnn_parameters()) == [
        *("a._pre_memory.conv.weight", "a._pre_memory.conv.bias", *(f"a._pre_memory.bn.{key}" for key in norm)),
        *(f"{last}.lin.weight", f"{last}.lin.bias", *(f"{last}.bn.{key}" for key in norm)),
        "a._recurrent_cell.tau",
    ]


def _by_hand(state, x, training):
    """The same node of PyTorch's own modules, step by step; returns outputs [B, T, 6] and the first running mean."""
    norms = nn.BatchNorm2d(4), nn.BatchNorm1d(6)
    last = "a._post_memory.sequential_mem.3."
    for norm, begin in zip(norms, ("a._pre_memory.", last), strict=True):
        norm.load_state_dict({key: state[f"{begin}bn.{key}"].clone() for key in norm.state_dict()})
        norm.train(training)
    outputs = []
    for t in range(x.shape[1]):
        y = functional.conv2d(x[:, t], state["a._pre_memory.conv.weight"], state["a._pre_memory.conv.bias"], padding=1)
        y = functional.adaptive_avg_pool2d(functional.max_pool2d(norms[0](y).relu(), 2, 1), 2).flatten(1)
        outputs.append(norms[1](functional.linear(y, state[f"{last}lin.weight"], state[f"{last}lin.bias"])).tanh())
    return torch.stack(outputs, 1), norms[0].running_mean


@pytest.mark.parametrize("training", [False, True])
@torch.no_grad()
def test_batch_norms_and_chains_compute_what_pytorch_does(training):
    graph, x = _chained().train(training), torch.randn(5, 3, 3, 5, 7)
    state = {name: torch.rand(value.shape).to(value.dtype) for name, value in graph.tnn_parameters().items()}
    graph.load_tnn_state(state)
    expected, mean = _by_hand(state, x, training)
    torch.testing.assert_close(graph(x), expected, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(graph.tnn_parameters()["a._pre_memory.bn.running_mean"], mean)
    # 27 weights of 4 kernels at 35 places, and a dense layer of 16 inputs.
    assert graph.multiply_adds() == 4 * 27 * 35 + 6 * 16


def test_a_time_constant_that_does_not_train_stays():
    graph = _chained("TimeDecayRecurrentCell").train()
    tau = graph.tnn_parameters()["a._recurrent_cell.tau"]
    assert not tau.requires_grad
    graph(torch.randn(4, 3, 3, 5, 7)).square().sum().backward()
    assert tau.grad is None
    assert graph.tnn_parameters()["a._pre_memory.conv.weight"].grad.any()


def test_a_chain_before_the_memory_is_refused():
    with pytest.raises(UsageError, match="pre-memory of 'a' 'Sequential'"):
        read_graph(_config(_node("a", None, pre_memory={"name": "Sequential"}), edges=()))
