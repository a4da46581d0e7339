"""A causal network as one function of a step and a flat state, for control loops and exported files.

(obs [B, C, H, W] in SI, h_in [B, S]) → (features [B, F], h_out [B, S]). A state of zeros is the state before the first
step, and rows are independent: an environment is reset by zeroing its row. In which order a row's numbers lie is not
told, and differs between CUDA and the processor. Letters: B batch, S numbers of state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.models.attenders import GPTAttender, MambaAttender, MambaMemory
from brainbench.models.encoders import S4Encoder
from brainbench.models.graph.temporal_graph import GraphState, TemporalGraph
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.ops.state_space import System

_Tensors = list[torch.Tensor]


class StreamingStep(nn.Module):
    """One step of an encoder-attender network with all its memory in one array.

    The network is in evaluation mode, and its weights are shared.

    A transformer keeps a cache of fixed size. Beyond its last step (``max_steps``) the features are NaN, since an
    exported file cannot complain in words.
    """

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        if not isinstance(model, EncoderAttenderDecoder):
            raise UsageError(
                "Streaming and export need a brainbench.models.network.EncoderAttenderDecoder; "
                f"received {type(model).__name__}."
            )
        self.model = model
        self.encoder = _part_of(model.encoder, model.unroll)
        self.attender = None if model.attender is None else _part_of(model.attender, model.unroll)
        attended = () if self.attender is None else self.attender.shapes
        self.shapes: tuple[tuple[int, ...], ...] = (*self.encoder.shapes, *attended) or ((1,),)
        """Shape of each part of the state, per row."""
        self.state_size = sum(math.prod(shape) for shape in self.shapes)
        """S."""

    def init_state(self, batch: int) -> torch.Tensor:
        """Return the state [B, S] before the first step, zeros; UsageError where the batch is no whole number."""
        check_number("batch of a state", batch, least=0, whole=True)
        like = next(self.parameters())
        return torch.zeros(batch, self.state_size, dtype=like.dtype, device=like.device)

    def forward(self, obs: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (features [B, F], h_out [B, S])."""
        sizes = [math.prod(shape) for shape in self.shapes]
        # What works fastest on CUDA, and no part of the contract of an exported file.
        innermost = h_in.is_cuda and not torch.compiler.is_exporting()
        parts = [_part(part, shape, innermost) for part, shape in zip(h_in.split(sizes, 1), self.shapes, strict=True)]
        count = len(self.encoder.shapes)
        features, memories = self.encoder(self.model.normaliser(obs), parts[:count])
        if self.attender is not None:
            features, after = self.attender(features, parts[count:])
            memories = [*memories, *after]
        memories = memories or parts
        return features, torch.cat([_flat(part, innermost) for part in memories], 1)


def _part(flat: torch.Tensor, shape: tuple[int, ...], innermost: bool) -> torch.Tensor:
    """Return a part of the state [B, *shape] of its numbers [B, N]; of maps, channels may lie innermost among them."""
    if innermost and len(shape) == 3:
        channels, rows, columns = shape
        return flat.unflatten(1, (rows, columns, channels)).permute(0, 3, 1, 2)
    return flat.reshape(-1, *shape)


def _flat(part: torch.Tensor, innermost: bool) -> torch.Tensor:
    return (part.permute(0, 2, 3, 1) if innermost and part.ndim == 4 else part).flatten(1)


class _Part(nn.Module):
    """An encoder or attender whose state is packed into tensors that depend on what was seen, and unpacked again."""

    def __init__(
        self, part: Any, pack: Callable[[Any], _Tensors], unpack: Callable[[_Tensors], Any], **how: Any
    ) -> None:
        super().__init__()
        self.part, self.pack, self.unpack, self.how = part, pack, unpack, how
        with torch.no_grad():
            self.shapes = tuple(tuple(item.shape[1:]) for item in pack(part.init_state(1)))

    def forward(self, x: torch.Tensor, state: _Tensors) -> tuple[torch.Tensor, _Tensors]:
        y, after = self.part.step(x, self.unpack(state), **self.how)
        return y, self.pack(after)


