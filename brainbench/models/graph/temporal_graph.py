"""Temporal graphs: networks with feedback, unrolled over time.

Two unrollings of the same weights. ``biological``: every connection takes one step, so a stimulus
climbs one area per step (Nayebi et al. 2018). ``full``: feedforward connections act within the step and
only feedback is delayed. Nodes whose inputs have not arrived yet receive zeros; their biases still act.

Letters: B batch, T step, (C, H, W) one step of the stimulus or of a node.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import nn

from brainbench.core.errors import UsageError, unknown_name
from brainbench.models.cells import GatedCell, IntersectionRNN
from brainbench.models.graph.node import NodeModule
from brainbench.models.graph.spec import GraphSpec, Shape, Unroll, check_unroll
from brainbench.models.graph.tnn_config import read_graph
from brainbench.models.graph.tnn_state import check_named, copy_named
from brainbench.models.graph.unrolling import delays, needed_steps
from brainbench.models.ops import dispatch
from brainbench.models.ops.layers import Conv2d, Linear

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GraphState:
    """What a graph carries from one step to the next."""

    outputs: Mapping[str, torch.Tensor]
    """Last output of every node [B, ...]."""
    memories: Mapping[str, torch.Tensor]
    """State of every cell [B, ...]."""


class TemporalGraph(nn.Module):
    """A network of areas with feedforward and feedback connections.

    Args:
        spec: The graph. ``spec.input_shape`` (C, H, W) is what every step of the stimulus must have.

    ``layers`` lists the nodes in feedforward order; :meth:`step` streams, :meth:`forward` takes a sweep.
    """

    def __init__(self, spec: GraphSpec) -> None:
        super().__init__()
        self._fixed_shape = True
        self._open_grid = False
        self.spec = spec
        self.layers: tuple[str, ...] = spec.order
        inputs, self._shapes = spec.shapes()
        self.nodes = nn.ModuleDict({name: NodeModule(spec.by_name[name], inputs[name]) for name in spec.order})
        self._groups = spec.groups()
        self._predecessors = {name: spec.predecessors(name) for name in spec.order}

    @classmethod
    def from_config(
        cls,
        source: Mapping[str, Any] | str | os.PathLike[str],
        *,
        input_shape: tuple[int, int, int] | None = None,
    ) -> TemporalGraph:
        """Build a graph from PyTorchTNN's configuration: a mapping or the path of a JSON file.

        Args:
            source: The configuration.
            input_shape: (C, H, W) that overrides the configuration's. PyTorchTNN's published files
                declare shapes that its callers override, so without this argument the declared shape is
                a default: :meth:`load_tnn_state` gives it up if the weights were made for another.

        Raises:
            DataError: the file is missing or not JSON, or a key is missing or unsupported.
            UsageError: the graph is not valid.
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
        return math.prod(self._shapes[self.spec.output])

    @property
    def latency(self) -> int:
        """Steps of the biological unrolling before the stimulus can show in the output."""
        return self.spec.first_response()[self.spec.output]

    @property
    def receptive_field(self) -> int | None:
        """Steps of the biological unrolling that the output can depend on; None: all so far."""
        return self.spec.receptive_field()

    def load_tnn_state(self, state: Mapping[str, Any]) -> None:
        """Load arrays or tensors under PyTorchTNN's names, ``<node>._pre_memory.conv.weight`` and so on.

        Raises:
            DataError: names are missing or unexpected, or shapes differ; the graph is then unchanged.
        """
        resized = {} if self._fixed_shape else self._resized_by(state)
        shapes = {name: tuple(value.shape) for name, value in self.tnn_parameters().items()} | resized
        check_named(shapes, state, what="this graph")
        if resized:
            _log.warning(
                "These weights were not made for the stimulus shape %s of the configuration; the shape is taken "
                "from the first stimulus instead.",
                list(self.input_shape),
            )
            self._resize_operations(resized)
        copy_named(self.tnn_parameters(), state)

    def tnn_parameters(self) -> dict[str, torch.Tensor]:
        """Return the parameters under PyTorchTNN's names."""
        renamed: dict[str, torch.Tensor] = {}
        for name, node in self._items():
            renamed.update({f"{_tnn_owner(name, node)}.{key}": p for key, p in node.operation.named_parameters()})
            if node.memory is not None:
                cell = node.memory.tnn_parameters()
                renamed.update({f"{name}._recurrent_cell.{key}": value for key, value in cell.items()})
        return renamed

    def _resized_by(self, state: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
        """Return the weights in ``state`` that differ from ours only as another stimulus shape would make them."""
        resized = {}
        for name, node in self._items():
            key = f"{_tnn_owner(name, node)}.weight"
            follows = isinstance(node.operation, Linear) or name in self.spec.inputs
            if key in state and follows and isinstance(node.operation, (Conv2d, Linear)):
                new, old = tuple(state[key].shape), tuple(node.operation.weight.shape)
                if new != old and len(new) == len(old) and new[:1] + new[2:] == old[:1] + old[2:]:
                    resized[key] = new
        return resized

    def _resize_operations(self, resized: Mapping[str, tuple[int, ...]]) -> None:
        for name, node in self._items():
            shape = resized.get(f"{_tnn_owner(name, node)}.weight")
            if shape is not None and isinstance(node.operation, (Conv2d, Linear)):
                node.operation.weight = nn.Parameter(node.operation.weight.new_empty(shape))
                setattr(node.operation, "in_features" if len(shape) == 2 else "in_channels", shape[1])
        # The grid shows in the weights only as a product, so it stays open until a stimulus arrives.
        self._open_grid = True

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
        for name, node in self._items():
            if isinstance(node.operation, (Conv2d, Linear)):
                dense = isinstance(node.operation, Linear)
                needed = math.prod(inputs[name]) if dense else inputs[name][0]
                if needed != node.operation.weight.shape[1]:
                    raise UsageError(
                        f"The loaded weights do not fit steps of shape {list(shape)}: node {name!r} would receive "
                        f"{needed} values and has weights for {node.operation.weight.shape[1]}."
                    )
            node.grid = inputs[name][1:]
        self.spec, self._shapes, self._open_grid = spec, outputs, False

    def multiply_adds(self) -> int:
        """Return the multiply-adds of matrix products and convolutions in one step of one stimulus."""
        total = 0
        for name, node in self._items():
            places = math.prod(self._memory_grid(name))
            if isinstance(node.operation, (Conv2d, Linear)):
                total += node.operation.weight.numel() * places
            if node.memory is not None:
                total += sum(m.weight.numel() for m in node.memory.modules() if isinstance(m, Conv2d)) * places
        return total

    def init_state(
        self, batch: int, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> GraphState:
        """Return the state before the first step: silent nodes and empty memories, all zeros.

        Args:
            batch: B.
            device: Of the state; by default that of the weights.
            dtype: Of the state; by default that of the weights.

        Raises:
            UsageError: the shape of the stimulus is still open.
        """
        if self._open_grid:
            raise UsageError("The stimulus shape is still open; pass input_shape to TemporalGraph.from_config.")
        like = next(self.parameters())
        options = {"device": device or like.device, "dtype": dtype or like.dtype}
        outputs = {name: torch.zeros(batch, *self._shapes[name], **options) for name in self.layers}
        memories = {
            name: node.memory.initial_state(batch, *self._memory_grid(name), **options)
            for name, node in self._items()
            if node.memory is not None
        }
        return GraphState(outputs, memories)

    def _memory_grid(self, name: str) -> Shape:
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

        Raises:
            UsageError: the stimulus has another shape, or the unrolling is unknown.
        """
        check_unroll(unroll)
        if x.ndim != 4:
            raise UsageError(f"A step expects [batch, channels, rows, columns]; received {list(x.shape)}.")
        self._accept(tuple(x.shape[1:]))
        outputs: dict[str, torch.Tensor] = {}
        memories: dict[str, torch.Tensor] = {}
        for name in self.layers:
            inputs = [x] if name in self.spec.inputs else []
            for edge in self._predecessors[name]:
                delayed = unroll == "biological" or edge.feedback
                inputs.append((state.outputs if delayed else outputs)[edge.source])
            outputs[name] = self._advance(name, self.node(name).operate(inputs), state.memories, memories)
        return outputs[self.spec.output], GraphState(outputs, memories)

    def _advance(
        self,
        name: str,
        x: torch.Tensor,
        before: Mapping[str, torch.Tensor],
        after: dict[str, torch.Tensor],
    ) -> torch.Tensor:
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

        Args:
            x: The sweep.
            unroll: ``biological`` or ``full``.
            return_activations: True for every node, or the names of the nodes wanted.
            last: Return the output of the last step alone.

        Returns:
            The outputs [B, T, ...] or, with ``last``, [B, ...]; with ``return_activations`` also
            ``{node: [B, T, ...]}``.

        Raises:
            UsageError: the shape does not fit, or a node or unrolling does not exist.
        """
        check_unroll(unroll)
        wanted = self._wanted(return_activations)
        if x.ndim != 5 or x.shape[1] < 1:
            raise UsageError(
                f"A temporal graph expects [batch, time, channels, rows, columns]; received {list(x.shape)}."
            )
        self._accept(tuple(x.shape[2:]))
        if x.is_cuda:
            # Tensor cores and norms over channels both want channels innermost.
            x = x.flatten(0, 1).to(memory_format=torch.channels_last).unflatten(0, x.shape[:2])
        output = self.spec.output
        whole, final = (wanted, {output}) if last else (wanted | {output}, set())
        pass_ = _Pass(self, x, unroll, needed_steps(self.spec, unroll, x.shape[1], whole=whole, last=final))
        kept = pass_.run(whole | final)
        y = kept[output][1]
        y = y[:, -1] if last else y
        if return_activations is False:
            return y
        return y, {name: kept[name][1] for name in self.layers if name in wanted}

    def activations(self, x: torch.Tensor, layers: Collection[str] | None = None) -> dict[str, torch.Tensor]:
        """Return ``{node: [B, T, ...]}`` of the biological unrolling for the nodes asked for (all by default)."""
        return self(x, return_activations=True if layers is None else tuple(layers))[1]

    def _wanted(self, return_activations: bool | Collection[str]) -> set[str]:
        if isinstance(return_activations, bool):
            return set(self.layers) if return_activations else set()
        for name in return_activations:
            if name not in self.layers:
                raise unknown_name("node", name, self.layers)
        return set(return_activations)

    @property
    def _draws(self) -> bool:
        """Whether nodes draw random numbers, which every stimulus then needs for itself."""
        return self.training and any(node.dropout.p > 0 for _, node in self._items())

    def _items(self) -> list[tuple[str, NodeModule]]:
        return [(name, self.node(name)) for name in self.layers]


def _tnn_owner(name: str, node: NodeModule) -> str:
    return f"{name}._pre_memory.{'lin' if isinstance(node.operation, Linear) else 'conv'}"


class _Pass:
    """One sweep through a graph. Kept outputs are (first step, [B, steps, ...])."""

    def __init__(
        self, graph: TemporalGraph, x: torch.Tensor, unroll: Unroll, steps: Mapping[str, tuple[int, int]]
    ) -> None:
        self.graph, self.x, self.steps = graph, x, steps
        self.batch = len(x)
        self.delay = delays(graph.spec, unroll)
        self.arrival = dict.fromkeys(graph.layers, 0) if graph._draws else graph.spec.first_response(unroll)
        self.kept: dict[str, tuple[int, torch.Tensor]] = {}

    def run(self, wanted: Collection[str]) -> dict[str, tuple[int, torch.Tensor]]:
        """Compute every group of nodes in turn; drop what no later one reads."""
        if torch.is_grad_enabled() and dispatch.usable(self.x):
            from brainbench.models.ops.gates import recorded

            with recorded(self._tapes()):
                return self._run(wanted)
        return self._run(wanted)

    def _tapes(self) -> Iterator[tuple[nn.Module, Any]]:
        """Yield what convolutions and gates write down for their gradients."""
        from brainbench.models.ops.convolution import DeferredWeightGrad
        from brainbench.models.ops.gates import DeferredNormGrad

        for name, node in self.graph._items():
            first, stop = self.steps[name]
            operation, memory = node.operation, node.memory
            if stop == first:
                continue
            stimuli = self.batch * (stop - first)
            if isinstance(operation, Conv2d) and operation.fits(self.x):
                yield operation, DeferredWeightGrad(operation, node.grid, stimuli)
            if isinstance(memory, GatedCell):
                grid = self.graph._memory_grid(name)
                for conv in [part for part in memory.modules() if isinstance(part, Conv2d)]:
                    yield conv, DeferredWeightGrad(conv, grid, stimuli)
            if isinstance(memory, IntersectionRNN):
                yield memory, DeferredNormGrad([memory.norm(gate) for gate in memory.gates] if memory.norms else [])

    def _run(self, wanted: Collection[str]) -> dict[str, tuple[int, torch.Tensor]]:
        groups = self.graph._groups
        for position, group in enumerate(groups):
            later = {name for other in groups[position + 1 :] for name in other}
            read = {e.source for name in later for e in self.graph._predecessors[name]} | set(wanted)
            cyclic = any(edge.source in group for name in group for edge in self.graph._predecessors[name])
            if cyclic:
                self._loop(group, read)
            elif self.steps[group[0]][1]:
                self._sweep(group[0])
            for name in [name for name in self.kept if name not in read]:
                del self.kept[name]
        return self.kept

    def _window(self, source: str, first: int, stop: int) -> torch.Tensor:
        """Return the outputs of a node at steps first to stop [B, stop − first, ...]; before its first step, zeros."""
        start, values = self.kept.get(source, (0, self.x.new_zeros(self.batch, 0, *self.graph._shapes[source])))
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
        for edge in graph._predecessors[name]:
            lag = self.delay[edge.source, name]
            inputs.append(self._window(edge.source, first - lag, stop - lag).flatten(0, 1))
        y = node.operate(inputs)
        if node.memory is not None:
            projected = node.memory.project(y)
            rows = [part.unflatten(0, (self.batch, count)) for part in (y, *projected)]
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
        previous = {name: self.x.new_zeros(1, *graph._shapes[name]) for name in group}
        memories: dict[str, torch.Tensor] = {}
        history: dict[str, list[torch.Tensor]] = {name: [] for name in group if name in read}
        for t in range(max(self.steps[name][1] for name in group)):
            current: dict[str, torch.Tensor] = {}
            for name in group:
                if t >= self.steps[name][1]:
                    continue
                # What the stimulus has not reached yet is the same for all: one row stands for the batch.
                rows = self.batch if t >= self.arrival[name] else 1
                inputs = [_rows(self.x[:, t], rows)] if name in graph.spec.inputs else []
                for edge in graph._predecessors[name]:
                    lag = self.delay[edge.source, name]
                    if edge.source in previous:
                        value = (previous if lag else current)[edge.source]
                    else:
                        value = self._window(edge.source, t - lag, t - lag + 1)[:, 0]
                    inputs.append(_rows(value, rows))
                if name in memories:
                    memories[name] = _rows(memories[name], rows)
                current[name] = graph._advance(name, graph.node(name).operate(inputs), memories, memories)
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
