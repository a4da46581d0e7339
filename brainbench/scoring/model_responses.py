"""The model's side of a score: find the model, run it on the stimuli, reduce its layers to features."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.progress import Progress
from brainbench.core.records import ModelCard

if TYPE_CHECKING:
    import torch
    from numpy.typing import NDArray

    from brainbench.stimuli import Stimuli

DEFAULT_STIMULI = "rodgers"
RANDOM_FEATURES = 512
"""Width of the random-features baseline."""
_ELSEWHERE = "features computed elsewhere"


@dataclass(frozen=True)
class ModelResponses:
    """Activations of one model, with the labels of their rows."""

    card: ModelCard
    labels: tuple[str, ...]
    activations: Mapping[str, NDArray[np.floating]]
    """Layer → [K, T, F]."""
    time: str
    model_input: NDArray[np.floating] | None = None
    """[K, T, F] what the model received; None for features computed elsewhere."""
    origin: Mapping[str, Any] = field(default_factory=dict)
    """Provenance of stimuli and weights."""

    def features(self, rows: list[int]) -> dict[str, NDArray[np.floating]]:
        """Every layer's features [K, F] of the stimuli ``rows``."""
        return {layer: _features_of(values[rows], self.time) for layer, values in self.activations.items()}

    def baseline_features(self, rows: list[int], seed: int) -> dict[str, dict[str, NDArray[np.floating]]]:
        """The raw input and random features of it; empty without an input."""
        if self.model_input is None:
            return {}
        raw = self.model_input[rows].astype(np.float64)
        weights = np.random.default_rng(seed).standard_normal((raw.shape[-1], RANDOM_FEATURES)) / np.sqrt(raw.shape[-1])
        return {
            "raw input": {"input": _features_of(raw, self.time)},
            "random features": {"random": _features_of(np.maximum(raw @ weights, 0.0), self.time)},
        }


@dataclass(frozen=True)
class ResolvedModel:
    """A model that was found, before any stimulus is simulated for it."""

    card: ModelCard
    module: torch.nn.Module | None = None
    activations: Mapping[str, Any] | None = None
    """Features computed elsewhere, in place of a module."""
    labels: tuple[str, ...] | None = None
    """Labels of the rows of ``activations``; None when they follow the stimuli."""
    origin: Mapping[str, Any] = field(default_factory=dict)

    def respond(
        self,
        stimuli: Any,
        *,
        whiskers: str,
        fidelity: Any,
        layers: tuple[str, ...] | None,
        normalize: bool,
        time: str,
        progress: Progress | None,
    ) -> ModelResponses:
        """Run the model on the stimuli; see :func:`brainbench.scoring.scores.score_record` for the arguments."""
        if self.activations is not None and self.labels is not None:
            return ModelResponses(self.card, self.labels, _chosen(self.activations, layers), time, origin=self.origin)
        from brainbench.stimuli import load_stimuli

        shown = load_stimuli(stimuli or DEFAULT_STIMULI, whiskers=whiskers, fidelity=fidelity, progress=progress)
        names = ("description", "content_hash", "config_hash")
        told: dict[str, Any] = {name: getattr(shown, name) for name in names}
        if shown.dataset is not None and shown.dataset.attrs.get("backend"):
            told["backend"] = str(shown.dataset.attrs["backend"])
        origin = {**self.origin, "stimuli": told}
        if self.module is None:
            given = {
                layer: _as_steps(layer, item, len(shown.labels)) for layer, item in (self.activations or {}).items()
            }
            return ModelResponses(self.card, shown.labels, _chosen(given, layers), time, origin=origin)
        from brainbench.models.activations import extract

        values, note = _network_input(self.module, shown, normalize)
        activations = extract(self.module, values, layers=layers)
        card = replace(self.card, input=note)
        return ModelResponses(card, shown.labels, activations, time, _baseline_input(shown), origin)


def resolve_model(model: Any, *, seed: int = 0) -> ResolvedModel:
    """Find what ``model`` names, and load it; see :func:`brainbench.scoring.scores.score`.

    Raises:
        UsageError: nothing has this name, or it is no model.
        DataError: a file was found but cannot be used.
    """
    if isinstance(model, Mapping):
        return ResolvedModel(ModelCard("features", family=_ELSEWHERE), activations=model)
    if isinstance(model, (str, os.PathLike)) and Path(model).suffix.lower() in (".h5", ".hdf5"):
        return _features(Path(model))
    import torch

    if isinstance(model, torch.nn.Module):
        return _with_weights(model, ModelCard(type(model).__name__, family="user module"))
    if not isinstance(model, str):
        raise UsageError(
            "A model is a registry name, FILE.py:FUNCTION, a file of activations, a mapping of activations or a "
            f"torch.nn.Module; received {type(model).__name__}."
        )
    from brainbench.models.training.checkpoints import PREFIXES

    if (":" in model and not model.startswith(PREFIXES)) or model.endswith(".py"):
        from brainbench.models.user_models import load_user_model

        return _with_weights(load_user_model(model, seed=seed), ModelCard(model, family="user module", seed=seed))
    from brainbench.models.registry import describe_model, load_model

    known = describe_model(model)
    card = ModelCard(
        model,
        family=known.family,
        encoder=known.architecture.memory_encoder,
        attender=known.architecture.attender or "none",
        objective="untrained",
        multiply_adds=known.multiply_adds,
        seed=seed,
        citation=known.citation or None,
    )
    return _with_weights(load_model(model, seed=seed), card if known.trained is None else _trained(card, known.trained))


