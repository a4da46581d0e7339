"""Write a network's streaming step to a file for other runtimes, with its contract, and check the file itself.

The file takes ``obs`` [B, C, H, W] in SI and ``h_in`` [B, S] and gives ``features`` [B, F] and ``h_out`` [B, S]; the
normaliser is inside. Beside it stands a JSON contract: channels, units, frame, rate, latency and the reset rule.

The step is a function of a flat state, for control loops too: (obs [B, C, H, W] in SI, h_in [B, S]) → (features [B, F],
h_out [B, S]). A state of zeros is the state before the first step, and rows are independent: an environment is reset by
zeroing its row. In which order a row's numbers lie is not told, and differs between CUDA and the processor.
Letters: B batch, S numbers of state.
"""

from __future__ import annotations

import copy
import hashlib
import io
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import DataError, UsageError, brief, check_name, check_number, needing
from brainbench.core.files import atomic_path, provenance, write_json
from brainbench.core.reading.apart import CRASHED, SECONDS, call_apart
from brainbench.core.reading.regular import check_file, reason, temporary_folder
from brainbench.core.reading.tensors import check_finite
from brainbench.models.encoders import GPTAttender, MambaAttender, MambaMemory, S4Encoder
from brainbench.models.graph.temporal_graph import GraphState, TemporalGraph
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.ops.layers import weights_hash
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
        """Return (y [B, F], the packed state after the step) of x [B, …] and packed states [B, …]."""
        y, after = self.part.step(x, self.unpack(state), **self.how)
        return y, self.pack(after)


def _graph_part(graph: TemporalGraph, unroll: Any) -> _Part:
    # What no edge leads from is read by nobody in the next step.
    sources, empty = {edge.source for edge in graph.spec.edges}, graph.init_state(1)
    outputs = [name for name in empty.outputs if name in sources]

    def _pack(state: GraphState) -> _Tensors:
        return [*(state.outputs[name] for name in outputs), *(state.memories[name] for name in empty.memories)]

    def _unpack(parts: _Tensors) -> GraphState:
        memories = zip(empty.memories, parts[len(outputs) :], strict=True)
        return GraphState(dict(zip(outputs, parts, strict=False)), dict(memories))

    return _Part(graph, _pack, _unpack, unroll=unroll)


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
        """Return (y [B, F], memories after the step) of x [B, …] and the memory of each block [B, …]."""
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
        """Return (y [B, F], state) of x [B, F]; NaN in rows of which more tokens came than the context holds."""
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


SUFFIXES = {"onnx": ".onnx", "torch": ".pt2"}  # formats and their suffixes: ONNX, and an exported PyTorch program
INPUTS, OUTPUTS = ("obs", "h_in"), ("features", "h_out")
OPSET = 18
BATCH = {0: torch.export.Dim("batch", min=1, max=8192)}  # an input with any number of rows
MOST_ONNX = 2 << 30  # bytes of an ONNX file, which Protocol Buffers allow
MOST_INPUT = 1 << 26  # numbers of one input
TOLERANCE = 1e-4  # largest difference between a file and what was exported, relative to the largest number it gives
_STEPS = 8
_SOUND: set[str] = set()  # hashes of ONNX files that were tried in this process


@dataclass(frozen=True)
class Export:
    """A written file and what was found about it."""

    path: Path
    contract: Path
    format: str
    state_size: int
    """S."""
    features: int
    """F."""
    difference: float
    """Largest difference between the file's features and the network's on a random stream, relative to the largest."""


