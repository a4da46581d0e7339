"""Unrolling of a graph over a sweep: which steps of which node are computed at all, and their computation.

A connection that takes a step makes two cones: what the stimulus has not reached yet, and what no later answer
reads. Steps before the first are the same for every stimulus; steps in the second are left out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from brainbench.models.cells import IntersectionRNN
from brainbench.models.cells.gated import GatedCell
from brainbench.models.graph.spec import GraphSpec, Unroll
from brainbench.models.ops import dispatch
from brainbench.models.ops.convolution import DeferredWeightGrad
from brainbench.models.ops.gates import DeferredNormGrad
from brainbench.models.ops.layers import Conv2d

if TYPE_CHECKING:
    from brainbench.models.graph.temporal_graph import TemporalGraph


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
        random = graph.training and any(node.dropout.p > 0 for _, node in graph.named_nodes())
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
                yield memory, DeferredNormGrad([memory.norm(gate) for gate in memory.gates] if memory.norms else [])

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
