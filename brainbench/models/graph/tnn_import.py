"""PyTorchTNN's graph configuration (JSON) as a :class:`~brainbench.models.graph.spec.GraphSpec`.

Everything a configuration says is either honoured or refused; nothing is skipped silently.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Annotated, Any, Literal

from brainbench.core.errors import DataError, brief, check_name, listing
from brainbench.core.limits import Limit, Share, check_value
from brainbench.core.reading.regular import readable
from brainbench.core.reading.texts import read_json, read_mapping
from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node, Operation, Pool

_MEMORIES: dict[str, Any] = {
    "TimeDecayRecurrentCell": "time-decay",
    "UGRNNCell": "ugrnn",
    "IntersectionRNNCell": "intersection",
    "GRUCell": "gru",
    "LSTMCell": "lstm",
}
_REQUIRED = object()
_Size = Annotated[int, Limit(least=1, most=10**6)]  # channels, features, rows or columns
_Margin = Annotated[int, Limit(least=0, most=10**6)]
_Sizes, _Margins = tuple[_Size, _Size], tuple[_Margin, _Margin]
# Keys that PyTorchTNN accepts and overwrites while it builds the graph.
_OVERWRITTEN = ("in_channels", "input_in_channels", "input_shape", "num_timesteps", "state_shape")


class _Section:
    """One JSON object whose keys are taken one by one; what remains at the end is refused."""

    def __init__(self, data: Any, where: str) -> None:
        if not isinstance(data, Mapping):
            raise DataError(f"The graph configuration needs an object for {where}; found {brief(data)}.")
        self.data = dict(data)
        self.where = where

    def take(self, key: str, default: Any = _REQUIRED, kind: Any = None) -> Any:
        """Remove a key and return its value, checked as a kind, or the default; without either, refuse."""
        if key not in self.data and default is _REQUIRED:
            raise DataError(f"The graph configuration lacks {key!r} in {self.where}.")
        value = self.data.pop(key, default)
        check_value(f"{key!r} in {self.where}", value, kind)
        return value

    def size(self, key: str, default: Any = _REQUIRED, kind: Any = _Sizes) -> Any:
        """Take a pair of whole numbers, of which one may stand for both, or what else the kind allows."""
        value = self.data.get(key, default)
        if type(value) is int:
            self.data[key] = (value, value)
        value = self.take(key, default, kind)
        return tuple(value) if isinstance(value, list) else value

    def only(self, **allowed: Any) -> None:
        """Take keys that must be absent or have the allowed value, or one of a tuple of them."""
        for key, values in allowed.items():
            choices = values if isinstance(values, tuple) else (values,)
            value = self.data.pop(key, choices[0])
            if value not in choices:
                raise DataError(
                    f"The graph configuration has {key!r}: {brief(value)} in {self.where}; only "
                    f"{choices[0]!r} is supported."
                )

    def done(self, *ignored: str) -> None:
        """Raise :class:`DataError` if keys are left that nobody took, the ``ignored`` ones aside."""
        left = [key for key in self.data if key not in ignored]
        if left:
            raise DataError(f"The graph configuration has the unsupported key {listing(left)} in {self.where}.")


def read_graph(source: Mapping[str, Any] | str | os.PathLike[str]) -> GraphSpec:
    """Build a graph description from a configuration or the path of its JSON or TOML file.

    TOML has no null: a key is left out instead, and an activation may be ``Identity``.

    Feedback is what leads back in ``ff_order`` if that is given, else in the listed order of the nodes; without cycles
    nothing is feedback. ``num_timesteps`` is not needed and ignored.
    """
    with readable("a graph" if isinstance(source, Mapping) else source, "graph configuration"):
        if isinstance(source, Mapping):
            return _graph(source)
        return _graph(read_mapping(source) if os.fspath(source).endswith(".toml") else read_json(source))


def _graph(source: Mapping[str, Any]) -> GraphSpec:
    config = _Section(source, "the top level")
    nodes = tuple(_node(item) for item in config.take("nodes"))
    ends = []
    for entry in config.take("edges"):
        edge = _Section(entry, "an edge")
        ends.append((str(edge.take("from")), str(edge.take("to"))))
        edge.done()
    inputs, output = tuple(config.take("input_nodes")), config.take("output_node", kind=str)
    shape, order = tuple(config.take("input_shape", kind=tuple[_Size, ...])), config.take("ff_order", None)
    # The number of steps is that of the stimulus; the decoder stands beside the graph.
    config.done("num_timesteps", "sep_num", "addnet")
    names = [node.name for node in nodes]
    if order is not None and sorted(order) != sorted(names):
        raise DataError(f"'ff_order' {order!r} must list every node once: {names!r}.")
    try:
        if order is None:
            TopologicalSorter({name: {source for source, target in ends if target == name} for name in names}).prepare()
            order = ()
    except CycleError:
        order = names
    # Without cycles nothing leads back; else what does not lead to a later node.
    rank = {name: index for index, name in enumerate(order)}
    feedback = {end for end in ends if rank and rank.get(end[0], -1) >= rank.get(end[1], len(rank))}
    edges = tuple(Edge(*end, feedback=end in feedback) for end in ends)
    return GraphSpec(nodes, edges, inputs, output, (*shape,))


def _node(entry: Any) -> Node:
    node = _Section(entry, "a node")
    name = str(node.take("name"))
    node.where = f"node {name!r}"
    node.only(residual=(None, False))
    channels = node.take("out_channels", kind=_Size)
    harbor = _Section(node.take("harbor_policy"), f"the harbor policy of {name!r}")
    policy = harbor.take("name")
    check_name(f"harbor policy of node {name!r}", policy, ("ResizeConcat", "Identity"))
    harbor.done(*_OVERWRITTEN)
    operation = _operation(_Section(node.take("pre_memory"), f"the pre-memory of {name!r}"))
    memory = _memory(_Section(node.take("recurrent_cell"), f"the recurrent cell of {name!r}"))
    activation, pool, chain = _after(_Section(node.take("post_memory"), f"the post-memory of {name!r}"))
    source, resize = node.take("shape_from", None), policy == "ResizeConcat"
    built = Node(name, operation, memory, activation, pool, chain, source, resize)
    node.done()
    field = {Convolution: "channels", Dense: "features"}.get(type(operation))
    if field is not None and getattr(operation, field) != channels:
        raise DataError(f"Node {name!r} has out_channels {channels}, its pre-memory {getattr(operation, field)}.")
    return built


def _operation(part: _Section) -> Convolution | Dense | None:
    kind = part.take("name")
    if kind == "Identity":
        part.done(*_OVERWRITTEN)
        return None
    check_name(f"module in {part.where}", kind, ("Conv2dCell", "FullyConnected", "Identity"))
    common = {
        "use_bias": part.take("use_bias", True, bool),
        "bias": part.take("bias", None, float | None),
        "dropout": part.take("dropout", 0.0, Share),
        # Left out, PyTorchTNN's dense layers rectify and its convolutions do not.
        "activation": part.take("activation", "ReLU" if kind == "FullyConnected" else None),
        "initialiser": _initialiser(part),
    }
    part.only(activation_func_kwargs=({}, None), batchnorm_timevary=False)
    channels = part.take("out_channels", kind=_Size)
    norm = part.take("batchnorm", None)
    # PyTorchTNN's dense layers ask whether there is one, its convolutions how many channels it has.
    common["batch_norm"] = norm is not None and norm is not False
    whole = type(norm) is int and norm == channels
    if common["batch_norm"] and not whole and not (norm is True and kind == "FullyConnected"):
        raise DataError(f"'batchnorm' in {part.where} must be false or the channels, {channels}; found {brief(norm)}.")
    if kind == "FullyConnected":
        operation: Convolution | Dense = Dense(channels, **common)
    else:
        padding = part.size("padding", 0, Literal["same", "valid"] | _Margins)
        part.only(dilation=1, groups=1, padding_mode="zeros")
        operation = Convolution(channels, part.size("ksize"), part.size("stride", 1), padding, **common)
    part.done(*_OVERWRITTEN)
    return operation


def _initialiser(part: _Section) -> Mapping[str, Any] | None:
    from brainbench.models.ops.layers import INITIALISERS

    options = part.take("init_dict", None)
    if options is None:
        return None
    method = _Section(options, f"'init_dict' of {part.where}").take("method")
    check_name(f"initialiser in {part.where}", method, INITIALISERS)
    return dict(options)


def _memory(part: _Section) -> Memory | None:
    kind = part.take("name")
    if kind == "IdentityCell":
        part.done(*_OVERWRITTEN, "out_channels")
        return None
    check_name(f"cell in {part.where}", kind, ("IdentityCell", *_MEMORIES))
    part.only(init_dict=None)
    if kind == "TimeDecayRecurrentCell":
        memory = Memory("time-decay", tau=part.take("tau", 0.0, float), trainable=part.take("trainable", True, bool))
    else:
        part.only(stride=1, padding="same", dilation=1, groups=1, padding_mode="zeros")
        part.only(use_bias=True, forget_bias=1.0, activation="Tanh", activation_func_kwargs={})
        # Only the initial value of a bias that load_tnn_state or training replaces.
        part.only(bias=(None, 0, 0.0))
        memory = Memory(_MEMORIES[kind], part.size("ksize"), part.take("layernorm", False, bool))
    part.done(*_OVERWRITTEN, "out_channels")
    return memory


def _after(part: _Section) -> tuple[str | None, Pool | None, tuple[str | Pool | Operation, ...]]:
    if part.data.get("name") != "Sequential":
        return (*_layer(part), ())
    part.take("name")
    chain: list[str | Pool | Operation] = []
    for index, entry in enumerate(part.take("list_of_func_kwargs")):
        step = _Section(entry, f"step {index} of {part.where}")
        parts = [_operation(step)] if step.data.get("name") in ("Conv2dCell", "FullyConnected") else _layer(step)
        # Every step keeps its place, from which the names of its parameters are made.
        chain.append(next((value for value in parts if value is not None), "identity"))
    part.done(*_OVERWRITTEN, "out_channels")
    return None, None, tuple(chain)


def _layer(part: _Section) -> tuple[str | None, Pool | None]:
    kind = part.take("name")
    kinds = ("ActivationLayer", "MaxPool", "AdaptiveAvgPool", "Identity", "Sequential")
    check_name(f"module in {part.where}", kind, kinds)
    activation, pool = None, None
    if kind == "ActivationLayer":
        activation = part.take("activation", "ReLU")
        part.only(activation_func_kwargs=({}, None))
    elif kind == "MaxPool":
        size, stride = part.size("ksize"), part.size("stride", None, _Sizes | None)
        part.only(dilation=1, return_indices=False)
        pool = Pool("max", size, stride, part.size("padding", 0, _Margins), part.take("ceil_mode", False, bool))
    elif kind == "AdaptiveAvgPool":
        pool = Pool("average", part.size("output_size", 6), flatten=part.take("flatten", False, bool))
    part.done(*_OVERWRITTEN)
    return activation, pool