def _trained(card: ModelCard, config: Mapping[str, Any]) -> ModelCard:
    """Fill in the card what a checkpoint's configuration says of its training."""
    from brainbench.core.records import Interval

    found = config.get("evaluation") or {}
    twin = config.get("twin_evaluation") or {}
    return replace(
        card,
        objective=config.get("objective"),
        augmentation=config.get("augmentation"),
        top1=found.get("top1"),
        top5=found.get("top5"),
        accuracy_interval=Interval(**found["interval"]) if found.get("interval") else None,
        accuracy_data=found.get("data"),
        collapsed=found.get("collapsed"),
        twin=config.get("twin"),
        twin_top1=twin.get("top1"),
        twin_interval=Interval(**twin["interval"]) if twin.get("interval") else None,
        seed=config.get("seed"),
        training=_training(config),
    )


def _training(config: Mapping[str, Any]) -> dict[str, Any]:
    """What a checkpoint says of its training, without what the card says already."""
    stated = {name: config.get(name) for name in ("epochs", "published_epochs", "best_epoch", "licence")}
    options = {name: value for name, value in (config.get("training") or {}).items() if name not in ("model", "seed")}
    return {name: value for name, value in {**options, **stated}.items() if value is not None}


def _features(path: Path) -> ResolvedModel:
    from brainbench.core.files import file_hash
    from brainbench.models.features import read_features

    features = read_features(path)
    card = ModelCard(path.stem, family=_ELSEWHERE, weights=file_hash(path))
    return ResolvedModel(card, None, features.activations, features.labels, {"features": path.name})


def _chosen(activations: Mapping[str, Any], layers: tuple[str, ...] | None) -> Mapping[str, Any]:
    for layer in layers or ():
        if layer not in activations:
            raise unknown_name("layer", layer, activations)
    return {layer: activations[layer] for layer in layers} if layers else activations


def _as_steps(layer: str, values: Any, rows: int) -> NDArray[np.floating]:
    array = np.asarray(values)
    if array.ndim not in (2, 3) or array.shape[0] != rows:
        raise UsageError(
            f"Layer {layer!r} has shape {list(array.shape)}; expected [K, F] or [K, T, F] with K = {rows}."
        )
    return array[:, None, :] if array.ndim == 2 else array


def _network_input(module: torch.nn.Module, stimuli: Stimuli, normalize: bool) -> tuple[Any, str]:
    """Return the model's input [K, T, …] and a sentence on how it was made."""
    if hasattr(module, "spec"):  # ours, or made like ours: takes SI units
        return stimuli.input, "SI (N, N·m); normalised inside the model"
    if stimuli.dataset is None:
        return stimuli.input, "as given"
    if not normalize:
        return stimuli.input, "SI (N, N·m)"
    return _scaled(stimuli), "forces in 1e-4 N, moments in 1e-6 N·m"


def _scaled(stimuli: Stimuli) -> NDArray[np.float32]:
    import torch

    from brainbench.models.normaliser import Normaliser

    steps = torch.from_numpy(stimuli.input)
    return Normaliser.physical(steps.shape[2] // len(CHANNELS))(steps).numpy()


def _baseline_input(stimuli: Stimuli) -> NDArray[np.floating]:
    """[K, T, F] the raw input in units that make forces and moments comparable."""
    values = stimuli.input if stimuli.dataset is None else _scaled(stimuli)
    steps = values if values.ndim > 2 else values[:, None, :]
    return steps.reshape(*steps.shape[:2], -1)


def _with_weights(module: torch.nn.Module, card: ModelCard) -> ResolvedModel:
    """Fill in the card what the weights tell."""
    import torch

    from brainbench.core.files import content_hash
    from brainbench.models.diagram import graph_of

    lazy = [name for name, value in module.named_parameters() if isinstance(value, torch.nn.UninitializedParameter)]
    if lazy:
        raise UsageError(
            f"{card.name} has lazy layers without weights yet ({', '.join(lazy[:3])}): run it once, on zeros of shape "
            "[1, 22, 30, 5, 7] for instance, before you return it."
        )
    state = {name: value.detach().cpu() for name, value in module.state_dict().items()}
    digest = content_hash(*(part for name in sorted(state) for part in (name, state[name].numpy())))
    count = sum(parameter.numel() for parameter in module.parameters())
    return ResolvedModel(replace(card, parameters=count, weights=digest, graph=graph_of(module)), module)


def _features_of(values: NDArray[np.floating], time: str) -> NDArray[np.floating]:
    """[K, T, F] → [K, F'] by the time rule; NaN activations stay NaN, since here nothing is "not recorded"."""
    return values.reshape(len(values), -1) if time == "concatenate" else values.mean(axis=1, dtype=np.float64)
