"""Activations as the published scores read them: which layers, which steps, and what is averaged.

Their scripts average the second axis of whatever a layer gives. That is time for graphs, ResNet and Mamba, but all 44
tokens of GPT (action tokens included) and the channels of S4's blocks, whose 22 time points are then the features. A
node of a graph is read from the step that the first number of its name sets: conv1 from 0, fc8 from 7. What is returned
has that axis second, so that its mean is what was scored. Unlike theirs, the network is in evaluation mode: they left
dropout and batch statistics on, which no seed reproduces.

Letters: B batch, T step, F features.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import torch
from torch import nn

from brainbench.core.errors import UsageError, check_each
from brainbench.models.attenders import GPTAttender, MambaAttender
from brainbench.models.encoders import ResNet18Encoder, S4Encoder
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.heads import AllStepsDecoder
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.parts import Attender

Named = dict[str, torch.Tensor]
Layers = list[tuple[str, Callable[[torch.Tensor], torch.Tensor]]]


def published_layers(model: nn.Module) -> tuple[str, ...]:
    """Return the names that a network's layers have in the study, from stimulus to output."""
    if not isinstance(model, EncoderAttenderDecoder):
        raise UsageError(
            f"The published readout knows the networks of the study; received {type(model).__name__}. Leave "
            "readout='default' for other models."
        )
    encoder = model.encoder
    if isinstance(encoder, TemporalGraph):
        names = list(encoder.layers)
    elif isinstance(encoder, S4Encoder):
        names = ["enc_s4_emb", *(f"enc_s4_l{index}" for index in range(len(encoder.blocks))), "enc_s4_dec"]
    elif isinstance(encoder, ResNet18Encoder):
        names = [name for name, _ in _resnet_layers(encoder)]
    else:
        raise UsageError(f"The published readout does not know the encoder {type(encoder).__name__}.")
    return (*names, *(name for name, _ in (*_attender_layers(model.attender), *_decoder_layers(model.decoder))))


def published_activations(model: nn.Module, x: torch.Tensor, layers: Collection[str] | None = None) -> Named:
    """Return ``{layer: [B, averaged axis, F]}`` of sweeps [B, T, C, H, W] in SI, by the names of the study."""
    names = published_layers(model)
    check_each("published layer", layers or (), names)
    assert isinstance(model, EncoderAttenderDecoder)
    features, activities = _encode(model, model.normaliser(x), names)
    attended, stream = _through(features, _attender_layers(model.attender))
    if isinstance(model.attender, MambaAttender):
        # What a block adds to the stream, without the stream itself.
        streams = [features, *attended.values()]
        for name, before, after in zip(list(attended)[:-1], streams, streams[1:], strict=False):
            attended[name] = after - before
    elif isinstance(model.attender, GPTAttender):
        stream = stream[:, 1::2]
    stream = stream if isinstance(model.decoder, AllStepsDecoder) else stream[:, -1]
    read, _ = _through(stream, _decoder_layers(model.decoder))
    activities |= attended | {name: value[:, None] for name, value in read.items()}
    return {name: activities[name].flatten(2) for name in names if layers is None or name in layers}


def _encode(model: EncoderAttenderDecoder, x: torch.Tensor, names: Iterable[str]) -> tuple[torch.Tensor, Named]:
    encoder = model.encoder
    if isinstance(encoder, ResNet18Encoder):
        maps, y = _through(x.flatten(0, 1), _resnet_layers(encoder))
        return y.unflatten(0, x.shape[:2]), {name: value.unflatten(0, x.shape[:2]) for name, value in maps.items()}
    if isinstance(encoder, TemporalGraph):
        y, activities = encoder(x, unroll=model.unroll, return_activations=True)
        for name, value in activities.items():
            # A node is read from the step that the first number in its name sets, if the sweep is that long.
            if number := re.search(r"\d+", name):
                activities[name] = value[:, min(max(int(number[0]) - 1, 0), value.shape[1] - 1) :]
        return y, activities
    y, activations = encoder(x, return_activations=True)
    activities = dict(zip(names, activations.values(), strict=False))
    return y, {name: value.transpose(1, 2) if "_l" in name else value for name, value in activities.items()}


def _attender_layers(attender: Attender | None) -> Layers:
    if isinstance(attender, GPTAttender):
        blocks = [(f"att_gpt_b{i}", lambda x, block=block: block(x)[0]) for i, block in enumerate(attender.blocks)]
        embed = ("att_gpt_emb", lambda x: attender.tokens(x, 0))
        return [embed, *blocks, ("att_gpt_ln", attender.norm), ("att_gpt_lm_head", attender.lm_head)]
    if isinstance(attender, MambaAttender):
        blocks = [(f"att_mamba_l{index}", block) for index, block in enumerate(attender.blocks)]
        return [*blocks, ("att_mamba_norm", attender.norm)]
    if attender is not None:
        raise UsageError(f"The published readout does not know the attender {type(attender).__name__}.")
    return []


def _resnet_layers(encoder: ResNet18Encoder) -> Layers:
    stem, fc = list(encoder.conv1), list(encoder.fc)
    blocks = [
        (f"layer{index}.{place}", block)
        for index in range(1, 5)
        for place, block in enumerate(encoder.get_submodule(f"layer{index}").children())
    ]
    ends = [("avgpool", fc[0]), ("fc", nn.Sequential(*fc[1:]))]
    return [("relu", nn.Sequential(*stem[:3])), ("maxpool", stem[3]), *blocks, *ends]


def _decoder_layers(decoder: nn.Module) -> Layers:
    """Return the linear layers, each with the rectifier that follows it."""
    modules = list(decoder.children()) or [decoder]
    if isinstance(decoder, AllStepsDecoder):
        relu, *rest = decoder.rest
        modules = [nn.Sequential(nn.Flatten(1), decoder.first), relu, *rest]
    pairs = [nn.Sequential(*modules[start : start + 2]) for start in range(0, len(modules), 2)]
    return [(f"dec_mlp_l{index}", pair) for index, pair in enumerate(pairs)]


def _through(x: torch.Tensor, layers: Layers) -> tuple[Named, torch.Tensor]:
    activities: Named = {}
    for name, layer in layers:
        x = activities[name] = layer(x)
    return activities, x


@dataclass(frozen=True)
class LayerReadout:
    """How layers are named and read."""

    layers: Callable[[nn.Module], tuple[str, ...]]
    activations: Callable[..., Named]


READOUT = LayerReadout(published_layers, published_activations)
"""The published readout, as :func:`brainbench.models.activations.find_readout` gives it."""
