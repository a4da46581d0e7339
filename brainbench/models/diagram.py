"""The graph of a model's parts and connections, for the diagrams of reports and leaderboards."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from brainbench.core.records import GraphEdge, GraphNode, ModelGraph
from brainbench.models.graph.spec import Convolution, Dense, Node
from brainbench.models.zoo import GATED

if TYPE_CHECKING:
    from torch import nn

    from brainbench.models.graph.temporal_graph import TemporalGraph

_KINDS = {
    "ResNet18Encoder": {"conv1": "convolution 7×7", "fc": "linear"},
    "S4Encoder": {"embed": "linear", "fc": "linear"},
    "GPTAttender": {"lm_head": "linear"},
    "MambaAttender": {"norm": "layer norm"},
}
_BLOCKS = {
    "ResNet18Encoder": "residual stage",
    "S4Encoder": "state space (S4)",
    "GPTAttender": "self-attention, MLP",
    "MambaAttender": "selective state space",
}


def graph_of(module: nn.Module) -> ModelGraph | None:
    """Return the graph of an :class:`~brainbench.models.network.EncoderAttenderDecoder`; None for any other module.

    Node names are the names of the layers, so that scores can be shown beside them. A node's shape is that
    of its output at one time step, without the batch.
    """
    from brainbench.models.graph.temporal_graph import TemporalGraph
    from brainbench.models.network import EncoderAttenderDecoder

    if not isinstance(module, EncoderAttenderDecoder):
        return None
    nodes = [GraphNode("input", "input", "base forces and moments", shape=module.spec.input_shape)]
    edges: list[GraphEdge] = []
    if isinstance(module.encoder, TemporalGraph):
        last = _temporal(module.encoder, nodes, edges)
    else:
        last = _chain(module.encoder, "encoder", "input", nodes, edges)
    if module.attender is not None:
        last = _chain(module.attender, "attender", last, nodes, edges)
    count = sum(parameter.numel() for parameter in module.decoder.parameters())
    nodes.append(GraphNode("decoder", "decoder", "linear", shape=(module.spec.outputs,), parameters=count))
    edges.append(GraphEdge(last, "decoder"))
    return ModelGraph(tuple(nodes), tuple(edges))


def _temporal(encoder: TemporalGraph, nodes: list[GraphNode], edges: list[GraphEdge]) -> str:
    """Add the areas of a temporal graph; return the name of its output."""
    spec, modules = encoder.spec, encoder.nodes
    _, shapes = spec.shapes()
    for name in spec.order:
        node = spec.by_name[name]
        count = sum(parameter.numel() for parameter in modules[name].parameters())
        memory = GATED.get(node.memory.kind, "time decay") + ", LN" * node.memory.layer_norm if node.memory else ""
        nodes.append(GraphNode(f"encoder.{name}", "encoder", _operation(node), memory, tuple(shapes[name]), count))
    edges += [GraphEdge("input", f"encoder.{name}") for name in spec.inputs]
    edges += [GraphEdge(f"encoder.{e.source}", f"encoder.{e.target}", e.feedback) for e in spec.edges]
    return f"encoder.{spec.output}"


def _chain(module: Any, part: str, last: str, nodes: list[GraphNode], edges: list[GraphEdge]) -> str:
    """Add an encoder or attender whose layers follow one another; return the name of the last."""
    kind = type(module).__name__
    inside = dict(module.named_modules())
    names: tuple[str, ...] = module.layers
    for name in names:
        boxes = inside.get(name)
        if boxes is None and name.startswith("block"):
            boxes = inside.get(f"blocks.{int(name.removeprefix('block')) - 1}")
        count = None if boxes is None else sum(parameter.numel() for parameter in boxes.parameters())
        described = _KINDS.get(kind, {}).get(name) or _BLOCKS.get(kind, "layer")
        width = (int(module.features),) if name == names[-1] else ()
        nodes.append(GraphNode(f"{part}.{name}", part, described, shape=width, parameters=count))
        edges.append(GraphEdge(last, f"{part}.{name}"))
        last = f"{part}.{name}"
    return last


def _operation(node: Node) -> str:
    if isinstance(node.operation, Convolution):
        return f"convolution {node.operation.kernel_size[0]}×{node.operation.kernel_size[1]}"
    return "linear" if isinstance(node.operation, Dense) else "join"
