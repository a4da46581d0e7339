"""Temporal graphs: networks with feedback, unrolled over time.

Two unrollings of the same weights. ``biological``: every connection takes one step, so a stimulus
climbs one area per step (Nayebi et al. 2018). ``full``: feedforward connections act within the step and
only feedback is delayed. Nodes whose inputs have not arrived yet receive zeros; their biases still act.

A connection that takes a step makes two cones: what the stimulus has not reached yet, and what no later answer reads.
Steps in the first are the same for every stimulus and computed once; steps in the second are left out.

Letters: B batch, T step, (C, H, W) one step of the stimulus or of a node.
"""

from __future__ import annotations

import logging
import math
import os
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError, check_each, check_name
from brainbench.models.cells import CELLS, Cell, GatedCell, IntersectionRNN, TimeDecay
from brainbench.models.graph.spec import (
    UNROLLS,
    Convolution,
    Dense,
    GraphSpec,
    Memory,
    Node,
    Operation,
    Pool,
    Shape,
    Unroll,
)
from brainbench.models.graph.tnn_import import read_graph
from brainbench.models.ops import dispatch
from brainbench.models.ops.dispatch import DeferredNormGrad, DeferredWeightGrad
from brainbench.models.ops.layers import RECTIFIER_GAIN, Conv2d, Linear, activation, check_named, copy_named
from brainbench.models.parts import multiply_adds, wanted

# Bilinear with antialiasing: a smaller grid averages what lies between its places instead of skipping it.
_RESIZED: dict[str, Any] = {"mode": "bilinear", "align_corners": False, "antialias": True}


class NodeModule(nn.Module):
    """Operation, memory, activation and pool of one node."""

    def __init__(self, node: Node, shape: Shape) -> None:
        super().__init__()
        self.node = node
        self.grid = shape[1:]
        self.operation, channels = _operation(node.operation, shape)
        self.memory = _memory(node.memory, channels)
        self.dropout = nn.Dropout(node.operation.dropout if node.operation is not None else 0.0)
        stages = node.stages(shape)
        self.before = _normed(node.operation, channels)
        steps = [_step(step, before) for step, before in zip(node.chain, stages[1:], strict=False)]
        self.after = nn.Sequential(activation(node.activation), *_pool(node.pool), *steps)
        self.steps: tuple[nn.Module, ...] = tuple(steps)
        """Modules of the chain."""

    def resized(self, inputs: list[torch.Tensor]) -> list[torch.Tensor]:
        """Return the inputs [B, C, H, W] on the node's grid."""
        size = self.grid
        return [x if x.shape[2:] == size else functional.interpolate(x, size=size, **_RESIZED) for x in inputs]

    def operate(self, inputs: list[torch.Tensor]) -> torch.Tensor:
        """Join the resized inputs on channels and operate on them; return what the memory sees [B, ...]."""
        inputs = self.resized(inputs)
        # Kernels join the inputs while they read them; dropout needs them joined before.
        if isinstance(self.operation, Conv2d) and not (self.training and self.dropout.p):
            return self.before(dispatch.conv_concat(self.operation, inputs))
        x = self.dropout(inputs[0] if len(inputs) == 1 else torch.cat(inputs, 1))
        return self.before(self.operation(x.flatten(1) if isinstance(self.operation, Linear) else x))


def _normed(what: Operation | None, channels: int) -> nn.Module:
    """Build what follows an operation: batch norm, if it has one, and its activation."""
    last = activation(what.activation if what is not None else None)
    if what is None or not what.batch_norm:
        return last
    norm = nn.BatchNorm1d(channels) if isinstance(what, Dense) else nn.BatchNorm2d(channels)
    return nn.Sequential(norm, last)


def _step(step: str | Pool | Operation, shape: Shape) -> nn.Module:
    if isinstance(step, str):
        return activation(step)
    if isinstance(step, Pool):
        return nn.Sequential(*_pool(step))
    operation, channels = _operation(step, shape)
    flat = [nn.Flatten()] if isinstance(step, Dense) else []
    return nn.Sequential(
        OrderedDict(
            dropout=nn.Dropout(step.dropout),
            flat=nn.Sequential(*flat),
            operation=operation,
            before=_normed(step, channels),
        )
    )


