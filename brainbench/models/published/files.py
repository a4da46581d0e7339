"""Weights as the authors store them: a Lightning checkpoint, a bare state dict, or safetensors; and their settings."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from brainbench.core.errors import DataError, listing, shown
from brainbench.core.files import file_hash
from brainbench.core.reading.tensors import check_stored, read_checkpoint, read_tensors
from brainbench.core.reading.texts import read_mapping
from brainbench.models.graph.tnn_import import read_graph

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
    named = isinstance(state, Mapping) and all(isinstance(name, str) for name in state)
    if not named or not state or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise DataError(
            f"{shown(os.fspath(path))} holds no weights: expected tensors by name, or such a mapping as 'state_dict'; "
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
        if known := _CELLS.get(words[0]):
            cell = known + ("-ln" if "ln" in words else "")
    if cell is None and objective is None:
        raise DataError(
            f"{shown(os.fspath(path))} says nothing of a network: expected 'model.encoder.model_config_file', "
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
