"""The architectures that come with brainbench. Importing this module imports no framework."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, cast

from brainbench.models.architecture import Architecture
from brainbench.models.registry import register_model

if TYPE_CHECKING:
    from torch import nn

    from brainbench.models.graph.spec import Unroll
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
    from brainbench.models.heads import make_decoder
    from brainbench.models.network import EncoderAttenderDecoder
    from brainbench.models.ops.layers import draw_silent_biases

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
    if architecture.encoder == "resnet18":
        from brainbench.models.encoders import ResNet18Encoder

        return ResNet18Encoder(small=architecture.small)
    if architecture.encoder == "s4":
        from brainbench.models.encoders import S4Encoder

        return S4Encoder(small=architecture.small)
    from brainbench.models.encoders import zhuang_graph
    from brainbench.models.graph.temporal_graph import TemporalGraph

    if architecture.cell == "feedforward":
        return TemporalGraph(zhuang_graph(small=architecture.small, feedforward=True))
    return TemporalGraph(zhuang_graph(architecture.cell or "time-decay", architecture.layer_norm, architecture.small))


def _attender(architecture: Architecture, features: int) -> Attender | None:
    if architecture.attender == "gpt":
        from brainbench.models.attenders import GPTAttender

        # As published, the ResNet's transformer is half as wide as its features.
        return GPTAttender(features, features // 2 if architecture.encoder == "resnet18" else features)
    if architecture.attender == "mamba":
        from brainbench.models.attenders import MambaAttender

        return MambaAttender(features)
    return None


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