def _operation(what: Operation | None, shape: Shape) -> tuple[nn.Module, int]:
    """Build an operation for its concatenated input shape; return it with its output channels."""
    if what is None:
        return nn.Identity(), shape[0]
    options: dict[str, Any] = {"use_bias": what.use_bias, "bias": what.bias, "method": what.initialiser}
    if isinstance(what, Convolution):
        options |= {"kernel_size": what.kernel_size, "stride": what.stride, "padding": what.padding}
        return Conv2d(shape[0], what.channels, **options), what.channels
    assert isinstance(what, Dense)
    # Gain √2 as for convolutions (He et al. 2015), since a rectifier follows.
    return Linear(math.prod(shape), what.features, gain=RECTIFIER_GAIN, **options), what.features


def _memory(memory: Memory | None, channels: int) -> Cell | None:
    if memory is None:
        return None
    if memory.kind == "time-decay":
        return TimeDecay(channels, channels, tau=memory.tau, layer_norm=memory.layer_norm, trainable=memory.trainable)
    return CELLS[memory.kind](channels, channels, kernel_size=memory.kernel_size, layer_norm=memory.layer_norm)


def _pool(pool: Pool | None) -> list[nn.Module]:
    if pool is None:
        return []
    if pool.kind == "max":
        layer: nn.Module = nn.MaxPool2d(pool.size, pool.stride, pool.padding, ceil_mode=pool.ceil_mode)
    else:
        layer = nn.AdaptiveAvgPool2d(pool.size)
    return [layer, nn.Flatten()] if pool.flatten else [layer]


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GraphState:
    """State of a graph between two steps."""

    outputs: Mapping[str, torch.Tensor]
    """Last output of every node [B, ...]."""
    memories: Mapping[str, torch.Tensor]
    """State of every cell [B, ...]."""


