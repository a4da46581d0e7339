"""Weights of the published networks: recognised by their entries, and read as those of ours.

A Lightning file keeps a network under ``model.encoder``, ``model.attender`` and ``model.decoder``. Values are equal up
to axes of length one; S4 alone stores its readout after a change of variables for the training's number of steps.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from brainbench.core.errors import DataError, UsageError, brief, listing
from brainbench.core.files import cache_dir, content_hash, file_hash, provenance
from brainbench.core.reading.sealed import is_sealed, seal_file
from brainbench.core.reading.tensors import check_stored, read_checkpoint, read_tensors
from brainbench.core.reading.texts import read_mapping
from brainbench.models.encoders import S4Encoder
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.graph.tnn_import import read_graph
from brainbench.models.network import PUBLISHED_FORCE_SCALE, EncoderAttenderDecoder, Normaliser
from brainbench.models.ops.layers import check_named, copy_named
from brainbench.models.ops.state_space import StateSpace
from brainbench.models.parts import CLASSES, AllStepsDecoder
from brainbench.models.recipes import Architecture
from brainbench.models.registry import load_model
from brainbench.models.training.checkpoints import CONFIG, WEIGHTS, save_checkpoint

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
    """Read a file of weights; nothing in it is executed."""
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
    """Read a run's settings (``config.yaml``, JSON or TOML), or PyTorchTNN's configuration of its graph (JSON)."""
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
    """Name of :data:`brainbench.models.parts.DECODERS`; None in a file without one."""
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


_RESNET = (
    (r"^conv1\.0\.", "conv1."),
    (r"^conv1\.1\.", "bn1."),
    (r"\.norm(\d)\.", r".bn\1."),
    (r"\.shortcut\.", ".downsample."),
    (r"^fc\.2\.", "fc."),
    (r"^", "encoder."),
)
_S4 = (
    (r"^blocks\.(\d+)\.norm\.", r"norms.\1."),
    (r"^blocks\.(\d+)\.mix\.", r"s4_layers.\1.output_linear.0."),
    (r"^blocks\.(\d+)\.memory\.skip$", r"s4_layers.\1.layer.D"),
    (r"^blocks\.(\d+)\.memory\.", r"s4_layers.\1.layer.kernel."),
    (r"\.log_step$", ".inv_dt"),
    (r"\.log_decay$", ".A_real"),
    (r"\.frequency$", ".A_imag"),
    (r"\.low_rank$", ".P"),
    (r"\.drive$", ".B"),
    (r"\.readout$", ".C"),
    (r"^fc\.", "decoder."),
)
_GPT = (
    (r"^action$", "_action_token"),
    (r"^embed\.", "_policy.transformer.wte."),
    (r"^positions$", "_policy.transformer.wpe.weight"),
    (r"^blocks\.", "_policy.transformer.h."),
    (r"\.norm_attention\.", ".ln_1."),
    (r"\.query_key_value\.", ".attn.c_attn."),
    (r"\.project\.", ".attn.c_proj."),
    (r"\.norm_mlp\.", ".ln_2."),
    (r"\.mlp\.0\.", ".mlp.c_fc."),
    (r"\.mlp\.2\.", ".mlp.c_proj."),
    (r"^norm\.", "_policy.transformer.ln_f."),
    (r"^lm_head\.", "_policy.lm_head."),
)
_MAMBA = (
    (r"^blocks\.(\d+)\.(?!norm)", r"layers.\1.mixer."),
    (r"^blocks\.(\d+)\.norm", r"layers.\1.norm"),
    (r"\.expand\.", ".in_proj."),
    (r"\.convolution\.", ".conv1d."),
    (r"\.select\.", ".x_proj."),
    (r"\.step_size\.", ".dt_proj."),
    (r"\.log_decay$", ".A_log"),
    (r"\.skip$", ".D"),
    (r"\.project\.", ".out_proj."),
    (r"^norm\.", "norm_f."),
)
_RULES = {"ResNet18Encoder": _RESNET, "S4Encoder": _S4, "GPTAttender": _GPT, "MambaAttender": _MAMBA}


def published_names(model: EncoderAttenderDecoder) -> dict[str, str]:
    """Return the name in a Lightning file of every entry of a network's state, the normaliser's aside."""
    graph = model.encoder.tnn_parameters() if isinstance(model.encoder, TemporalGraph) else {}
    nodes = {id(value): f"TG.{name}" for name, value in graph.items()}
    names = {}
    for part, module in model.named_children():
        entries = module.state_dict(keep_vars=True) if part != "normaliser" else {}
        for name, value in entries.items():
            theirs = nodes[id(value)] if nodes and part == "encoder" else _renamed(module, name)
            names[f"{part}.{name}"] = f"model.{part}.{theirs}"
    return names


def _renamed(module: torch.nn.Module, name: str) -> str:
    for pattern, theirs in _RULES.get(type(module).__name__, ()):
        name = re.sub(pattern, theirs, name)
    if type(module).__name__ in _RULES:
        return name
    # Decoders: linear layers 0, 1, 2 in the authors' files; ours count the rectifiers between them too.
    owner, _, leaf = name.rpartition(".")
    steps = {"": 0, "first": 0} if isinstance(module, AllStepsDecoder) or not owner else {}
    layer = steps[owner] if owner in steps else (int(owner.removeprefix("rest.")) + owner.startswith("rest.")) // 2
    return f"mlp.{layer}.lin.{leaf}"


def stored_readout(transition: torch.Tensor, readout: torch.Tensor, steps: int, *, undo: bool) -> torch.Tensor:
    """Return S4's readout [H, N, 2] as it is stored for sweeps of ``steps``, C (1 − Ā^steps), or ``undo`` that.

    ``transition`` [H, 2 N, 2 N] is Ā of all states. So adapted, a kernel of that length needs no powers of Ā (Gu et
    al. 2022, appendix C.3); the recurrence needs C itself.
    """
    half = torch.view_as_complex(readout.double().contiguous())
    row = torch.cat((half, half.conj()), 1)[:, None]
    change = torch.eye(row.shape[-1], dtype=row.dtype) - torch.linalg.matrix_power(transition, steps)
    row = torch.linalg.solve(change, row, left=False) if undo else row @ change
    return torch.view_as_real(row[:, 0, : half.shape[1]].resolve_conj()).contiguous()


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
    recognised = recognise(weights.state, settings, architecture)
    model, used = build_published(weights.state, recognised)
    left: dict[str, list[str]] = {}
    for name in _others(weights.state, used):
        part = "self-supervised head" if name.startswith("loss.") else "attention masks and kernel lengths"
        left.setdefault(part, []).append(name)
    facts = {
        "objective": recognised.objective,
        "origin": {"file": weights.path.name, "sha256": weights.sha256, "epoch": weights.epoch, "step": weights.step},
        "not_imported": left,
        "decoder_in_file": recognised.decoder is not None,
        "twin": None,
        "provenance": provenance(),
    }
    folder = Path(out) if out is not None else Path(f"{recognised.architecture}-{weights.sha256[:8]}")
    options = {"classes": recognised.classes, "decoder": recognised.decoder or "linear"}
    counts = {part: len(names) for part, names in left.items()}
    card = _card(weights, recognised, counts)
    save_checkpoint(folder, model, architecture=recognised.architecture, options=options, info=facts, card=card)
    in_file = [
        value for name, value in model.named_parameters() if recognised.decoder or not name.startswith("decoder.")
    ]
    parameters = sum(value.numel() for value in in_file)
    facts_of_file = (
        recognised.architecture,
        recognised.decoder,
        recognised.objective,
        parameters,
        counts,
        weights.sha256,
    )
    return ImportedModel(folder, f"local-dir:{folder}", *facts_of_file)


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


def build_published(
    state: Mapping[str, torch.Tensor], recognised: Recognised
) -> tuple[EncoderAttenderDecoder, set[str]]:
    """Build a recognised network with its weights; return it with the names of the entries that it took."""
    name = recognised.architecture
    model = load_model(name, classes=recognised.classes, decoder=recognised.decoder or "linear")
    if not isinstance(model, EncoderAttenderDecoder):
        raise DataError(f"{name!r} is no architecture of the study, so published weights cannot be read into it.")
    targets = matched_entries(state, model, recognised)
    copy_named(targets, {key: state[key].reshape(target.shape) for key, target in targets.items()})
    for index, block in enumerate(model.encoder.blocks if isinstance(model.encoder, S4Encoder) else ()):
        _adapt_s4(block.memory, int(state.get(f"model.encoder.s4_layers.{index}.layer.kernel.l_kernel", 0)))
    model.normaliser.load_state_dict(Normaliser.physical(force=PUBLISHED_FORCE_SCALE).state_dict())
    return model, set(targets)


def matched_entries(
    state: Mapping[str, torch.Tensor], model: EncoderAttenderDecoder, recognised: Recognised
) -> dict[str, torch.Tensor]:
    """Return the entries of a file that are a network's weights, each with its place in ours."""
    places, names = model.state_dict(), published_names(model)
    if recognised.decoder is None:
        names = {ours: theirs for ours, theirs in names.items() if not ours.startswith("decoder.")}
    targets = {theirs: places[ours] for ours, theirs in names.items()}
    # Axes of length one are the authors' layout; all else must agree.
    shapes = {theirs: _squeezed(target) for theirs, target in targets.items()}
    others = _others(state, targets)
    given = {key: value.reshape(_squeezed(value)) for key, value in state.items() if key not in others}
    check_named(shapes, given, what=f"the architecture {recognised.architecture!r}")
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


def _card(weights: ForeignWeights, recognised: Recognised, left: Mapping[str, int]) -> str:
    rows = {
        "architecture": recognised.architecture,
        "objective": recognised.objective or "not told by the file",
        "origin": f"{weights.path.name}, SHA-256 {weights.sha256}",
        "trained for": f"{weights.epoch} epochs, {weights.step} steps (as the file says)" if weights.epoch else None,
        "input": "sweeps [B, T, 30, 5, 7] in N and N·m; the network itself sees mN and µN·m, as published",
        "decoder": recognised.decoder or "not in the file: a linear one with weights drawn from seed 0",
        "not imported": "; ".join(f"{part}: {count} entries" for part, count in left.items()) or "nothing",
        "untrained twin": "unknown",
        "licence": "that of the file's authors",
    }
    table = "".join(f"| {name} | {told} |\n" for name, told in rows.items() if told)
    return f"# {recognised.architecture}\n\nPublished weights, imported by brainbench.\n\n| | |\n|---|---|\n{table}"
