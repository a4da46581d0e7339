"""The architectures that come with brainbench, and the diagrams of their parts and connections.

Importing this module imports no framework.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from brainbench.core.records import GraphEdge, GraphNode, ModelGraph
from brainbench.models.graph.spec import Convolution, Dense, Node
from brainbench.models.recipes import Architecture
from brainbench.models.registry import register_model

if TYPE_CHECKING:
    from torch import nn

    from brainbench.models.graph.spec import Unroll
    from brainbench.models.graph.temporal_graph import TemporalGraph
    from brainbench.models.network import EncoderAttenderDecoder
    from brainbench.models.parts import Attender, Encoder

GATED = {"ugrnn": "UGRNN", "intersection": "IntersectionRNN", "gru": "GRU", "lstm": "LSTM"}
"""Gated cell of :mod:`brainbench.models.cells` → words; an architecture that names none has time-decay memory."""

CITATIONS = {
    "zhuang": "Zhuang, Kubilius, Hartmann & Yamins 2017, Toward goal-driven neural network models for the rodent "
    "whisker-trigeminal system, NeurIPS 30",
    "resnet18": "He, Zhang, Ren & Sun 2016, Deep residual learning for image recognition, CVPR",
    "s4": "Gu, Goel & Ré 2022, Efficiently modeling long sequences with structured state spaces, ICLR",
    "gpt": "Radford, Wu, Child, Luan, Amodei & Sutskever 2019, Language models are unsupervised multitask learners",
    "mamba": "Gu & Dao 2023, Mamba: linear-time sequence modeling with selective state spaces, arXiv:2312.00752",
}
"""Papers that the parts come from."""


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


def description(architecture: Architecture) -> str:
    """Return one line for people."""
    if architecture.encoder == "resnet18":
        text = "Residual network of every step alone"
    elif architecture.encoder == "s4":
        text = "Structured state-space encoder"
    elif architecture.cell == "feedforward":
        text = "Convolutional encoder without memory or feedback"
    else:
        text = (
            f"Recurrent convolutional encoder, {GATED[architecture.cell] if architecture.cell else 'time-decay memory'}"
        )
    words = {None: "", "gpt": ", GPT attender", "mamba": ", Mamba attender"}[architecture.attender]
    return (
        f"{text}{', LayerNorm' if architecture.layer_norm else ''}{words}{', 3/16 width' if architecture.small else ''}"
    )


def build(
    architecture: Architecture, *, classes: int = 117, decoder: str = "linear", unroll: Unroll = "biological"
) -> EncoderAttenderDecoder:
    """Build the network with new random weights.

    ``unroll`` is for a Zhuang encoder.
    """
    from brainbench.models.network import EncoderAttenderDecoder
    from brainbench.models.ops.layers import draw_silent_biases
    from brainbench.models.parts import make_decoder

    encoder = _encoder(architecture)
    attender = _attender(architecture, encoder.features)
    # Before the decoder, so that features do not depend on the number of classes; here, so that the model by name is
    # the network that training starts from.
    for part in (encoder, attender):
        if part is not None:
            draw_silent_biases(cast("nn.Module", part))
    features = encoder.features if attender is None else attender.features
    return EncoderAttenderDecoder(encoder, attender, make_decoder(decoder, features, classes), unroll=unroll)


def _encoder(architecture: Architecture) -> Encoder:
    from brainbench.models.encoders import ResNet18Encoder, S4Encoder, zhuang_graph
    from brainbench.models.graph.temporal_graph import TemporalGraph

    small, feedforward = architecture.small, architecture.cell == "feedforward"
    if architecture.encoder != "zhuang":
        return {"resnet18": ResNet18Encoder, "s4": S4Encoder}[architecture.encoder](small=small)
    cell = "time-decay" if feedforward else architecture.cell or "time-decay"
    return TemporalGraph(zhuang_graph(cell, architecture.layer_norm, small, feedforward=feedforward))


def _attender(architecture: Architecture, features: int) -> Attender | None:
    from brainbench.models.encoders import GPTAttender, MambaAttender

    if architecture.attender == "gpt":
        # As published, the ResNet's transformer is half as wide as its features.
        return GPTAttender(features, features // 2 if architecture.encoder == "resnet18" else features)
    return MambaAttender(features) if architecture.attender == "mamba" else None


def architectures() -> Iterator[Architecture]:
    """Yield every architecture, full sizes first."""
    for small in (False, True):
        for attender in (None, "gpt", "mamba"):
            for cell in (None, *GATED):
                for layer_norm in (False, True):
                    yield Architecture("zhuang", cell, layer_norm, small, attender)
            yield Architecture("zhuang", "feedforward", small=small, attender=attender)
            for encoder in ("resnet18", "s4"):
                yield Architecture(encoder, small=small, attender=attender)


def register() -> None:
    """Enter every architecture into the registry."""
    for architecture in architectures():
        papers = "; ".join(CITATIONS[part] for part in (architecture.encoder, architecture.attender) if part)
        # Encoder and attender, for grouping on leaderboards.
        family = f"{architecture.encoder}-feedforward" if architecture.cell == "feedforward" else architecture.encoder
        family += f"+{architecture.attender}" if architecture.attender else ""
        text = {"family": family, "description": description(architecture), "citation": papers}
        register_model(str(architecture), licence="MIT", **text)(partial(build, architecture))


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