class TemporalGraph(nn.Module):
    """A network of areas with feedforward and feedback connections.

    Args:
        spec: The graph. ``spec.input_shape`` (C, H, W) is what every step of the stimulus must have.

    ``layers`` lists the nodes in feedforward order, ``shapes`` what each gives at one step; :meth:`step` streams,
    :meth:`forward` takes a sweep.
    """

    def __init__(self, spec: GraphSpec) -> None:
        super().__init__()
        self._fixed_shape = True
        self._open_grid = False
        self.spec = spec
        self.layers: tuple[str, ...] = spec.order
        inputs, self.shapes = spec.shapes()
        self.nodes = nn.ModuleDict({name: NodeModule(spec.by_name[name], inputs[name]) for name in spec.order})

    @classmethod
    def from_config(
        cls, source: Mapping[str, Any] | str | os.PathLike[str], *, input_shape: tuple[int, int, int] | None = None
    ) -> TemporalGraph:
        """Build a graph from PyTorchTNN's configuration: a mapping or the path of a JSON or TOML file.

        ``input_shape`` (C, H, W) overrides the configuration's. PyTorchTNN's published files declare shapes that its
        callers override, so without this argument the declared shape is a default: :meth:`load_tnn_state` gives it up
        if the weights were made for another.
        """
        spec = read_graph(source)
        graph = cls(spec if input_shape is None else replace(spec, input_shape=tuple(input_shape)))
        graph._fixed_shape = input_shape is not None
        return graph

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """(C, H, W) of one step of the stimulus."""
        return self.spec.input_shape

    @property
    def features(self) -> int:
        """Number of output values of one step."""
        return math.prod(self.shapes[self.spec.output])

    @property
    def latency(self) -> int:
        """Steps of the biological unrolling before the stimulus can show in the output."""
        return self.spec.first_response()[self.spec.output]

    @property
    def receptive_field(self) -> int | None:
        """Steps of the biological unrolling that the output can depend on; None: all so far."""
        return self.spec.receptive_field()

    def load_tnn_state(self, state: Mapping[str, Any]) -> None:
        """Load arrays or tensors under PyTorchTNN's names, ``<node>._pre_memory.conv.weight`` and so on."""
        resized = {} if self._fixed_shape else self._resized_by(state)
        shapes = {name: tuple(value.shape) for name, value in self.tnn_parameters().items()} | resized
        check_named(shapes, state, what="this graph")
        if resized:
            _log.warning(
                "These weights were not made for the stimulus shape %s of the configuration; the shape is taken "
                "from the first stimulus instead.",
                list(self.input_shape),
            )
            for _, key, operation in self._weighted():
                if shape := resized.get(key):
                    operation.weight = nn.Parameter(operation.weight.new_empty(shape))
                    setattr(operation, "in_features" if len(shape) == 2 else "in_channels", shape[1])
            # The grid shows in the weights only as a product, so it stays open until a stimulus arrives.
            self._open_grid = True
        copy_named(self.tnn_parameters(), state)

    def tnn_parameters(self) -> dict[str, torch.Tensor]:
        """Return the parameters, and the running averages of batch norms, under PyTorchTNN's names."""
        renamed: dict[str, torch.Tensor] = {}
        for name, node in self.named_nodes():
            renamed |= _tnn_operation(f"{name}._pre_memory", node.operation, node.before)
            for index, step in enumerate(node.steps):
                if isinstance(operation := getattr(step, "operation", None), (Conv2d, Linear)):
                    owner = f"{name}._post_memory.sequential_mem.{index}"
                    renamed |= _tnn_operation(owner, operation, step.get_submodule("before"))
            if node.memory is not None:
                cell = node.memory.tnn_parameters()
                renamed.update({f"{name}._recurrent_cell.{key}": value for key, value in cell.items()})
        return renamed

    def _resized_by(self, state: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
        """Return the weights in ``state`` that differ from ours only as another stimulus shape would make them."""
        resized = {}
        for name, key, operation in self._weighted():
            if key in state and (isinstance(operation, Linear) or name in self.spec.inputs):
                new, old = tuple(state[key].shape), tuple(operation.weight.shape)
                # Another stimulus changes axis 1 alone: the inputs of dense layers and of nodes that see the stimulus.
                if new != old and len(new) == len(old) and new[:1] + new[2:] == old[:1] + old[2:]:
                    resized[key] = new
        return resized

    def _weighted(self) -> Iterator[tuple[str, str, Conv2d | Linear]]:
        """Yield the name of each node with weights, PyTorchTNN's name of them, and their layer."""
        for name, node in self.named_nodes():
            if isinstance(node.operation, (Conv2d, Linear)):
                kind = "lin" if isinstance(node.operation, Linear) else "conv"
                yield name, f"{name}._pre_memory.{kind}.weight", node.operation

    def _accept(self, shape: Shape) -> None:
        """Check one step's shape (C, H, W) against the graph; an open grid takes it on."""
        if not self._open_grid:
            if shape != self.input_shape:
                raise UsageError(
                    f"This graph expects steps of shape [channels, rows, columns] = {list(self.input_shape)}; "
                    f"received {list(shape)}."
                )
            return
        spec = replace(self.spec, input_shape=shape)
        inputs, outputs = spec.shapes()
        for name, _, operation in self._weighted():
            needed = math.prod(inputs[name]) if isinstance(operation, Linear) else inputs[name][0]
            if needed != operation.weight.shape[1]:
                raise UsageError(
                    f"The loaded weights do not fit steps of shape {list(shape)}: node {name!r} would receive "
                    f"{needed} values and has weights for {operation.weight.shape[1]}."
                )
        for name, node in self.named_nodes():
            node.grid = inputs[name][1:]
        self.spec, self.shapes, self._open_grid = spec, outputs, False

    def multiply_adds(self) -> int:
        """Return the multiply-adds of matrix products and convolutions in one step of one stimulus."""
        return multiply_adds(self, *self.input_shape)

    def init_state(self, batch: int) -> GraphState:
        """Return the state before the first step: silent nodes and empty memories, all zeros."""
        if self._open_grid:
            raise UsageError("The stimulus shape is still open; pass input_shape to TemporalGraph.from_config.")
        like = next(self.parameters())
        outputs = {name: like.new_zeros(batch, *self.shapes[name]) for name in self.layers}
        memories = {
            name: node.memory.initial_state(batch, *self.memory_grid(name))
            for name, node in self.named_nodes()
            if node.memory is not None
        }
        return GraphState(outputs, memories)

    def memory_grid(self, name: str) -> Shape:
        """Return the grid on which a node remembers, which is that of what its operation gives."""
        node = self.spec.by_name[name]
        shape = (1, *self.node(name).grid)
        return (node.operation.output_shape(shape) if node.operation is not None else shape)[1:]

    def node(self, name: str) -> NodeModule:
        """Return the module of a node."""
        return cast(NodeModule, self.nodes[name])

    def step(
        self, x: torch.Tensor, state: GraphState, *, unroll: Unroll = "biological"
    ) -> tuple[torch.Tensor, GraphState]:
        """Advance by one step of the stimulus [B, C, H, W]; return the output [B, ...] and the next state.

        Equals :meth:`forward` step by step.
        """
        check_name("unrolling", unroll, UNROLLS)
        self._accept(tuple(x.shape[1:]))
        outputs: dict[str, torch.Tensor] = {}
        memories: dict[str, torch.Tensor] = {}
        for name in self.layers:
            inputs = [x] if name in self.spec.inputs else []
            for edge in self.spec.predecessors[name]:
                # In the biological unrolling every connection takes one step; else feedback alone does.
                delayed = unroll == "biological" or edge.feedback
                inputs.append((state.outputs if delayed else outputs)[edge.source])
            outputs[name] = self.advance(name, self.node(name).operate(inputs), state.memories, memories)
        return outputs[self.spec.output], GraphState(outputs, memories)

    def advance(
        self, name: str, x: torch.Tensor, before: Mapping[str, torch.Tensor], after: dict[str, torch.Tensor]
    ) -> torch.Tensor:
        """Return a node's output [B, ...] for what its operation gave; read and write its memory's state by name."""
        node = self.node(name)
        if node.memory is not None:
            x, after[name] = node.memory(x, before.get(name))
        return node.after(x)

    def forward(
        self,
        x: torch.Tensor,
        unroll: Unroll = "biological",
        return_activations: bool | Collection[str] = False,
        *,
        last: bool = False,
    ) -> Any:
        """Process a sweep [B, T, C, H, W].

        Only what the answer reads is computed and kept: steps whose effect comes too late are left out, and steps that
        the stimulus has not reached are computed for one stimulus and shared.

        Returns:
            The outputs [B, T, ...] or, with ``last``, those of the last step [B, ...]; with ``return_activations``
            (True for every node, or names) also ``{node: [B, T, ...]}``.
        """
        check_name("unrolling", unroll, UNROLLS)
        returned = set(wanted(self.layers, return_activations))
        check_each("node", returned, self.layers)
        if x.ndim != 5 or x.shape[1] < 1:
            raise UsageError(f"A graph takes [batch, time, channels, rows, columns]; received {list(x.shape)}.")
        self._accept(tuple(x.shape[2:]))
        if x.is_cuda:
            # Tensor cores and norms over channels both want channels innermost.
            x = x.flatten(0, 1).to(memory_format=torch.channels_last).unflatten(0, x.shape[:2])
        output = self.spec.output
        whole, final = (returned, {output}) if last else (returned | {output}, set())
        if self.training and any(isinstance(m, (nn.BatchNorm1d, nn.BatchNorm2d)) for m in self.modules()):
            outputs = self._stepwise(x, unroll, whole | final)
        else:
            steps = needed_steps(self.spec, unroll, x.shape[1], whole=whole, last=final)
            outputs = UnrolledSweep(self, x, unroll, steps).run(whole | final)
        y = outputs[output][1]
        y = y[:, -1] if last else y
        if return_activations is False:
            return y
        return y, {name: outputs[name][1] for name in self.layers if name in returned}

    def _stepwise(self, x: torch.Tensor, unroll: Unroll, names: set[str]) -> dict[str, tuple[int, torch.Tensor]]:
        """Compute every step of every node in turn: each batch norm then sees one step of all stimuli, as published."""
        state, outputs = self.init_state(len(x)), {name: [] for name in names}
        for t in range(x.shape[1]):
            _, state = self.step(x[:, t], state, unroll=unroll)
            for name in names:
                outputs[name].append(state.outputs[name])
        return {name: (0, torch.stack(values, 1)) for name, values in outputs.items()}

    def activations(self, x: torch.Tensor, layers: Collection[str] | None = None) -> dict[str, torch.Tensor]:
        """Return ``{node: [B, T, ...]}`` of the biological unrolling for the nodes asked for (all by default)."""
        return self(x, return_activations=True if layers is None else tuple(layers))[1]

    def named_nodes(self) -> list[tuple[str, NodeModule]]:
        """Return the names and modules of the nodes in feedforward order."""
        return [(name, self.node(name)) for name in self.layers]


def _tnn_operation(owner: str, operation: nn.Module, after: nn.Module) -> dict[str, torch.Tensor]:
    """Return the entries of an operation and of the batch norm after it under PyTorchTNN's names."""
    kind = "lin" if isinstance(operation, Linear) else "conv"
    entries: dict[str, torch.Tensor] = {f"{owner}.{kind}.{key}": value for key, value in operation.named_parameters()}
    norm = after[0].state_dict(keep_vars=True) if isinstance(after, nn.Sequential) else {}
    return entries | {f"{owner}.bn.{key}": value for key, value in norm.items()}


def needed_steps(
    spec: GraphSpec, unroll: Unroll, steps: int, *, whole: Collection[str], last: Collection[str]
) -> dict[str, tuple[int, int]]:
    """Return for every node the steps (first, stop) of a sweep of ``steps`` to compute; stop 0 if none.

    Of the nodes in ``whole`` every step is wanted, of those in ``last`` the last one. A node that remembers, or feeds
    back on itself, is computed from the first step on.
    """
    delay = spec.delays(unroll)
    first = {node.name: steps for node in spec.nodes}
    stop = {node.name: 0 for node in spec.nodes}
    for names, start in ((last, steps - 1), (whole, 0)):
        for name in names:
            first[name], stop[name] = min(first[name], start), steps
    looped = {name for group in spec.groups if len(group) > 1 for name in group}
    looped |= {edge.source for edge in spec.edges if edge.source == edge.target}
    # Backwards to a fixed point: a step of a node needs the step of its source that lies one delay before.
    changed = True
    while changed:
        changed = False
        for name in reversed(spec.order):
            if stop[name] and first[name] and (spec.by_name[name].memory is not None or name in looped):
                first[name], changed = 0, True
            for edge in spec.predecessors[name]:
                lag = delay[edge.source, name]
                begin, end = max(first[name] - lag, 0), stop[name] - lag
                if end > 0 and (begin < first[edge.source] or end > stop[edge.source]):
                    first[edge.source] = min(first[edge.source], begin)
                    stop[edge.source] = max(stop[edge.source], end)
                    changed = True
    return {name: (first[name], stop[name]) if stop[name] else (0, 0) for name in first}


class UnrolledSweep:
    """One sweep through a graph. Kept outputs are (first step, [B, steps, ...])."""

    def __init__(
        self, graph: TemporalGraph, x: torch.Tensor, unroll: Unroll, steps: Mapping[str, tuple[int, int]]
    ) -> None:
        self.graph, self.x, self.steps = graph, x, steps
        self.batch = len(x)
        self.delay = graph.spec.delays(unroll)
        # Dropout gives every stimulus its own mask, so no step can be computed once and shared.
        random = graph.training and any(isinstance(part, nn.Dropout) and part.p > 0 for part in graph.modules())
        self.arrival = dict.fromkeys(graph.layers, 0) if random else graph.spec.first_response(unroll)
        self.kept: dict[str, tuple[int, torch.Tensor]] = {}

    def run(self, wanted: Collection[str]) -> dict[str, tuple[int, torch.Tensor]]:
        """Compute every group of nodes in turn; drop what no later one reads."""
        groups = self.graph.spec.groups
        deferred = self._deferred() if torch.is_grad_enabled() and dispatch.usable(self.x) else ()
        with dispatch.deferring(deferred):
            for position, group in enumerate(groups):
                later = {name for other in groups[position + 1 :] for name in other}
                read = {e.source for name in later for e in self.graph.spec.predecessors[name]} | set(wanted)
                cyclic = any(edge.source in group for name in group for edge in self.graph.spec.predecessors[name])
                if cyclic:
                    self._loop(group, read)
                elif self.steps[group[0]][1]:
                    self._sweep(group[0])
                for name in [name for name in self.kept if name not in read]:
                    del self.kept[name]
        return self.kept

    def _deferred(self) -> Iterator[tuple[nn.Module, Any]]:
        """Yield convolutions and cells, each with the place where it leaves what its gradients need."""
        for name, node in self.graph.named_nodes():
            first, stop = self.steps[name]
            operation, memory = node.operation, node.memory
            if stop == first:
                continue
            stimuli = self.batch * (stop - first)
            if isinstance(operation, Conv2d) and dispatch.knows(operation, self.x):
                yield operation, DeferredWeightGrad(operation, node.grid, stimuli)
            if isinstance(memory, GatedCell):
                grid = self.graph.memory_grid(name)
                for conv in [part for part in memory.modules() if isinstance(part, Conv2d)]:
                    yield conv, DeferredWeightGrad(conv, grid, stimuli)
            if isinstance(memory, IntersectionRNN):
                yield memory, DeferredNormGrad(memory.gate_norms)

    def _window(self, source: str, first: int, stop: int) -> torch.Tensor:
        """Return the outputs of a node at steps first to stop [B, stop − first, ...]; before its first step, zeros."""
        start, values = self.kept.get(source, (0, self.x.new_zeros(self.batch, 0, *self.graph.shapes[source])))
        # Before the first step every node is silent: zeros, as in a stream from the empty state.
        missing = max(0, -first)
        part = values[:, max(first, 0) - start : max(stop, 0) - start]
        if not missing:
            return part
        return torch.cat((part.new_zeros(self.batch, min(missing, stop - first), *values.shape[2:]), part), 1)

    def _sweep(self, name: str) -> None:
        """Compute a node outside every loop: all steps at once, but for its recurrence."""
        graph = self.graph
        node, (first, stop) = graph.node(name), self.steps[name]
        count = stop - first
        inputs = [self.x[:, first:stop].flatten(0, 1)] if name in graph.spec.inputs else []
        for edge in graph.spec.predecessors[name]:
            lag = self.delay[edge.source, name]
            inputs.append(self._window(edge.source, first - lag, stop - lag).flatten(0, 1))
        y = node.operate(inputs)
        if node.memory is not None:
            # What depends on the input alone is computed for all steps at once, and the loop holds only the recurrence.
            projected = node.memory.project(y)
            rows = [part.unflatten(0, (self.batch, count)) for part in (y, *projected)]
            # Nodes with a memory are computed from step 0 on (needed_steps), so the empty state is the right one here.
            state, outputs = None, []
            for t in range(count):
                x, *shares = (row[:, t] for row in rows)
                output, state = node.memory(x, state, tuple(shares))
                outputs.append(output)
            y = torch.stack(outputs, 1).flatten(0, 1)
        self.kept[name] = first, node.after(y).unflatten(0, (self.batch, count))

    def _loop(self, group: tuple[str, ...], read: Collection[str]) -> None:
        """Compute nodes that feed back on one another step by step."""
        graph = self.graph
        # Before step 0 all nodes are silent for every stimulus, so one row of zeros stands for the batch.
        previous = {name: self.x.new_zeros(1, *graph.shapes[name]) for name in group}
        memories: dict[str, torch.Tensor] = {}
        history: dict[str, list[torch.Tensor]] = {name: [] for name in group if name in read}
        # Nodes of a loop need one another's last outputs, so time is the outer loop here.
        for t in range(max(self.steps[name][1] for name in group)):
            current: dict[str, torch.Tensor] = {}
            for name in group:
                if t >= self.steps[name][1]:
                    continue
                # What the stimulus has not reached yet is the same for all: one row stands for the batch.
                rows = self.batch if t >= self.arrival[name] else 1
                inputs = [_rows(self.x[:, t], rows)] if name in graph.spec.inputs else []
                for edge in graph.spec.predecessors[name]:
                    lag = self.delay[edge.source, name]
                    if edge.source in previous:
                        value = (previous if lag else current)[edge.source]
                    else:
                        value = self._window(edge.source, t - lag, t - lag + 1)[:, 0]
                    inputs.append(_rows(value, rows))
                if name in memories:
                    memories[name] = _rows(memories[name], rows)
                current[name] = graph.advance(name, graph.node(name).operate(inputs), memories, memories)
            previous = {**previous, **current}
            for name, outputs in history.items():
                if name in current:
                    outputs.append(current[name])
        for name, outputs in history.items():
            if outputs:
                self.kept[name] = 0, torch.stack([_rows(output, self.batch) for output in outputs], 1)


def _rows(values: torch.Tensor, rows: int) -> torch.Tensor:
    """Give one row to all, or take one of rows that are equal."""
    if len(values) == rows:
        return values
    return values[:1].expand(rows, *values.shape[1:])