def export_model(model: nn.Module, path: str | Path, *, format: str = "onnx", name: str = "") -> Export:
    """Export the streaming step of an encoder-attender-decoder network and check the file against the network.

    The network is exported in evaluation mode, on the CPU, as ``onnx`` or ``torch``; the suffix of the format is added
    to a path without one. ``name`` is what the contract calls the network.
    """
    check_name("export format", format, SUFFIXES)
    target = Path(path)
    target = target if target.suffix else target.with_suffix(SUFFIXES[format])
    for other_format, suffix in SUFFIXES.items():
        if target.suffix == suffix and other_format != format:
            raise UsageError(f"{brief(str(target))} is named as a file of the format {other_format!r}, not {format!r}.")
    step = StreamingStep(copy.deepcopy(model).cpu().float().eval()).eval()
    with atomic_path(target) as temporary:
        example = torch.zeros(2, *step.model.spec.input_shape), step.init_state(2)
        write_step(step, example, temporary, format, (BATCH, BATCH))
        difference = _difference(step, READERS[format](temporary))
        check_difference(difference, "network", "feature")
    spec: Any = model.spec
    contract = {
        "model": name or type(model).__name__,
        "format": format,
        "file": target.name,
        "inputs": {"obs": ["batch", *spec.input_shape], "h_in": ["batch", step.state_size]},
        "outputs": {"features": ["batch", step.model.features], "h_out": ["batch", step.state_size]},
        "dtype": "float32",
        "normaliser": "inside the file; obs is in SI",
        "reset": "h_in of zeros is the state before the first step; rows are independent, so zero the row of an "
        "environment to reset it",
        "full": None if spec.max_steps is None else f"after {spec.max_steps} steps without a reset features are NaN",
        **{key: value for key, value in asdict(spec).items() if key != "outputs"},
        "difference": difference,
        "weights": weights_hash(model),
        "provenance": provenance(),
    }
    file = write_json(target.with_name(f"{target.name}.json"), contract)
    return Export(target, file, format, step.state_size, step.model.features, difference)


def check_difference(difference: float, of: str, largest: str) -> None:
    """Raise DataError where a file gives something else than what was exported, as a share of the ``largest``."""
    if not difference <= TOLERANCE:
        raise DataError(
            f"The exported file differs from the {of} by {difference:.2g} of the largest {largest} (allowed "
            f"{TOLERANCE:g}), so it was not kept."
        )


def require_onnx() -> None:
    """Raise :class:`MissingDependencyError` unless files of ONNX can be written and read."""
    for package in ("onnx", "onnxscript", "onnxruntime"):
        with needing(package, extra="export", purpose="Exporting to ONNX"):
            __import__(package)
    # The exporter warns that torchvision, which nothing here has a layer of, is not installed.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)


def write_step(
    step: Any, example: tuple[torch.Tensor, ...], path: Path, format: str, shapes: Any, inputs: Sequence[str] = INPUTS,
    outputs: Sequence[str] = OUTPUTS,
) -> None:  # fmt: skip
    """Write a module with names of what it takes and gives; ``shapes`` say of what it takes which axes vary."""
    if format == "onnx":
        require_onnx()
    # PyTorch's compiler looks for a folder for temporary files.
    with temporary_folder(), warnings.catch_warnings(), torch.no_grad():
        # The exporters warn of their own parts' deprecations, which nobody here can act on.
        warnings.simplefilter("ignore")
        if format == "torch":
            # Into memory: PyTorch writes the name of a file into it, and ends the process where the disk is full.
            content = io.BytesIO()
            torch.export.save(torch.export.export(step, example, dynamic_shapes=shapes), content)
            path.write_bytes(content.getvalue())
            return
        names: dict[str, Any] = {"input_names": list(inputs), "output_names": list(outputs), "dynamic_shapes": shapes}
        program = torch.onnx.export(step, example, dynamo=True, opset_version=OPSET, verbose=False, **names)
    if program is None:
        raise DataError("PyTorch gave no ONNX program for this network.")
    program.save(str(path), external_data=False)


def onnx_session(path: str | Path, threads: int | None = None) -> Any:
    """Return ONNX Runtime's session of a file on the CPU, with its own choice of threads if None.

    Another process with limits computes a step of zeros with it first, once for the same bytes: damage ends that one.
    """
    file = check_file(path, "ONNX file", most=MOST_ONNX)
    name, content = brief(os.fspath(path)), file.read_bytes()
    if (digest := hashlib.sha256(content).hexdigest()) not in _SOUND:
        fault, tried = call_apart(f"{__name__}:try_onnx", [os.fspath(file.absolute())], SECONDS) or (CRASHED, "")
        # What was tried and no other bytes; without a folder, so that it names no files beside it.
        if fault or tried != digest:
            raise DataError(f"{name} {fault or 'changed while it was read; wait until it is complete'}.")
        _SOUND.add(digest)
    return _session(content, threads)


