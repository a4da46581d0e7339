"""A causal network as one function of a step and a flat state, for control loops and exported files.

(obs [B, C, H, W] in SI, h_in [B, S]) → (features [B, F], h_out [B, S]). A state of zeros is the state before the first
step, and rows are independent: an environment is reset by zeroing its row. In which order a row's numbers lie is not
told, and differs between CUDA and the processor. Letters: B batch, S numbers of state.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.models.attenders.gpt import GPTAttender
from brainbench.models.attenders.mamba import MambaAttender, MambaMemory
from brainbench.models.encoders.s4 import S4Encoder
from brainbench.models.graph.temporal_graph import GraphState, TemporalGraph
from brainbench.models.network import EncoderAttenderDecoder


class StreamingStep(nn.Module):
    """One step of an encoder-attender network with all its memory in one array.

    Args:
        model: The network, in evaluation mode; its weights are shared.

    A transformer keeps a cache of fixed size. Beyond its last step (``max_steps``) the features are NaN, since an
    exported file cannot complain in words.

    Raises:
        UsageError: the network is of another kind.
    """

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        if not isinstance(model, EncoderAttenderDecoder):
            raise UsageError(
                "Streaming and export need a brainbench.models.network.EncoderAttenderDecoder; "
                f"received {type(model).__name__}."
            )
        self.model = model
        self.encoder = _encoder_part(model)
        self.attender = _attender_part(model.attender)
        self.shapes: tuple[tuple[int, ...], ...] = (*self.encoder.shapes, *self.attender.shapes) or ((1,),)
        """Shape of each part of the state, per row."""
        self.state_size = sum(math.prod(shape) for shape in self.shapes)
        """S."""

    def init_state(self, batch: int) -> torch.Tensor:
        """Return the state [B, S] before the first step: zeros."""
        like = next(self.parameters())
        return torch.zeros(batch, self.state_size, dtype=like.dtype, device=like.device)

    def forward(self, obs: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (features [B, F], h_out [B, S])."""
        sizes = [math.prod(shape) for shape in self.shapes]
        # What works fastest on CUDA, and no part of the contract of an exported file.
        innermost = h_in.is_cuda and not torch.compiler.is_exporting()
        parts = [_part(part, shape, innermost) for part, shape in zip(h_in.split(sizes, 1), self.shapes, strict=True)]
        count = len(self.encoder.shapes)
        features, before = self.encoder(self.model.normaliser(obs), parts[:count])
        features, after = self.attender(features, parts[count:])
        kept = [*before, *after] or parts
        return features, torch.cat([_flat(part, innermost) for part in kept], 1)


def _part(flat: torch.Tensor, shape: tuple[int, ...], innermost: bool) -> torch.Tensor:
    """Return a part of the state [B, *shape] of its numbers [B, N]; of maps, channels may lie innermost among them."""
    if innermost and len(shape) == 3:
        channels, rows, columns = shape
        return flat.unflatten(1, (rows, columns, channels)).permute(0, 3, 1, 2)
    return flat.reshape(-1, *shape)


def _flat(part: torch.Tensor, innermost: bool) -> torch.Tensor:
    return (part.permute(0, 2, 3, 1) if innermost and part.ndim == 4 else part).flatten(1)


