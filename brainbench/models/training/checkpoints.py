"""Trained models as folders: ``model.safetensors``, ``config.json`` and ``README.md`` (the model card).

Nothing in such a folder is executed when it is read. The configuration names the architecture and the
options it was built with; weights may be stored in half precision and are always loaded as float32.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, check_name, listing, needing
from brainbench.core.files import read_mapping, write_json, write_tensors, write_text
from brainbench.core.plugins import load_optional
from brainbench.core.reading.regular import user_path
from brainbench.core.reading.tensors import read_tensors
from brainbench.models.recipes import Architecture

if TYPE_CHECKING:
    from torch import nn

FORMAT = 1
WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "README.md"
LOCAL, HUB = "local-dir:", "hf-hub:"
PREFIXES = (LOCAL, HUB)  # beginnings of a model's name that is a folder or a repository instead of a registry name
DType = Literal["float32", "float16", "bfloat16"]
DTYPES: tuple[DType, ...] = get_args(DType)
FOREIGN, SCORED, SETTINGS = "*.ckpt", "val_best.ckpt", "config.yaml"
_NAME = re.compile(r"\w[\w.+-]{0,249}", re.ASCII)
"""A part of a name on a hub: none leads out of the folder that the hub sends."""
IMPORTERS = "brainbench.checkpoints"
"""Entry points of functions that make a model's folder of a foreign file and its settings (None without any)."""


def save_checkpoint(
    folder: str | os.PathLike[str],
    model: nn.Module,
    *,
    architecture: str,
    options: Mapping[str, Any],
    info: Mapping[str, Any] | None = None,
    card: str = "",
    dtype: str = "float32",
) -> Path:
    """Write a model's folder; each file appears whole or not at all, the weights first, and replaces an earlier one.

    ``architecture`` is a registry name without a tag, ``options`` are the keywords that it was built with, ``info`` is
    what else the configuration keeps (objective, accuracy, data, seed, …), ``dtype`` the precision of the
    floating-point parameters on disk.
    """
    import torch

    check_name("precision of weights", dtype, DTYPES)
    kind = getattr(torch, dtype)
    parameters = {name for name, _ in model.named_parameters()}
    state = {}
    for name, value in model.state_dict().items():
        # Parameters alone are rounded: running averages of batch norm and counters are stored as they are.
        stored = value.detach().cpu().to(kind) if name in parameters else value.detach().cpu()
        # Asked after the rounding: what is finite in float32 may exceed the largest float16, 65,504.
        if stored.is_floating_point() and not torch.isfinite(stored).all():
            raise DataError(f"The weight {name!r} is not finite in {dtype}, so no checkpoint was written to {folder}.")
        state[name] = stored
    folder = Path(folder)
    write_tensors(folder / WEIGHTS, state, format="pt")
    if card:
        write_text(folder / CARD, card)
    stated = {"brainbench_model": FORMAT, "architecture": architecture, "options": dict(options), "dtype": dtype}
    stated["version"] = Architecture.parse(architecture).version
    write_json(folder / CONFIG, {**(info or {}), **stated})
    return folder


def read_config(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the configuration of a model's folder."""
    path = Path(folder) / CONFIG
    if not path.is_file():
        raise DataFileNotFoundError(
            f"There is no {CONFIG} in {os.fspath(folder)!r}; a model's folder has {CONFIG} and {WEIGHTS}, as "
            "brainbench train writes them."
        )
    config = read_mapping(path)
    if (format_number := config.get("brainbench_model")) != FORMAT:
        raise DataError(
            f"{os.fspath(path)!r} is no configuration of a model (format {format_number!r}, expected {FORMAT})."
        )
    if not isinstance(config.get("architecture"), str) or not isinstance(config.get("options"), dict):
        raise DataError(f"{os.fspath(path)!r} lacks the name 'architecture' or the mapping 'options'.")
    version, current = config.get("version", 1), Architecture.parse(config["architecture"]).version
    if version != current:
        raise DataError(
            f"{os.fspath(folder)!r} holds version {version!r} of {config['architecture']!r}; this brainbench computes "
            f"version {current}: train anew with brainbench train, or install the brainbench that made it."
        )
    return config


def load_weights(model: nn.Module, path: str | os.PathLike[str], *, what: str) -> None:
    """Load a safetensors file into a model of the same parameters and buffers; all or nothing."""
    from brainbench.models.ops.layers import load_named

    state = read_tensors(path, f"file of weights for {what!r} (safetensors)")
    load_named(model.state_dict(), state, what=f"the model {what!r}")


def find_folder(source: str) -> Path:
    """Return the folder that ``local-dir:PATH`` or ``hf-hub:OWNER/NAME[/FOLDER][@REVISION]`` names.

    The hub is asked only for a name with its prefix; what it sends is kept in its own cache. A folder with one foreign
    checkpoint (:data:`FOREIGN`) instead of ours is imported into our cache.
    """
    if source.startswith(LOCAL):
        folder = user_path(source.removeprefix(LOCAL))
        return _imported(folder, source)
    place, _, revision = source.removeprefix(HUB).partition("@")
    owner, name, *inner = place.split("/") if "/" in place else ("", "")
    parts = (owner, name, *inner, *filter(None, revision.split("/")))
    if not source.startswith(HUB) or not all(map(_NAME.fullmatch, parts)):
        raise UsageError(f"A folder is local-dir:PATH or hf-hub:OWNER/NAME[/FOLDER][@REVISION]; received {source!r}.")
    with needing("huggingface_hub", extra="hub", purpose="Loading a model from a hub"):
        from huggingface_hub import snapshot_download

    def _download(*names: str) -> Path:
        patterns = ["/".join((*inner, item)) for item in names]
        try:
            root = snapshot_download(f"{owner}/{name}", revision=revision or None, allow_patterns=patterns)
        except Exception as error:
            reason = str(error).strip().partition("\n")[0] or type(error).__name__
            raise DataFileNotFoundError(f"{source!r} could not be had from the hub: {reason}") from error
        return Path(root).joinpath(*inner)

    folder = _download(WEIGHTS, CONFIG, CARD)
    # Foreign checkpoints are large, so they are asked for only where there is none of ours.
    return folder if (folder / CONFIG).is_file() else _imported(_download(FOREIGN, SETTINGS), source)


def _imported(folder: Path, source: str) -> Path:
    """Return a folder of ours as it is, and that of its import for one with a foreign checkpoint."""
    if (folder / CONFIG).is_file():
        return folder
    files = sorted(folder.glob(FOREIGN)) or (sorted(folder.rglob(FOREIGN)) if source.startswith(HUB) else [])
    # Of the files of one run, the study scored this one.
    files = [path for path in files if path == folder / SCORED] or files
    if len(files) > 1:
        raise UsageError(
            f"{source!r} holds {listing([os.fspath(path.relative_to(folder)) for path in files])}; name the folder of "
            "one of them, or import it with: brainbench models import FILE"
        )
    if not files:
        return folder
    importer = load_optional(IMPORTERS, "published", "importer of published weights")
    settings = files[0].with_name(SETTINGS)
    return importer(files[0], settings if settings.is_file() else None) if importer is not None else folder


def shipped() -> dict[str, Path]:
    """Return the folders of the trained models that come with the package, by ``architecture.tag``."""
    root = Path(__file__).parents[1] / "weights"
    return {path.parent.name: path.parent for path in sorted(root.glob(f"*/{CONFIG}"))}
