"""The architecture that the entries of a published file belong to, from their names and shapes alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch

from brainbench.core.errors import DataError, UsageError, listing
from brainbench.models.architecture import Architecture
from brainbench.models.heads import CLASSES
from brainbench.models.published.files import Settings

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
    found = Architecture.parse(name).untrained
    layers = sorted(name for name in state if name.startswith("model.decoder.mlp.") and name.endswith(".weight"))
    decoder, classes = None, CLASSES
    if layers:
        classes, wide = state[layers[-1]].shape[0], state[layers[0]].shape[-1]
        features = 256 if Architecture.parse(found).attender == "gpt" and found.startswith("resnet18") else 512
        decoder = "linear" if len(layers) == 1 else "mlp" if wide == features else "all-steps"
    head = next((objective for begin, objective in _HEADS.items() if _any(state, begin)), None)
    # Only supervised networks were read by a perceptron; a linear layer may be the probe of another objective.
    alone = "supervised" if decoder in ("mlp", "all-steps") else None
    return Recognised(found, decoder, classes, head or settings.objective or alone)


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
