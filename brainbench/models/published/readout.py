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

import torch
from torch import nn

from brainbench.core.errors import UsageError, check_name
from brainbench.models.attenders.gpt import GPTAttender
from brainbench.models.attenders.mamba import MambaAttender
from brainbench.models.encoders.resnet import ResNet18Encoder
from brainbench.models.encoders.s4 import S4Encoder
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.heads.decoders import AllStepsDecoder
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.parts import Attender

Named = dict[str, torch.Tensor]


def published_layers(model: nn.Module) -> tuple[str, ...]:
    """Return the names that a network's layers have in the study, from stimulus to output.

    Raises:
        UsageError: the network is of another kind.
    """
    model = _checked(model)
    encoder, attender = model.encoder, model.attender
    names: list[str] = list(encoder.layers) if isinstance(encoder, TemporalGraph) else []
    if isinstance(encoder, S4Encoder):
        names = ["enc_s4_emb", *(f"enc_s4_l{index}" for index in range(len(encoder.blocks))), "enc_s4_dec"]
    elif isinstance(encoder, ResNet18Encoder):
        names = [name for name, _ in _resnet_layers(encoder)]
    if isinstance(attender, GPTAttender):
        names += ["att_gpt_emb", *(f"att_gpt_b{index}" for index in range(len(attender.blocks)))]
        names += ["att_gpt_ln", "att_gpt_lm_head"]
    elif isinstance(attender, MambaAttender):
        names += [*(f"att_mamba_l{index}" for index in range(len(attender.blocks))), "att_mamba_norm"]
    return (*names, *(f"dec_mlp_l{index}" for index in range(len(_decoder_layers(model)))))


def published_activations(model: nn.Module, x: torch.Tensor, layers: Collection[str] | None = None) -> Named:
    """Return ``{layer: [B, averaged axis, F]}`` of sweeps [B, T, C, H, W] in SI, by the names of the study.

    Raises:
        UsageError: the network is of another kind, a layer does not exist, or the sweeps do not fit.
    """
    names = published_layers(model)
    for name in layers or ():
        check_name("published layer", name, names)
    model = _checked(model)
    features, found = _encoder(model, model.normaliser(x))
    if model.attender is not None:
        features, attended = _attender(model.attender, features)
        found |= attended
    y = features if isinstance(model.decoder, AllStepsDecoder) else features[:, -1]
    for index, layer in enumerate(_decoder_layers(model)):
        y = layer(y)
        found[f"dec_mlp_l{index}"] = y[:, None]
    return {name: found[name].flatten(2) for name in names if layers is None or name in layers}


def _checked(model: nn.Module) -> EncoderAttenderDecoder:
    if not isinstance(model, EncoderAttenderDecoder):
        raise UsageError(
            f"The published readout knows the networks of the study; received {type(model).__name__}. Leave "
            "readout='default' for other models."
        )
    return model


def _encoder(model: EncoderAttenderDecoder, x: torch.Tensor) -> tuple[torch.Tensor, Named]:
    encoder = model.encoder
    if isinstance(encoder, TemporalGraph):
        y, nodes = encoder(x, unroll=model.unroll, return_activations=True)
        return y, {name: value[:, _first_step(name, value.shape[1]) :] for name, value in nodes.items()}
    if isinstance(encoder, ResNet18Encoder):
        y, maps = _through(x.flatten(0, 1), _resnet_layers(encoder))
        return y.unflatten(0, x.shape[:2]), {name: value.unflatten(0, x.shape[:2]) for name, value in maps.items()}
    if isinstance(encoder, S4Encoder):
        y, activations = encoder(x, return_activations=True)
        first, *blocks, last = activations.values()
        found = {f"enc_s4_l{index}": value.transpose(1, 2) for index, value in enumerate(blocks)}
        return y, {"enc_s4_emb": first, **found, "enc_s4_dec": last}
    raise UsageError(f"The published readout does not know the encoder {type(encoder).__name__}.")


def _attender(attender: Attender, x: torch.Tensor) -> tuple[torch.Tensor, Named]:
    found: Named = {}
    if isinstance(attender, GPTAttender):
        stream = found["att_gpt_emb"] = attender.tokens(x, 0)
        for index, block in enumerate(attender.blocks):
            stream, _ = block(stream)
            found[f"att_gpt_b{index}"] = stream
        found["att_gpt_ln"] = attender.norm(stream)
        found["att_gpt_lm_head"] = attender.lm_head(found["att_gpt_ln"])
        return found["att_gpt_lm_head"][:, 1::2], found
    if isinstance(attender, MambaAttender):
        for index, block in enumerate(attender.blocks):
            # What a block adds to the stream, without the stream itself.
            after = block(x)
            found[f"att_mamba_l{index}"], x = after - x, after
        y = found["att_mamba_norm"] = attender.norm(x)
        return y, found
    raise UsageError(f"The published readout does not know the attender {type(attender).__name__}.")


def _resnet_layers(encoder: ResNet18Encoder) -> list[tuple[str, nn.Module]]:
    stem, fc = list(encoder.conv1), list(encoder.fc)
    blocks = [
        (f"layer{index}.{place}", block)
        for index in range(1, 5)
        for place, block in enumerate(encoder.get_submodule(f"layer{index}").children())
    ]
    return [
        ("relu", nn.Sequential(*stem[:3])),
        ("maxpool", stem[3]),
        *blocks,
        ("avgpool", fc[0]),
        ("fc", nn.Sequential(*fc[1:])),
    ]


def _decoder_layers(model: EncoderAttenderDecoder) -> list[Callable[[torch.Tensor], torch.Tensor]]:
    """Return the linear layers, each with the rectifier that follows it."""
    decoder = model.decoder
    if isinstance(decoder, AllStepsDecoder):
        relu, second, again, last = decoder.rest
        first = nn.Sequential(nn.Flatten(1), decoder.first, relu)
        return [first, nn.Sequential(second, again), last]
    if isinstance(decoder, nn.Linear):
        return [decoder]
    modules = list(decoder.children())
    return [nn.Sequential(*modules[start : start + 2]) for start in range(0, len(modules), 2)]


def _through(x: torch.Tensor, layers: Iterable[tuple[str, nn.Module]]) -> tuple[torch.Tensor, Named]:
    found: Named = {}
    for name, layer in layers:
        x = found[name] = layer(x)
    return x, found


def _first_step(name: str, steps: int) -> int:
    """Return the step from which a node is read: the first number in its name less one, if the sweep is that long."""
    number = re.search(r"\d+", name)
    return 0 if number is None else min(max(int(number[0]) - 1, 0), steps - 1)
