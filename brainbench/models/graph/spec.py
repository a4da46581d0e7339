"""The description of a temporal graph: frozen, validated nodes and edges.

A node concatenates its inputs on channels, applies an operation, then a memory, an activation and a
pool. Shapes are (C, H, W), or (F,) after a dense operation. Importing this module imports no framework.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Literal

from brainbench.core.errors import UsageError, check_name, listing, repeats
from brainbench.core.limits import Count, Limit, Share, limited

Shape = tuple[int, ...]
Unroll = Literal["biological", "full"]
UNROLLS: tuple[Unroll, ...] = ("biological", "full")
Sizes = tuple[Count, Count]
"""Rows, columns."""
Margins = tuple[Annotated[int, Limit(least=0)], Annotated[int, Limit(least=0)]]
"""Rows, columns at every edge."""


@limited(kw_only=True)
class Operation:
    """Options that all operations share; one out of its range is a :class:`UsageError`."""

    use_bias: bool = True
    bias: float | None = 0.0
    """Initial bias; None draws it within 1/√fan_in."""
    dropout: Share = 0.0
    """Share dropped while training."""
    batch_norm: bool = False
    """Normalise each channel over the batch, before the activation; in training step by step."""
    activation: str | None = None
    """Applied before the memory."""
    initialiser: Mapping[str, Any] | None = None
    """``{"method": name in torch.nn.init, **options}``; None is the He-uniform of this package."""

    def output_shape(self, shape: Shape) -> Shape:
        """Return the shape of the output for an input (C, H, W) or (F,)."""
        raise NotImplementedError


@limited(of="{} of a convolution")
class Convolution(Operation):
    """2-D convolution of the concatenated inputs; a size out of its range is a :class:`UsageError`."""

    channels: Count
    kernel_size: Sizes = (2, 2)
    stride: Sizes = (1, 1)
    padding: Literal["same", "valid"] | Margins = "same"
    """Zeros at every edge (rows, columns); ``same`` keeps the grid, ``valid`` adds none."""

    def __post_init__(self) -> None:
        if not isinstance(self.padding, str):  # an array would be compared entry by entry
            object.__setattr__(self, "padding", tuple(map(int, self.padding)))
        elif self.padding == "same" and tuple(self.stride) != (1, 1):
            raise UsageError(f"Padding 'same' keeps the grid and needs stride 1; received {list(self.stride)}.")

    def output_shape(self, shape: Shape) -> Shape:
        """Return (C, H, W) for an input (C, H, W)."""
        if self.padding == "same":
            return (self.channels, *shape[1:])
        pads = (0, 0) if self.padding == "valid" else self.padding
        windows = zip(shape[1:], pads, self.kernel_size, self.stride, strict=True)
        return (self.channels, *((length + 2 * pad - size) // step + 1 for length, pad, size, step in windows))


@limited(of="{} of a dense layer")
class Dense(Operation):
    """Linear layer of the flattened, concatenated inputs."""

    features: Count
    bias: float | None = field(default=0.1, kw_only=True)
    """Initial bias; None draws it within 1/√fan_in."""

    def output_shape(self, shape: Shape) -> Shape:
        """Return (features,)."""
        del shape
        return (self.features,)


@limited(of="{} of a memory")
class Memory:
    """A recurrent cell of :mod:`brainbench.models.cells`, channels unchanged."""

    kind: Literal["time-decay", "ugrnn", "intersection", "gru", "lstm"] = "time-decay"
    kernel_size: Sizes = (2, 2)
    """Kernel of the gates, rows and columns."""
    layer_norm: bool = False
    """Normalise each gate over channels."""
    tau: float = 0.0
    """Initial time decay; other kinds ignore it."""
    trainable: bool = True
    """Let training change the time decay; other kinds ignore it."""


@limited(of="{} of a pool")
class Pool:
    """Pooling at the end of a node: ``max``, or ``average`` to a fixed output size."""

    kind: Literal["max", "average"]
    size: Sizes
    """Window of a maximum; output size of an average."""
    stride: Sizes | None = None
    """Step of the window of a maximum; None: as large as the window."""
    padding: Margins = (0, 0)
    """Cells added at every edge, for a maximum."""
    ceil_mode: bool = False
    """Let a window of a maximum reach beyond the edge."""
    flatten: bool = False
    """Give one vector in place of a grid."""

    def output_shape(self, shape: Shape) -> Shape:
        """Return the shape after pooling (C, H, W)."""
        if self.kind == "average":
            size = list(self.size)
        else:
            stride = self.stride or self.size
            size = []
            for length, window, step, padding in zip(shape[1:], self.size, stride, self.padding, strict=True):
                span = length + 2 * padding - window
                count = math.ceil(span / step) if self.ceil_mode else span // step
                # A window that would start in the padding beyond the input does not count (as in PyTorch).
                if self.ceil_mode and count * step >= length + padding:
                    count -= 1
                size.append(count + 1)
        return (shape[0] * math.prod(size),) if self.flatten else (shape[0], *size)


@dataclass(frozen=True)
class Node:
    """One area of the network."""

    name: str
    operation: Convolution | Dense | None
    """None passes the concatenated inputs on."""
    memory: Memory | None = None
    activation: str | None = "relu"
    pool: Pool | None = None
    chain: tuple[str | Pool | Operation, ...] = ()
    """Further steps after the pool, in order; a text is an activation."""
    shape_from: str | None = None
    """Predecessor whose grid size the inputs are resized to; None: the stimulus for an input node, else
    the latest feedforward predecessor."""
    resize: bool = True
    """Resize inputs to the node's grid (bilinear, antialiased); otherwise sizes must agree."""

    def stages(self, shape: Shape) -> list[Shape]:
        """Return the shapes after the operation, after the pool and after each step of the chain."""
        shapes = [shape if self.operation is None else self.operation.output_shape(shape)]
        for step in (self.pool, *self.chain):
            shapes.append(step.output_shape(shapes[-1]) if isinstance(step, (Pool, Operation)) else shapes[-1])
        return shapes


