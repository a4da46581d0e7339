"""The two sides of a score: what the model did with the stimuli, and what the animals did."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.errors import UsageError, listing
from brainbench.types import CHANNELS, ModelCard

if TYPE_CHECKING:
    import torch
    import xarray as xr
    from numpy.typing import NDArray

    from brainbench.metrics import SubjectRDM
    from brainbench.stimuli import Stimuli

Progress = Callable[[int, int, str], None]

DEFAULT_STIMULI = "rodgers"
RDM_METHOD = "correlation"
RANDOM_FEATURES = 512
"""Width of the random-features baseline."""


@dataclass(frozen=True)
class ModelSide:
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

    def rdms(self, rows: list[int]) -> dict[str, NDArray[np.float64]]:
        """Every layer's RDM [P] over the stimuli ``rows``."""
        return {layer: _rdm(values[rows], self.time) for layer, values in self.activations.items()}

    def baseline_rdms(self, rows: list[int], seed: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """RDMs of the raw input and of random features of it; empty without an input."""
        if self.model_input is None:
            return {}
        raw = self.model_input[rows].astype(np.float64)
        weights = np.random.default_rng(seed).standard_normal((raw.shape[-1], RANDOM_FEATURES)) / np.sqrt(raw.shape[-1])
        return {
            "raw input": {"input": _rdm(raw, self.time)},
            "random features": {"relu(input · random)": _rdm(np.maximum(raw @ weights, 0.0), self.time)},
        }


@dataclass(frozen=True)
class BrainSide:
    """Opened recordings."""

    dataset: xr.Dataset

    @property
    def vocabulary(self) -> tuple[str, ...]:
        """Ordered condition labels."""
        return tuple(self.dataset.attrs["vocabulary"])

    @property
    def synthetic(self) -> bool:
        """Whether the recordings were made by a program."""
        return bool(self.dataset.attrs["synthetic"])

    @property
    def origin(self) -> dict[str, Any]:
        """Provenance of the recordings."""
        names = ("source", "content_hash", "window", "selection", "removed", "synthetic")
        return {name: self.dataset.attrs[name] for name in names}

    def animals(self, kept: tuple[str, ...], *, time: str = "mean", seed: int = 0) -> tuple[SubjectRDM, ...]:
        """Every animal's RDM and its split halves over the labels ``kept``, in that order."""
        from brainbench.datasets import blocks
        from brainbench.metrics import TrialBlock, subject_rdm

        index = np.full(len(self.vocabulary), -1)
        index[[self.vocabulary.index(label) for label in kept]] = np.arange(len(kept))
        animals = []
        for subject, sessions in blocks(self.dataset).items():
            trials = []
            for responses, labels, keys in sessions:
                rows = index[labels] >= 0
                features = _without_time(responses[rows], time)
                trials.append(
                    TrialBlock(features, index[labels][rows], [key for key, row in zip(keys, rows, strict=True) if row])
                )
            animals.append(subject_rdm(subject, trials, len(kept), stimuli=kept, method=RDM_METHOD, seed=seed))
        return tuple(animals)


def model_side(
    model: Any,
    stimuli: Any,
    *,
    whiskers: str,
    fidelity: Any,
    layers: tuple[str, ...] | None,
    normalize: bool,
    time: str,
    seed: int,
    progress: Progress | None,
) -> ModelSide:
    """Resolve ``model`` and ``stimuli`` and run one on the other; see :func:`brainbench.scoring.score_record`."""
    if time not in ("mean", "concatenate"):
        raise UsageError(f"Unknown time rule {time!r}; allowed: 'mean', 'concatenate'.")
    if (path := _features_file(model)) is not None:
        from brainbench.files import file_hash
        from brainbench.models.features import read_features

        features = read_features(path)
        card = ModelCard(path.stem, family="features computed elsewhere", weights=file_hash(path))
        return ModelSide(
            card, features.labels, _chosen(features.activations, layers), time, origin={"features": str(path)}
        )
    from brainbench.stimuli import load_stimuli

    chosen = load_stimuli(stimuli or DEFAULT_STIMULI, whiskers=whiskers, fidelity=fidelity, progress=progress)
    origin = {"stimuli": {"description": chosen.description, "content_hash": chosen.content_hash}}
    if isinstance(model, Mapping):
        activations = {layer: _as_steps(layer, values, len(chosen.labels)) for layer, values in model.items()}
        card = ModelCard("features", family="features computed elsewhere")
        return ModelSide(card, chosen.labels, _chosen(activations, layers), time, origin=origin)
    module, card, own = _resolve(model, seed)
    scaled, note = _network_input(module, chosen, own, normalize)
    from brainbench.models.extract import extract

    activations = extract(module, scaled, layers=layers)
    card = _complete(card, module, note, seed)
    return ModelSide(card, chosen.labels, activations, time, _baseline_input(chosen), origin)


def brain_side(recordings: Any, *, progress: Progress | None, **selection: Any) -> BrainSide:
    """Open recordings; ``"demo"`` is made from the simulated ``rodgers`` stimuli on first use."""
    import xarray as xr

    from brainbench.datasets import open_recordings

    if isinstance(recordings, xr.Dataset):
        from brainbench.types import check_recordings

        return BrainSide(check_recordings(recordings))
    if recordings == "demo":
        recordings = demo_recordings(progress=progress)
    return BrainSide(open_recordings(recordings, **selection))


def demo_recordings(*, progress: Progress | None = None) -> Path:
    """Return the folder of the demo recordings, made once per machine from the ``rodgers`` stimuli."""
    from brainbench.datasets.demo import ensure_demo
    from brainbench.stimuli import get_recipe, simulate

    return ensure_demo(simulate(get_recipe(DEFAULT_STIMULI).scenes, progress=progress), progress=progress)


def join_labels(
    vocabulary: tuple[str, ...],
    labels: tuple[str, ...],
    match: str | os.PathLike[str] | Mapping[str, str | None] | None,
) -> dict[str, str]:
    """Pair recording labels with stimulus labels, in the order of the recordings' vocabulary.

    Args:
        vocabulary: condition labels of the recordings.
        labels: stimulus labels of the model side.
        match: recording label → stimulus label (None drops it), or a file of such pairs. Labels it
            does not name are paired with their equals; without it every label must have an equal.

    Raises:
        UsageError: a label has no partner (both sides are listed), or two share one.
    """
    explicit = read_match(match) if isinstance(match, (str, os.PathLike)) else dict(match or {})
    sides = f"recordings: {listing(vocabulary, limit=40)}; stimuli: {listing(labels, limit=40)}"
    for label, partner in explicit.items():
        if label not in vocabulary:
            raise UsageError(f"The match names {label!r}, which is no label of the recordings ({sides}).")
        if partner is not None and partner not in labels:
            raise UsageError(f"The match pairs {label!r} with {partner!r}, which is no stimulus ({sides}).")
    pairs = {label: explicit.get(label, label) for label in vocabulary}
    pairs = {label: partner for label, partner in pairs.items() if partner is not None}
    alone = [label for label, partner in pairs.items() if partner not in labels]
    unused = [] if explicit else [label for label in labels if label not in pairs.values()]
    if alone or unused:
        raise UsageError(
            "The labels of recordings and stimuli do not match ("
            + "; ".join(
                part
                for part in (
                    f"without a stimulus: {listing(alone, limit=40)}" if alone else "",
                    f"without recordings: {listing(unused, limit=40)}" if unused else "",
                )
                if part
            )
            + f"). The {sides}. Map them with --match FILE (recording label → stimulus label)."
        )
    partners = list(pairs.values())
    for partner in partners:
        if partners.count(partner) > 1:
            raise UsageError(
                f"Two recording labels are paired with the stimulus {partner!r}; pairs must be one to one."
            )
    return {label: str(partner) for label, partner in pairs.items()}


def read_match(path: str | os.PathLike[str]) -> dict[str, str | None]:
    """Read label pairs from JSON or TOML (an object) or CSV (two columns; an empty second one drops).

    Raises:
        UsageError: the file is missing, of another kind, or holds something else.
    """
    import csv
    import tomllib

    from brainbench.files import read_json

    path = Path(path)
    if not path.is_file():
        raise UsageError(f"There is no match file {str(path)!r}.")
    kind = path.suffix.lower()
    if kind == ".json":
        pairs = read_json(path)
    elif kind == ".toml":
        try:
            pairs = tomllib.loads(path.read_text(encoding="utf-8"))
        except tomllib.TOMLDecodeError as error:
            raise UsageError(f"{str(path)!r} is not valid TOML ({error}).") from error
    elif kind == ".csv":
        with path.open(newline="", encoding="utf-8") as stream:
            rows = [row for row in csv.reader(stream) if row]
        if any(len(row) != 2 for row in rows):
            raise UsageError(f"{str(path)!r} must have two columns: recording label, stimulus label.")
        pairs = dict(rows)
    else:
        raise UsageError(f"A match file ends in .json, .toml or .csv; received {path.name!r}.")
    if not isinstance(pairs, dict) or not all(isinstance(value, (str, type(None))) for value in pairs.values()):
        raise UsageError(f"{str(path)!r} must map recording labels to stimulus labels (text, or null to drop one).")
    return {str(key): value or None for key, value in pairs.items()}


def _features_file(model: Any) -> Path | None:
    if isinstance(model, (str, os.PathLike)) and Path(model).suffix.lower() in (".h5", ".hdf5"):
        return Path(model)
    return None


def _chosen(activations: Mapping[str, Any], layers: tuple[str, ...] | None) -> Mapping[str, Any]:
    from brainbench.errors import unknown_name

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


def _resolve(model: Any, seed: int) -> tuple[torch.nn.Module, ModelCard, bool]:
    """Return the module, what is known of it, and whether it is one of ours (takes SI input)."""
    import torch

    if isinstance(model, torch.nn.Module):
        return model, ModelCard(type(model).__name__, family="user module"), hasattr(model, "spec")
    if not isinstance(model, str):
        raise UsageError(
            f"A model is a registry name, FILE.py:FUNCTION, a file of activations, a mapping of activations or a "
            f"torch.nn.Module; received {type(model).__name__}."
        )
    from brainbench.models import registry

    if ":" in model or model.endswith(".py"):
        from brainbench.models.user import load_user_model

        module = load_user_model(model, seed=seed)
        return module, ModelCard(model, family="user module", seed=seed), hasattr(module, "spec")
    record = registry.describe_model(model)
    card = ModelCard(
        model,
        family=record.family,
        objective="untrained",
        parameters=record.parameters,
        multiply_adds=record.multiply_adds,
        seed=seed,
    )
    return registry.load_model(model, seed=seed), card, True


def _network_input(module: torch.nn.Module, stimuli: Stimuli, own: bool, normalize: bool) -> tuple[Any, str]:
    """Return the model's input [K, T, …] and a sentence on how it was made."""
    if own:
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


def _complete(card: ModelCard, module: torch.nn.Module, note: str, seed: int) -> ModelCard:
    import dataclasses

    from brainbench.files import content_hash

    state = {name: value.detach().cpu() for name, value in module.state_dict().items()}
    digest = content_hash(*(part for name in sorted(state) for part in (name, state[name].numpy())))
    count = sum(parameter.numel() for parameter in module.parameters())
    return dataclasses.replace(card, parameters=count, weights=digest, input=note)


def _without_time(values: NDArray[np.floating], time: str) -> NDArray[np.floating]:
    """[R or K, T, F] → [R or K, F'] by the time rule; a step that was not recorded does not count."""
    if time == "concatenate":
        return values.reshape(len(values), -1)
    missing = np.isnan(values)
    if not missing.any():
        return values.mean(axis=1)
    seen = (~missing).sum(axis=1)
    total = np.where(missing, 0.0, values).sum(axis=1)
    return np.divide(total, seen, out=np.full(total.shape, np.nan), where=seen > 0)


def _rdm(values: NDArray[np.floating], time: str) -> NDArray[np.float64]:
    from brainbench.metrics import rdm

    # NaN activations must stay NaN here: on this side nothing is "not recorded".
    flat = values.reshape(len(values), -1) if time == "concatenate" else values.mean(axis=1, dtype=np.float64)
    return rdm(flat, method=RDM_METHOD)
