"""Weights as the authors store them: a Lightning checkpoint, a bare state dict, or safetensors; and their settings."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from brainbench.core.errors import DataError, UsageError, brief, listing
from brainbench.core.files import file_hash
from brainbench.core.reading.tensors import check_stored, read_checkpoint, read_tensors
from brainbench.core.reading.texts import read_mapping
from brainbench.models.architecture import Architecture
from brainbench.models.graph.tnn_import import read_graph
from brainbench.models.heads import CLASSES

# Values of their settings; what they mean here.
_OBJECTIVES = {"SimCLRLoss": "simclr", "SimSiamLoss": "simsiam", "AutoEncoderLoss": "ae"}
_CELLS = {"": "time-decay", "ln": "time-decay"} | {name: name for name in ("ugrnn", "gru", "lstm", "intersection")}


@dataclass(frozen=True)
class ForeignWeights:
    """Entries of a file and where they come from."""

    state: Mapping[str, torch.Tensor]
    """Entries, a network's under ``model.encoder``, ``model.attender`` and ``model.decoder``."""
    path: Path
    sha256: str
    epoch: int | None = None
    step: int | None = None


@dataclass(frozen=True)
class Settings:
    """Statements of a run's settings about its network; None where they say nothing."""

    cell: str | None = None
    """Cell of a Zhuang encoder with ``-ln`` for layer norm; ``time-decay`` without gates."""
    objective: str | None = None


def read_weights(path: str | os.PathLike[str]) -> ForeignWeights:
    """Read a file of weights; nothing in it is executed.

    Raises:
        DataFileNotFoundError: there is no such file.
    """
    path, kind = Path(path), "file of weights"
    read = read_tensors if path.suffix == ".safetensors" else read_checkpoint
    content: Mapping[str, Any] = read(path, kind)
    state: Any = content.get("state_dict", content)
    has_names = isinstance(state, Mapping) and all(isinstance(name, str) for name in state)
    if not has_names or not state or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise DataError(
            f"{brief(os.fspath(path))} holds no weights: expected tensors by name, or such a mapping as 'state_dict'; "
            f"found {listing(map(str, content)) if content else 'nothing'}."
        )
    check_stored(state, os.fspath(path))
    counts = [value if isinstance(value := content.get(name), int) else None for name in ("epoch", "global_step")]
    return ForeignWeights(_prefixed(state), path, file_hash(path, length=64), *counts)


def read_settings(path: str | os.PathLike[str]) -> Settings:
    """Read a run's settings (``config.yaml``, JSON or TOML), or PyTorchTNN's configuration of its graph (JSON).

    Raises:
        DataFileNotFoundError: there is no such file.
    """
    values = read_mapping(path, "file of settings")
    if "nodes" in values:
        memory = next((node.memory for node in read_graph(values).nodes if node.memory is not None), None)
        return Settings(memory and memory.kind + ("-ln" if memory.layer_norm else ""))
    cell, objective = None, _OBJECTIVES.get(str(_inner(values, "train", "ssl")))
    if graph := _inner(values, "model", "encoder", "model_config_file"):
        words = Path(str(graph)).stem.removeprefix("rnn_fdb_converted_modern").strip("_").split("_")
        # A name of another pattern says nothing; the weights tell the cell, or the user is asked.
        if cell_name := _CELLS.get(words[0]):
            cell = cell_name + ("-ln" if "ln" in words else "")
    if cell is None and objective is None:
        raise DataError(
            f"{brief(os.fspath(path))} says nothing of a network: expected 'model.encoder.model_config_file', "
            f"'train.ssl' or a graph's 'nodes'; found {listing(map(str, values)) if values else 'nothing'}."
        )
    return Settings(cell, objective)


def _inner(values: Any, *names: str) -> Any:
    for name in names:
        values = values.get(name) if isinstance(values, Mapping) else None
    return values


