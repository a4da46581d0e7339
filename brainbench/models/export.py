"""Write a network's streaming step to a file for other runtimes, with its contract, and check the file itself.

The file takes ``obs`` [B, C, H, W] in SI and ``h_in`` [B, S] and gives ``features`` [B, F] and ``h_out`` [B, S]; the
normaliser is inside. Beside it stands a JSON contract: channels, units, frame, rate, latency and the reset rule.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import DataError, brief, check_name, needing
from brainbench.core.reading.apart import CRASHED, SECONDS, call_apart
from brainbench.core.reading.regular import check_file, reason
from brainbench.core.reading.tensors import check_finite

if TYPE_CHECKING:
    from torch import nn

SUFFIXES = {"onnx": ".onnx", "torch": ".pt2"}
"""Formats and their suffixes: ONNX, and an exported PyTorch program."""
INPUTS, OUTPUTS = ("obs", "h_in"), ("features", "h_out")
OPSET = 18
MOST_ONNX = 2 << 30
"""Bytes of an ONNX file, which Protocol Buffers allow."""
MOST_INPUT = 1 << 26
"""Numbers of one input."""
TOLERANCE = 1e-4
"""Largest difference between the file and the network, relative to the largest feature."""
_STEPS = 8


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
    import copy

    from brainbench.core.files import atomic_path, provenance, write_json
    from brainbench.models.ops.parameters import weights_hash
    from brainbench.models.streaming import StreamingStep

    check_name("export format", format, SUFFIXES)
    if format == "onnx":
        require_onnx()
    target = Path(path)
    target = target if target.suffix else target.with_suffix(SUFFIXES[format])
    step = StreamingStep(copy.deepcopy(model).cpu().float().eval()).eval()
    with atomic_path(target) as temporary:
        _write(step, temporary, format)
        difference = _difference(step, READERS[format](temporary))
        if not difference <= TOLERANCE:
            raise DataError(
                f"The exported file differs from the network by {difference:.2g} of the largest feature (allowed "
                f"{TOLERANCE:g}), so it was not kept."
            )
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


def require_onnx() -> None:
    """Raise :class:`MissingDependencyError` unless files of ONNX can be written and read."""
    for package in ("onnx", "onnxscript", "onnxruntime"):
        with needing(package, extra="export", purpose="Exporting to ONNX"):
            __import__(package)
    # The exporter warns that torchvision, which nothing here has a layer of, is not installed.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)


def _write(step: Any, path: Path, format: str) -> None:
    import torch

    example = torch.zeros(2, *step.model.spec.input_shape), step.init_state(2)
    batch = torch.export.Dim("batch", min=1, max=4096)
    shapes: dict[str, Any] = {"dynamic_shapes": ({0: batch}, {0: batch})}
    with warnings.catch_warnings(), torch.no_grad():
        # The exporters warn of their own parts' deprecations, which nobody here can act on.
        warnings.simplefilter("ignore")
        if format == "torch":
            # Given a name, PyTorch writes it into the file, and this one is temporary.
            with path.open("wb") as file:
                torch.export.save(torch.export.export(step, example, **shapes), file)
            return
        names: dict[str, Any] = {"input_names": list(INPUTS), "output_names": list(OUTPUTS)}
        program = torch.onnx.export(step, example, dynamo=True, opset_version=OPSET, verbose=False, **names, **shapes)
    if program is None:
        raise DataError("PyTorch gave no ONNX program for this network.")
    program.save(str(path), external_data=False)


def onnx_session(path: str | Path, threads: int | None = None) -> Any:
    """Return ONNX Runtime's session of a file on the CPU, with its own choice of threads if None.

    Another process with limits computes a step of zeros with it first: damage ends that one.
    """
    file = check_file(path, "ONNX file", most=MOST_ONNX)
    name = brief(os.fspath(path))
    fault, digest = call_apart(f"{__name__}:try_onnx", [os.fspath(file.absolute())], SECONDS) or (CRASHED, "")
    if fault:
        raise DataError(f"{name} {fault}.")
    # What was tried and no other bytes; without a folder, so that it names no files beside it.
    content = file.read_bytes()
    if hashlib.sha256(content).hexdigest() != digest:
        raise DataError(f"{name} changed while it was read; wait until it is complete.")
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
        check_finite({tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in tensors}, path)
        session = _session(content, 1)
        # A side without a number is the batch.
        shapes = {
            value.name: [side if isinstance(side, int) else 1 for side in value.shape] for value in session.get_inputs()
        }
        for name, shape in shapes.items():
            if not 0 <= math.prod(shape) <= MOST_INPUT:
                return f"takes {math.prod(shape):,} numbers as {brief(name)}; at most {MOST_INPUT:,} are allowed", ""
        session.run(None, {name: np.zeros(shape, np.float32) for name, shape in shapes.items()})
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
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = torch.export.load(path).module()

    def run(obs: Any, h_in: Any) -> tuple[Any, Any]:
        with torch.no_grad():
            features, h_out = module(torch.from_numpy(obs), torch.from_numpy(h_in))
        return features.numpy(), h_out.numpy()

    return run


READERS = {"onnx": read_onnx, "torch": read_torch}
"""Readers of exported files, by format."""


def _difference(step: Any, run: Callable[[Any, Any], tuple[Any, Any]]) -> float:
    """Compare the file with the network's own streaming on random touch, at two batch sizes."""
    import torch

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
