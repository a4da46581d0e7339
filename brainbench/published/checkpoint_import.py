"""Names of the published networks' entries for the entries of ours, and the one value that is stored otherwise.

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

import torch

from brainbench.core.errors import DataError
from brainbench.core.files import cache_dir, content_hash, provenance
from brainbench.core.reading.sealed import is_sealed, seal_file
from brainbench.models.encoders import S4Encoder
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.heads import AllStepsDecoder
from brainbench.models.network import PUBLISHED_FORCE_SCALE, EncoderAttenderDecoder, Normaliser
from brainbench.models.ops.parameters import check_named, copy_named
from brainbench.models.ops.state_space import StateSpace
from brainbench.models.registry import load_model
from brainbench.models.training.checkpoints import CONFIG, WEIGHTS, save_checkpoint
from brainbench.published.checkpoint_files import (
    ForeignWeights,
    Recognised,
    read_settings,
    read_weights,
    recognise,
)

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