def _graph_part(graph: TemporalGraph, unroll: Any) -> _Part:
    # What no edge leads from is read by nobody in the next step.
    sources, empty = {edge.source for edge in graph.spec.edges}, graph.init_state(1)
    outputs = [name for name in empty.outputs if name in sources]

    def pack(state: GraphState) -> _Tensors:
        return [*(state.outputs[name] for name in outputs), *(state.memories[name] for name in empty.memories)]

    def unpack(parts: _Tensors) -> GraphState:
        memories = zip(empty.memories, parts[len(outputs) :], strict=True)
        return GraphState(dict(zip(outputs, parts, strict=False)), dict(memories))

    return _Part(graph, pack, unpack, unroll=unroll)


class _S4Part(nn.Module):
    """The state-space encoder. Its systems are kept: to discretise the weights anew takes longer than a step."""

    def __init__(self, encoder: S4Encoder) -> None:
        super().__init__()
        self.part = encoder
        with torch.no_grad():
            empty = encoder.init_state(1)
        self.shapes = tuple(tuple(memory.shape[1:]) for memory, _ in empty)
        for number, (_, system) in enumerate(empty):
            for name, value in system._asdict().items():
                self.register_buffer(f"{name}{number}", value, persistent=False)
        self._weights = [*encoder.parameters()]
        self._versions: list[int] = []
        super().train(encoder.training)

    def train(self, mode: bool = True) -> _S4Part:
        """Set training mode; for evaluation, keep the systems of the weights as they are now."""
        super().train(mode)
        if not mode:
            self._discretise()
        return self

    @torch.no_grad()
    def _discretise(self) -> None:
        self._versions = [weight._version for weight in self._weights]
        for retained, block in zip(self._kept(), self.part.blocks, strict=True):
            for old, new in zip(retained, block.memory.system(), strict=True):
                old.copy_(new)

    def _kept(self) -> list[System]:
        numbers = range(len(self.part.blocks))
        return [System(*(getattr(self, f"{name}{number}") for name in System._fields)) for number in numbers]

    def forward(self, x: torch.Tensor, state: _Tensors) -> tuple[torch.Tensor, _Tensors]:
        # Weights that learn are discretised in every step, so that gradients reach them.
        learns = self.training or (torch.is_grad_enabled() and self.part.fc.weight.requires_grad)
        traced = torch.compiler.is_compiling() or torch.compiler.is_exporting()
        if not (learns or traced) and self._versions != [weight._version for weight in self._weights]:
            self._discretise()  # weights were loaded since
        systems = [block.memory.system() for block in self.part.blocks] if learns else self._kept()
        y, after = self.part.step(x, tuple(zip(state, systems, strict=True)))
        return y, [memory for memory, _ in after]


class _GPTPart(nn.Module):
    """The transformer with a cache of fixed size; per row a count of the tokens seen."""

    def __init__(self, attender: GPTAttender) -> None:
        super().__init__()
        self.attender = attender
        heads = attender.blocks[0].heads
        cache = (2, heads, attender.context, attender.features // heads)
        self.shapes = ((1,), *(cache for _ in attender.blocks))

    def forward(self, x: torch.Tensor, state: _Tensors) -> tuple[torch.Tensor, _Tensors]:
        attender = self.attender
        seen, caches = state[0], state[1:]
        slots = torch.arange(attender.context, device=x.device, dtype=seen.dtype)
        at = seen[:, :, None] + torch.arange(2, device=x.device, dtype=seen.dtype)[None, :, None]  # [B, 2, 1]
        place = (slots == at).to(x.dtype)  # [B, 2, context]
        hidden = (slots > at)[:, None]  # [B, 1, 2, context]
        free = (1 - place.sum(1))[:, None, :, None]
        pair = torch.stack((x, attender.action.expand_as(x)), 1)
        stream = attender.embed(pair) + place @ attender.positions
        after = [seen + 2]
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


def _part_of(part: Any, unroll: Any) -> Any:
    if isinstance(part, TemporalGraph):
        return _graph_part(part, unroll)
    if isinstance(part, GPTAttender):
        return _GPTPart(part)
    if isinstance(part, S4Encoder):
        return _S4Part(part)
    if isinstance(part, MambaAttender):
        return _Part(
            part,
            lambda state: [item for memory in state for item in memory],
            lambda parts: tuple(MambaMemory(*pair) for pair in zip(parts[::2], parts[1::2], strict=True)),
        )
    return _Part(part, lambda state: [], lambda parts: ())
