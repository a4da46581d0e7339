"""Weights as the authors store them: a Lightning checkpoint, a bare state dict, or safetensors; and their settings."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from brainbench.core.errors import DataError, DataFileNotFoundError, listing, missing_dependency
from brainbench.core.files import file_hash, read_mapping
from brainbench.models.graph.tnn_import import read_graph

# Values of their settings; what they mean here.
_OBJECTIVES = {"SimCLRLoss": "simclr", "SimSiamLoss": "simsiam", "AutoEncoderLoss": "ae"}
_CELLS = {"ugrnn", "gru", "lstm", "intersection"}


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
    """What the settings of a run say of its network; None where they say nothing."""

    cell: str | None = None
    """Cell of a Zhuang encoder with ``-ln`` for layer norm; ``time-decay`` without gates."""
    objective: str | None = None


def read_weights(path: str | os.PathLike[str]) -> ForeignWeights:
    """Read a file of weights; nothing in it is executed.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: it is no such file, is cut short, needs pickle, or a weight is not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise DataFileNotFoundError(f"There is no file of weights {os.fspath(path)!r}.")
    content = _read(path)
    state = content.get("state_dict", content)
    if not isinstance(state, Mapping) or not state or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise DataError(
            f"{os.fspath(path)!r} holds no weights: expected tensors by name, or such a mapping as 'state_dict'; found "
            f"{listing(content) if content else 'nothing'}."
        )
    bad = [name for name, value in state.items() if value.is_floating_point() and not value.isfinite().all()]
    if bad:
        raise DataError(f"{os.fspath(path)!r} has weights that are not finite: {listing(bad)}; the training diverged.")
    counts = {ours: content.get(theirs) for ours, theirs in (("epoch", "epoch"), ("step", "global_step"))}
    counts = {name: value if isinstance(value, int) else None for name, value in counts.items()}
    return ForeignWeights(_prefixed(state), path, file_hash(path, length=64), **counts)


def read_settings(path: str | os.PathLike[str]) -> Settings:
    """Read a run's settings (``config.yaml``, JSON or TOML), or PyTorchTNN's configuration of its graph (JSON).

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: it cannot be read, or says nothing that is known here.
        MissingDependencyError: it is YAML and no reader is installed.
    """
    path = Path(path)
    values = _read_yaml(path) if path.suffix.lower() in (".yaml", ".yml") else read_mapping(path)
    if "nodes" in values:
        memory = next((node.memory for node in read_graph(values).nodes if node.memory is not None), None)
        return Settings(memory and memory.kind + ("-ln" if memory.layer_norm else ""))
    cell, objective = None, _OBJECTIVES.get(str(_inner(values, "train", "ssl")))
    if graph := _inner(values, "model", "encoder", "model_config_file"):
        words = Path(str(graph)).stem.removeprefix("rnn_fdb_converted_modern").strip("_").split("_")
        cell = (words[0] if words[0] in _CELLS else "time-decay") + ("-ln" if "ln" in words else "")
    if cell is None and objective is None:
        raise DataError(
            f"{os.fspath(path)!r} says nothing of a network: expected 'model.encoder.model_config_file', 'train.ssl' "
            f"or a graph's 'nodes'; found {listing(values) if values else 'nothing'}."
        )
    return Settings(cell, objective)


def _read(path: Path) -> Mapping[str, Any]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    name = os.fspath(path)
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, SafetensorError, RuntimeError, EOFError, ValueError, OSError, KeyError) as error:
        # PyTorch writes zip archives; only in a sound one is an object in the way, and not a torn file.
        if isinstance(error, pickle.UnpicklingError) and zipfile.is_zipfile(path):
            raise DataError(
                f"{name!r} holds objects that only pickle could load, which may run code; save its 'state_dict' alone "
                "with torch.save, or as safetensors."
            ) from error
        raise DataError(
            f"{name!r} is not a readable file of weights, or it is cut short ({type(error).__name__}); get it again."
        ) from error
    return content if isinstance(content, Mapping) else {}


def _read_yaml(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise DataFileNotFoundError(f"There is no file {os.fspath(path)!r}.")
    try:
        import yaml
    except ImportError as error:
        raise missing_dependency("pyyaml", extra="hub", purpose="Reading YAML settings") from error
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"{os.fspath(path)!r} is not valid YAML ({str(error).splitlines()[0]}).") from error
    return values if isinstance(values, Mapping) else {}


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