def try_onnx(path: str) -> tuple[str, str]:
    """Return what is wrong with an ONNX file, in words that follow its name, and the hash of its bytes."""
    import onnx

    content = Path(path).read_bytes()
    try:
        model = onnx.load_from_string(content)
        # Weights in other files are refused: a network is one file, and it must not make us open others.
        tensors = list(_tensors(model))
        if any(tensor.external_data for tensor in tensors):
            return "keeps weights in other files; export it again", ""
        # A number alone may be infinite, as what attention does not see; what the file computes of it is tried below.
        weights = [tensor for tensor in tensors if tensor.dims]
        check_finite({tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in weights}, path)
        session = _session(content, 1)
        # A side without a number is the batch.
        shapes = {
            value.name: [side if isinstance(side, int) else 1 for side in value.shape] for value in session.get_inputs()
        }
        for name, shape in shapes.items():
            if not 0 <= math.prod(shape) <= MOST_INPUT:
                return f"takes {math.prod(shape):,} numbers as {brief(name)}; at most {MOST_INPUT:,} are allowed", ""
        values = session.run(None, {name: np.zeros(shape, np.float32) for name, shape in shapes.items()})
        if not all(np.isfinite(value).all() for value in values):
            return "gives values that are not finite; export it again", ""
    except DataError as error:
        return f"cannot be used: {error}".removesuffix("."), ""
    except Exception as error:  # noqa: BLE001 - ONNX and ONNX Runtime have no common public base of errors
        return f"cannot be read as ONNX ({reason(error)})", ""
    return "", hashlib.sha256(content).hexdigest()


def _session(content: bytes, threads: int | None) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    if threads is not None:
        options.intra_op_num_threads = options.inter_op_num_threads = threads
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def _tensors(message: Any) -> Iterator[Any]:
    """Yield all tensors of an ONNX message: weights, constants of nodes, and those of branches and functions."""
    if message.DESCRIPTOR.name == "TensorProto":
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in (value,) if hasattr(value, "DESCRIPTOR") else value:
                yield from _tensors(part)


def read_onnx(path: str | Path, *, threads: int | None = None) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Return the step of an exported ONNX file as a function of NumPy arrays (obs, h_in) → (features, h_out).

    ``threads`` are those that ONNX Runtime computes with; its own choice if None.
    """
    session = onnx_session(path, threads)
    return lambda obs, h_in: session.run(list(OUTPUTS), dict(zip(INPUTS, (obs, h_in), strict=True)))


def read_torch(path: str | Path) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Return the step of an exported PyTorch program as a function of NumPy arrays (obs, h_in) → (features, h_out)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = torch.export.load(path).module()

    def _run(obs: Any, h_in: Any) -> tuple[Any, Any]:
        with torch.no_grad():
            features, h_out = module(torch.from_numpy(obs), torch.from_numpy(h_in))
        return features.numpy(), h_out.numpy()

    return _run


READERS = {"onnx": read_onnx, "torch": read_torch}  # readers of exported files, by format


def _difference(step: Any, run: Callable[[Any, Any], tuple[Any, Any]]) -> float:
    """Compare the file with the network's own streaming on random touch, at two batch sizes."""
    model, worst = step.model, 0.0
    generator = torch.Generator().manual_seed(0)
    steps = min(_STEPS, model.spec.max_steps or _STEPS)
    scale = model.normaliser.scale
    for batch in (1, 3):
        h, state = step.init_state(batch).numpy(), model.init_state(batch)
        for _ in range(steps):
            x = torch.randn(batch, *model.spec.input_shape, generator=generator) * scale
            with torch.no_grad():
                expected, state = model.encode_step(x, state)
            features, h = run(x.numpy(), h)
            error = (torch.from_numpy(features) - expected).abs().max() / expected.abs().max().clamp_min(1e-12)
            worst = max(worst, float(error)) if bool(torch.isfinite(error)) else float("inf")
    return worst