def _prefixed(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Give the entries of a bare network or encoder the names that they have in a Lightning file."""
    if any(name.startswith("model.") for name in state):
        return dict(state)
    if any(name.startswith(("encoder.TG.", "encoder.encoder.", "encoder.s4_layers.")) for name in state):
        return {name if name.startswith("loss.") else f"model.{name}": value for name, value in state.items()}
    if any("._pre_memory." in name for name in state):
        return {f"model.encoder.TG.{name.removeprefix('TG.')}": value for name, value in state.items()}
    return dict(state)


_HEADS = {"loss.neck.fc0.": "simclr", "loss.projection_mlp.": "simsiam", "loss.decoder.deconv.": "ae"}
_ATTENDERS = {"_policy.transformer.": "gpt", "layers.0.mixer.": "mamba"}
_NAMED_NORMS = {"ln_input": "lstm", "ln_gh_act": "intersection"}


@dataclass(frozen=True)
class Recognised:
    """A published network."""

    architecture: str
    decoder: str | None
    """Name of :data:`brainbench.models.heads.DECODERS`; None in a file without one."""
    classes: int
    objective: str | None
    """Objective of its training; None where the file does not tell."""


def recognise(
    state: Mapping[str, torch.Tensor], settings: Settings | None = None, architecture: str | None = None
) -> Recognised:
    """Recognise a network; ``architecture`` (a registry name without a tag) and settings decide where names do not."""
    settings = settings or Settings()
    name = architecture or f"{_encoder(state, settings)}{_attender(state)}"
    untrained = Architecture.parse(name).untrained
    layers = sorted(name for name in state if name.startswith("model.decoder.mlp.") and name.endswith(".weight"))
    decoder, classes = None, CLASSES
    if layers:
        classes, wide = state[layers[-1]].shape[0], state[layers[0]].shape[-1]
        features = 256 if Architecture.parse(untrained).attender == "gpt" and untrained.startswith("resnet18") else 512
        decoder = "linear" if len(layers) == 1 else "mlp" if wide == features else "all-steps"
    head = next((objective for begin, objective in _HEADS.items() if _any(state, begin)), None)
    # Only supervised networks were read by a perceptron; a linear layer may be the probe of another objective.
    alone = "supervised" if decoder in ("mlp", "all-steps") else None
    return Recognised(untrained, decoder, classes, head or settings.objective or alone)


def _encoder(state: Mapping[str, torch.Tensor], settings: Settings) -> str:
    if _any(state, "model.encoder.s4_layers."):
        return "s4"
    if _any(state, "model.encoder.encoder.layer1."):
        return "resnet18"
    cells = {name.rpartition("_recurrent_cell.")[2]: name for name in state if "._recurrent_cell." in name}
    if not _any(state, "model.encoder.TG.conv1."):
        raise DataError(
            f"No network of the study has such entries: {listing(state)}; expected model.encoder.TG.…, "
            "model.encoder.encoder.… or model.encoder.s4_layers.…."
        )
    if not cells:
        return "zhuang-feedforward"
    norm = "-ln" if any(leaf.startswith("ln_") for leaf in cells) else ""
    if "tau" in cells:
        return "zhuang"
    if "conv_ru.weight" in cells:
        return f"zhuang-gru{norm}"
    weight = state[cells["conv.weight"]] if "conv.weight" in cells else None
    if weight is not None and weight.ndim == 4 and weight.shape[0] == weight.shape[1]:
        return f"zhuang-ugrnn{norm}"
    for begin, cell in _NAMED_NORMS.items():
        if any(leaf.startswith(f"{begin}.") for leaf in cells):
            return f"zhuang-{cell}{norm}"
    if settings.cell in ("lstm", "intersection"):
        return f"zhuang-{settings.cell}"
    raise UsageError(
        "An LSTM and an IntersectionRNN without layer norm have entries of the same names and shapes; say which one "
        "it is with --config (the run's settings) or --architecture (zhuang-lstm or zhuang-intersection)."
    )


def _attender(state: Mapping[str, torch.Tensor]) -> str:
    if not _any(state, "model.attender."):
        return ""
    for begin, name in _ATTENDERS.items():
        if _any(state, f"model.attender.{begin}"):
            return f"+{name}"
    names = [name for name in state if name.startswith("model.attender.")]
    raise DataError(f"The attender with {listing(names)} is none of the study's: gpt or mamba.")


def _any(names: Iterable[str], begin: str) -> bool:
    return any(name.startswith(begin) for name in names)