@dataclass(frozen=True)
class Edge:
    """A connection; feedback is delayed by one step in every unrolling."""

    source: str
    target: str
    feedback: bool = False


@dataclass(frozen=True)
class GraphSpec:
    """Nodes, edges and the shape of one time step of the stimulus."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    inputs: tuple[str, ...]
    """Nodes that see the stimulus."""
    output: str
    input_shape: tuple[int, int, int]
    """(C, H, W) of one time step."""
    order: tuple[str, ...] = field(init=False)
    """Nodes sorted along the feedforward edges, as listed where these leave a choice."""

    def __post_init__(self) -> None:
        names = [node.name for node in self.nodes]
        for name in names:
            if not name or "." in name or names.count(name) > 1:
                reason = "appears more than once" if names.count(name) > 1 else "is empty or contains a dot"
                raise UsageError(f"The node name {name!r} {reason}; give every node its own plain name.")
        referenced = [(name, "input node") for name in self.inputs] + [(self.output, "output node")]
        referenced += [(end, "node of an edge") for edge in self.edges for end in (edge.source, edge.target)]
        referenced += [(node.shape_from, "shape_from node") for node in self.nodes if node.shape_from is not None]
        for name, kind in referenced:
            check_name(kind, name, names)
        for end in repeats((edge.source, edge.target) for edge in self.edges):
            raise UsageError(f"The edge {end[0]} → {end[1]} appears more than once.")
        if len(self.input_shape) != 3 or min(self.input_shape) < 1:
            raise UsageError(f"The input shape must be (channels, rows, columns); received {self.input_shape!r}.")
        if lost := [name for name in names if not any(name in self._reach[source] for source in self.inputs)]:
            raise UsageError(f"No path leads from the input nodes {list(self.inputs)} to {listing(lost)}.")
        object.__setattr__(self, "order", self._sorted())

    @cached_property
    def _reach(self) -> dict[str, set[str]]:
        """Nodes that each node reaches, itself included: after as many passes as nodes no further one is found."""
        reach = {node.name: {node.name} for node in self.nodes}
        for _ in self.nodes:
            for edge in self.edges:
                reach[edge.source] |= reach[edge.target]
        return reach

    def _sorted(self) -> tuple[str, ...]:
        ahead = [edge for edge in self.edges if not edge.feedback]
        waiting = {node.name: {edge.source for edge in ahead if edge.target == node.name} for node in self.nodes}
        order: list[str] = []
        while waiting:
            # Kahn (1962), always taking the first listed node that is ready: equal configurations give equal orders.
            ready = next((name for name, sources in waiting.items() if not sources - set(order)), None)
            if ready is None:
                raise UsageError(
                    f"The feedforward edges among {listing(waiting)} form a cycle; mark the edges that lead back "
                    "with feedback=True."
                )
            order.append(ready)
            del waiting[ready]
        return tuple(order)

    @cached_property
    def by_name(self) -> Mapping[str, Node]:
        """Nodes by name."""
        return {node.name: node for node in self.nodes}

    @cached_property
    def predecessors(self) -> Mapping[str, tuple[Edge, ...]]:
        """Edges into each node, sorted by the name of their source."""
        # Channels are concatenated in this order, as in PyTorchTNN: another one would give weights to the wrong inputs.
        ordered = sorted(self.edges, key=lambda edge: edge.source)
        return {node.name: tuple(edge for edge in ordered if edge.target == node.name) for node in self.nodes}

    def delays(self, unroll: Unroll) -> dict[tuple[str, str], int]:
        """Return how many steps each connection (source, target) takes: 1, or 0 within a step."""
        check_name("unrolling", unroll, UNROLLS)
        return {(e.source, e.target): 1 if unroll == "biological" or e.feedback else 0 for e in self.edges}

    def shapes(self) -> tuple[dict[str, Shape], dict[str, Shape]]:
        """Return each node's concatenated input shape and output shape."""
        # Feedback reaches back to nodes whose grid is known only later, so outputs come first: they
        # depend on the shape_from predecessor's grid and on no other input.
        outputs: dict[str, Shape] = {}
        grids: dict[str, Shape] = {}
        for name in self.order:
            grids[name] = self._grid(name, outputs)
            node = self.by_name[name]
            channels = self._channels(name, outputs) if node.operation is None else 1
            outputs[name] = node.stages((channels, *grids[name]))[-1]
            if min(outputs[name]) < 1:
                raise UsageError(
                    f"Node {name!r} has nothing left of a grid of {list(grids[name])}: its output would be "
                    f"{list(outputs[name])}; the stimulus {list(self.input_shape)} is too small."
                )
        for name in self.order:
            self._check_grids(name, grids[name], outputs)
        return {name: (self._channels(name, outputs), *grids[name]) for name in self.order}, outputs

    def _grid(self, name: str, outputs: Mapping[str, Shape]) -> Shape:
        source = self.by_name[name].shape_from
        if source is None:
            if name in self.inputs:
                return self.input_shape[1:]
            ahead = (edge.source for edge in self.predecessors[name] if not edge.feedback)
            # Of several predecessors the latest sets the grid; what earlier ones (skips) send is resized to it.
            source = max(ahead, key=self.order.index, default=None)
            if source is None:
                raise UsageError(f"Node {name!r} has only feedback inputs; say with shape_from whose grid it takes.")
        if source not in outputs:
            raise UsageError(f"Node {name!r} takes its shape from {source!r}, which comes later in feedforward order.")
        return outputs[source][1:]

    def _channels(self, name: str, outputs: Mapping[str, Shape]) -> int:
        seen = self.input_shape[0] if name in self.inputs else 0
        try:
            return seen + sum(outputs[edge.source][0] for edge in self.predecessors[name])
        except KeyError as error:
            raise UsageError(
                f"Node {name!r} has no operation and receives feedback from {error}; give it one."
            ) from None

    def _check_grids(self, name: str, grid: Shape, outputs: Mapping[str, Shape]) -> None:
        node = self.by_name[name]
        arriving = {edge.source: outputs[edge.source][1:] for edge in self.predecessors[name]}
        if name in self.inputs:
            arriving["the stimulus"] = self.input_shape[1:]
        for source, size in arriving.items():
            if len(size) != len(grid) or (size != grid and not node.resize):
                raise UsageError(
                    f"Node {name!r} works on a grid of {list(grid)} and receives {list(size)} from {source}; "
                    "dense outputs cannot be resized, and grids only with resize=True."
                )
        if isinstance(node.operation, Convolution) and len(grid) != 2:
            raise UsageError(f"Node {name!r} is a convolution but its inputs have no grid.")
        gated = node.memory is not None and node.memory.kind != "time-decay"
        if gated and (isinstance(node.operation, Dense) or len(grid) != 2):
            raise UsageError(f"Node {name!r} has no grid, so it cannot carry the convolutional memory {node.memory}.")

    def first_response(self, unroll: Unroll = "biological") -> dict[str, int]:
        """Return for each node the step at which it first responds to the stimulus at step 0."""
        delay = self.delays(unroll)
        # Shortest path in steps (Bellman-Ford): after as many passes as nodes no shorter one is left.
        first = dict.fromkeys(self.inputs, 0)
        for _ in self.nodes:
            for edge in self.edges:
                if edge.source in first:
                    step = first[edge.source] + delay[edge.source, edge.target]
                    first[edge.target] = min(step, first.get(edge.target, step))
        return {name: first[name] for name in self.order}

    def receptive_field(self, unroll: Unroll = "biological") -> int | None:
        """Return how many steps back the output can see, its own step included; None: all of them."""
        delay = self.delays(unroll)
        if any(node.memory is not None for node in self.nodes) or any(len(group) > 1 for group in self.groups):
            return None
        if any(edge.source == edge.target for edge in self.edges):
            return None
        # Longest path in steps, which exists because loops and memories were excluded above.
        last = dict.fromkeys(self.inputs, 1)
        for name in (name for group in self.groups for name in group):
            for edge in self.predecessors[name]:
                last[name] = max(last.get(name, 0), last[edge.source] + delay[edge.source, name])
        return last[self.output]

    @cached_property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Strongly connected components in the order in which they can be computed."""
        reach = self._reach
        # Two nodes that reach one another are in one loop.
        unique = dict.fromkeys(
            tuple(other for other in self.order if other in reach[name] and name in reach[other]) for name in self.order
        )
        # A component that reaches another comes first, and it reaches strictly more nodes.
        return tuple(sorted(unique, key=lambda group: -len(reach[group[0]])))
