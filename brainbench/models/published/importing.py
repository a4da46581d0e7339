"""A published file of weights as a checkpoint of ours, with its card."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from brainbench.core.errors import DataError
from brainbench.core.files import cache_dir, content_hash, provenance
from brainbench.core.reading.sealed import is_sealed, seal_file
from brainbench.models.encoders import S4Encoder
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.normaliser import PUBLISHED_FORCE_SCALE, Normaliser
from brainbench.models.ops.parameters import check_named, copy_named
from brainbench.models.ops.state_space import StateSpace
from brainbench.models.published.files import ForeignWeights, read_settings, read_weights
from brainbench.models.published.names import published_names, stored_readout
from brainbench.models.published.recognition import Recognised, recognise
from brainbench.models.registry import load_model
from brainbench.models.training.checkpoints import CONFIG, WEIGHTS, save_checkpoint

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImportedModel:
    """A checkpoint made of a published file."""

    folder: Path
    name: str
    """Name for :func:`brainbench.load_model`: ``local-dir:FOLDER``."""
    architecture: str
    decoder: str | None
    """None: the file has none."""
    objective: str | None
    parameters: int
    """Parameters of the network in the file."""
    not_imported: Mapping[str, int]
    """Part that is not the network's → number of its entries in the file."""
    sha256: str


def import_checkpoint(
    path: str | os.PathLike[str],
    *,
    architecture: str | None = None,
    config: str | os.PathLike[str] | None = None,
    out: str | os.PathLike[str] | None = None,
) -> ImportedModel:
    """Write a published file of weights as a checkpoint of ours.

    The file is a Lightning checkpoint (``.ckpt``), a state dict of PyTorch, or safetensors. Where names and shapes
    leave a choice, the registry name ``architecture`` or the run's settings ``config`` decide it. The default folder is
    ``ARCHITECTURE-HASH`` where the command runs.
    """
    settings = None if config is None else read_settings(config)
    weights = read_weights(path)
    found = recognise(weights.state, settings, architecture)
    model, used = build_published(weights.state, found)
    left: dict[str, list[str]] = {}
    for name in _others(weights.state, used):
        part = "self-supervised head" if name.startswith("loss.") else "attention masks and kernel lengths"
        left.setdefault(part, []).append(name)
    facts = {
        "objective": found.objective,
        "origin": {"file": weights.path.name, "sha256": weights.sha256, "epoch": weights.epoch, "step": weights.step},
        "not_imported": left,
        "decoder_in_file": found.decoder is not None,
        "twin": None,
        "provenance": provenance(),
    }
    folder = Path(out) if out is not None else Path(f"{found.architecture}-{weights.sha256[:8]}")
    options = {"classes": found.classes, "decoder": found.decoder or "linear"}
    counts = {part: len(names) for part, names in left.items()}
    card = _card(weights, found, counts)
    save_checkpoint(folder, model, architecture=found.architecture, options=options, info=facts, card=card)
    in_file = [value for name, value in model.named_parameters() if found.decoder or not name.startswith("decoder.")]
    parameters = sum(value.numel() for value in in_file)
    told = (found.architecture, found.decoder, found.objective, parameters, counts, weights.sha256)
    return ImportedModel(folder, f"local-dir:{folder}", *told)


def import_to_cache(path: Path, config: Path | None = None) -> Path:
    """Import a file into the cache, once for each content, and return its folder; a damaged one is made again."""
    folder = cache_dir("imported") / content_hash(path, config)
    files = [folder / name for name in (WEIGHTS, CONFIG)]
    if not all(map(is_sealed, files)):
        if files[0].exists():
            _LOG.warning("The imported model in the cache, %s, is damaged and is made again", folder)
        import_checkpoint(path, config=config, out=folder)
        for file in files:
            seal_file(file)
    return folder


def build_published(state: Mapping[str, torch.Tensor], found: Recognised) -> tuple[EncoderAttenderDecoder, set[str]]:
    """Build a recognised network with its weights; return it with the names of the entries that it took."""
    name = found.architecture
    model = load_model(name, classes=found.classes, decoder=found.decoder or "linear")
    if not isinstance(model, EncoderAttenderDecoder):
        raise DataError(f"{name!r} is no architecture of the study, so published weights cannot be read into it.")
    targets = matched_entries(state, model, found)
    copy_named(targets, {key: state[key].reshape(target.shape) for key, target in targets.items()})
    for index, block in enumerate(model.encoder.blocks if isinstance(model.encoder, S4Encoder) else ()):
        _adapt_s4(block.memory, int(state.get(f"model.encoder.s4_layers.{index}.layer.kernel.l_kernel", 0)))
    model.normaliser.load_state_dict(Normaliser.physical(force=PUBLISHED_FORCE_SCALE).state_dict())
    return model, set(targets)


def matched_entries(
    state: Mapping[str, torch.Tensor], model: EncoderAttenderDecoder, found: Recognised
) -> dict[str, torch.Tensor]:
    """Return the entries of a file that are a network's weights, each with its place in ours."""
    places, names = model.state_dict(), published_names(model)
    if found.decoder is None:
        names = {ours: theirs for ours, theirs in names.items() if not ours.startswith("decoder.")}
    targets = {theirs: places[ours] for ours, theirs in names.items()}
    # Axes of length one are the authors' layout; all else must agree.
    shapes = {theirs: _squeezed(target) for theirs, target in targets.items()}
    others = _others(state, targets)
    given = {key: value.reshape(_squeezed(value)) for key, value in state.items() if key not in others}
    check_named(shapes, given, what=f"the architecture {found.architecture!r}")
    return targets


@torch.no_grad()
def _adapt_s4(memory: StateSpace, steps: int) -> None:
    """Turn the stored form of poles and readout into ours."""
    memory.frequency.neg_()  # theirs are the poles with negative frequency
    if steps:
        memory.readout.copy_(stored_readout(memory.transition(), memory.readout, steps, undo=True))


def _others(state: Mapping[str, torch.Tensor], used: Iterable[str]) -> list[str]:
    """Return entries that are no weights of the network: heads, masks, lengths."""
    no_weights = (name for name in state if name.startswith("loss.") or name.endswith((".attn.bias", ".l_kernel")))
    return [name for name in no_weights if name not in used]


def _squeezed(value: torch.Tensor) -> tuple[int, ...]:
    return tuple(size for size in value.shape if size != 1)


def _card(weights: ForeignWeights, found: Recognised, left: Mapping[str, int]) -> str:
    rows = {
        "architecture": found.architecture,
        "objective": found.objective or "not told by the file",
        "origin": f"{weights.path.name}, SHA-256 {weights.sha256}",
        "trained for": f"{weights.epoch} epochs, {weights.step} steps (as the file says)" if weights.epoch else None,
        "input": "sweeps [B, T, 30, 5, 7] in N and N·m; the network itself sees mN and µN·m, as published",
        "decoder": found.decoder or "not in the file: a linear one with weights drawn from seed 0",
        "not imported": "; ".join(f"{part}: {count} entries" for part, count in left.items()) or "nothing",
        "untrained twin": "unknown",
        "licence": "that of the file's authors",
    }
    table = "".join(f"| {name} | {told} |\n" for name, told in rows.items() if told)
    return f"# {found.architecture}\n\nPublished weights, imported by brainbench.\n\n| | |\n|---|---|\n{table}"