class _Stateless(nn.Module):
    """A part that passes its input on, or acts on each step alone."""

    shapes: tuple[tuple[int, ...], ...] = ()

    def __init__(self, act: Any = None) -> None:
        super().__init__()
        self.act = act

    def forward(self, x: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        del state
        return (x if self.act is None else self.act.step(x, ())[0]), []


class _GraphPart(nn.Module):
    def __init__(self, graph: TemporalGraph, unroll: Any) -> None:
        super().__init__()
        self.graph, self.unroll = graph, unroll
        state = graph.init_state(1)
        # What no edge leads from is read by nobody in the next step.
        sources = {edge.source for edge in graph.spec.edges}
        self.outputs = tuple(name for name in state.outputs if name in sources)
        self.memories = tuple(state.memories)
        kept = [state.outputs[name] for name in self.outputs] + [state.memories[name] for name in self.memories]
        self.shapes = tuple(tuple(item.shape[1:]) for item in kept)

    def forward(self, x: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        outputs = dict(zip(self.outputs, state[: len(self.outputs)], strict=True))
        memories = dict(zip(self.memories, state[len(self.outputs) :], strict=True))
        y, after = self.graph.step(x, GraphState(outputs, memories), unroll=self.unroll)
        kept = [after.outputs[name] for name in self.outputs] + [after.memories[name] for name in self.memories]
        return y, kept


class _S4Part(nn.Module):
    def __init__(self, encoder: S4Encoder) -> None:
        super().__init__()
        self.encoder = encoder
        with torch.no_grad():
            state = encoder.init_state(1)
        self.systems = [system for _, system in state]
        self.shapes = tuple(tuple(memory.shape[1:]) for memory, _ in state)

    def forward(self, x: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        y, after = self.encoder.step(x, tuple(zip(state, self.systems, strict=True)))
        return y, [memory for memory, _ in after]


class _MambaPart(nn.Module):
    def __init__(self, attender: MambaAttender) -> None:
        super().__init__()
        self.attender = attender
        self.shapes = tuple(tuple(item.shape[1:]) for memory in attender.init_state(1) for item in memory)

    def forward(self, x: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        memories = tuple(MambaMemory(*state[index : index + 2]) for index in range(0, len(state), 2))
        y, after = self.attender.step(x, memories)
        return y, [item for memory in after for item in memory]


class _GPTPart(nn.Module):
    """The transformer with a cache of fixed size; per row a count of the tokens seen."""

    def __init__(self, attender: GPTAttender) -> None:
        super().__init__()
        self.attender = attender
        heads = attender.blocks[0].heads
        cache = (2, heads, attender.context, attender.features // heads)
        self.shapes = ((1,), *(cache for _ in attender.blocks))

    def forward(self, x: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        attender = self.attender
        seen, caches = state[0], state[1:]
        slots = torch.arange(attender.context, device=x.device, dtype=seen.dtype)
        at = seen[:, :, None] + torch.arange(2, device=x.device, dtype=seen.dtype)[None, :, None]  # [B, 2, 1]
        place = (slots == at).to(x.dtype)  # [B, 2, context]
        hidden = (slots > at)[:, None]  # [B, 1, 2, context]
        free = (1 - place.sum(1))[:, None, :, None]
        pair = torch.stack((x, attender.action.expand_as(x)), 1)
        stream = attender.embed(pair) + place @ attender.positions
        after: list[torch.Tensor] = [seen + 2]
        for module, cache in zip(attender.blocks, caches, strict=True):
            width = stream.shape[-1]
            fused = module.query_key_value(module.norm_attention(stream))
            query, key, value = fused.unflatten(2, (3, module.heads, width // module.heads)).permute(2, 0, 3, 1, 4)
            written = place.transpose(1, 2)[:, None]
            keys = cache[:, 0] * free + written @ key
            values = cache[:, 1] * free + written @ value
            weights = query @ keys.transpose(-1, -2) / math.sqrt(query.shape[-1])
            attended = functional.softmax(weights.masked_fill(hidden, -torch.inf), -1) @ values
            stream = stream + module.project(attended.transpose(1, 2).flatten(2))
            stream = stream + module.mlp(module.norm_mlp(stream))
            after.append(torch.stack((keys, values), 1))
        y = attender.lm_head(attender.norm(stream[:, 1]))
        full = seen + 2 > attender.context
        return torch.where(full, torch.full_like(y, torch.nan), y), after


def _encoder_part(model: EncoderAttenderDecoder) -> Any:
    if isinstance(model.encoder, TemporalGraph):
        return _GraphPart(model.encoder, model.unroll)
    return _S4Part(model.encoder) if isinstance(model.encoder, S4Encoder) else _Stateless(model.encoder)


def _attender_part(attender: Any) -> Any:
    if isinstance(attender, GPTAttender):
        return _GPTPart(attender)
    return _MambaPart(attender) if isinstance(attender, MambaAttender) else _Stateless()
