"""The model's side of a score: find the model, run it on the stimuli, reduce its layers to features."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import UsageError, check_each
from brainbench.core.files import file_hash
from brainbench.core.progress import Progress
from brainbench.core.reading.regular import readable
from brainbench.core.records import Interval, ModelCard

if TYPE_CHECKING:
    import torch
    from numpy.typing import NDArray

    from brainbench.scoring.options import ScoreOptions
    from brainbench.stimuli import Stimuli

_LOG = logging.getLogger(__name__)
DEFAULT_STIMULI = "rodgers"
RAW_INPUT = "raw input"  # name of the first baseline, which is the first control of the unique part too
RANDOM_FEATURES = 512  # width of the random-features baseline
_ELSEWHERE = "features computed elsewhere"


@dataclass(frozen=True, eq=False)
class LayerFeatures(Mapping[str, Any]):
    """What is made of each layer when it is asked for: all at once would take the memory of the activations again."""

    activations: Mapping[str, NDArray[np.floating]]
    reduce: Callable[[NDArray[np.floating]], NDArray[np.floating]]

    def __getitem__(self, layer: str) -> NDArray[np.floating]:
        return self.reduce(self.activations[layer])

    def __iter__(self) -> Iterator[str]:
        return iter(self.activations)

    def __len__(self) -> int:
        return len(self.activations)


@dataclass(frozen=True)
class ModelResponses:
    """Activations of one model, with the labels of their rows."""

    card: ModelCard
    labels: tuple[str, ...]
    activations: Mapping[str, NDArray[np.floating]]
    """Layer → [K, T, F], or [K, 1, F] where only the mean over time is needed."""
    time: str
    model_input: NDArray[np.floating] | None = None
    """[K, T, F] what the model received; None for features computed elsewhere."""
    origin: Mapping[str, Any] = field(default_factory=dict)
    """Provenance of stimuli and weights."""
    kinematics: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """What simulated stimuli state of contacts, [K, W] by name."""
    seconds: float | None = None
    """Duration of the stimuli, over which the steps of every layer are spread evenly; None where unknown."""
    stimulus_error: float | None = None
    """Estimated error of the forces of simulated stimuli, as a share of them; None where unknown."""
    stimulus_promise: float | None = None  # error that their fidelity promised (``auto``), if it did

    @property
    def doubts(self) -> tuple[str, ...]:
        """What is to be known of the stimuli that every score of them rests on."""
        from brainbench.stimuli.engines.error_estimates import LARGEST_ERROR

        error, promise = self.stimulus_error or 0.0, self.stimulus_promise
        if error <= LARGEST_ERROR:
            return ()
        bound, advice = f"{LARGEST_ERROR:.0%}", "simulate them with a finer --fidelity, or with --fidelity auto=ERROR"
        size = f"estimated error of {error:.0%}, above {bound}" if math.isfinite(error) else "error that cannot be told"
        if promise is not None:
            advice = "auto has no finer setting that helps" if error > promise else f"take less than auto={promise:g}"
        return (f"the forces of the stimuli have an {size}: {advice}",)

    def features(self, rows: list[int]) -> Mapping[str, NDArray[np.floating]]:
        """Return every layer's features [K, F] of the stimuli ``rows``, made when they are asked for."""
        return LayerFeatures(self.activations, lambda values: reduce_time(values[rows], self.time))

    def baseline_features(self, rows: list[int], seed: int) -> dict[str, dict[str, NDArray[np.floating]]]:
        """Return the raw input and random features of it [K, F], by name and layer; nothing without an input."""
        if self.model_input is None:
            return {}
        raw = self.model_input[rows].astype(np.float64)
        weights = np.random.default_rng(seed).standard_normal((raw.shape[-1], RANDOM_FEATURES)) / np.sqrt(raw.shape[-1])
        return {
            RAW_INPUT: {"input": reduce_time(raw, self.time)},
            "random features": {"random": reduce_time(np.maximum(raw @ weights, 0.0), self.time)},
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

    def committed(self, options: ScoreOptions) -> ModelCard:
        """Return the card with the layer that is committed to; options that do not suit the model are refused."""
        from brainbench.models.activations import check_layers, find_readout

        card, names = self.card, self.activations
        if not options.normalize and (self.module is None or _has_contract(self.module)):
            reads = "was computed elsewhere" if self.module is None else "normalises SI values by itself"
            raise UsageError(f"normalize=False gives SI values to plain modules; {card.name!r} {reads}: leave it out.")
        if options.readout == "published":
            if self.module is None:
                raise UsageError("The published readout needs a network; these are features computed elsewhere.")
            # A committed layer goes by our names; theirs are other arrays, so only the caller can commit to one.
            card, names = replace(card, layer=None), find_readout(options.readout).layers(self.module)
        card = replace(card, layer=options.layer or card.layer)
        check_layers(self.module if names is None else names, filter(None, (*(options.layers or ()), card.layer)))
        if card.layer is not None and options.layers:
            check_each("layer", [card.layer], options.layers)
        return card

    def respond(self, options: ScoreOptions, *, progress: Progress | None = None) -> ModelResponses:
        """Run the model on the stimuli, or take the features that were computed elsewhere."""
        from brainbench.models.activations import extract
        from brainbench.models.proof import is_ours

        card, labels, origin, simulated, model_input = self.committed(options), self.labels, self.origin, None, None
        if labels is None:
            from brainbench.stimuli import load_stimuli

            source = options.stimuli if options.stimuli is not None else DEFAULT_STIMULI
            simulated = load_stimuli(source, whiskers=options.whiskers, fidelity=options.fidelity, progress=progress)
            stated = {name: getattr(simulated, name) for name in ("description", "content_hash", "config_hash")}
            backend = None if simulated.dataset is None else simulated.dataset.attrs.get("backend")
            stated |= {"backend": str(backend)} if backend else {}
            labels, origin = simulated.labels, {**origin, "stimuli": stated}
        if self.module is None or simulated is None:
            computed = self.activations or {}
            wanted = options.layers or computed
            activations = {layer: _as_steps(layer, computed[layer], len(labels)) for layer in wanted}
        else:
            values, comparable, note = _network_input(self.module, simulated, options.normalize)
            if card.objective not in (None, "untrained") and (difference := _unlike_training(self.module, simulated)):
                _LOG.warning("%s was trained on other stimuli: here %s.", card.name, difference)
                note += f"; unlike its training: {difference}"
            averaged = partial(np.mean, axis=1, keepdims=True, dtype=np.float64)
            activations = extract(
                self.module,
                values,
                layers=options.layers,
                readout=options.readout,
                reduce=averaged if options.time == "mean" and not options.over_time else None,
                memory=options.memory,
            )
            if options.readout == "default" and not is_ours(self.module):
                origin = {**origin, "reading": activations.report.stated}
            card = replace(card, input=note)
            steps = comparable if comparable.ndim > 2 else comparable[:, None, :]
            model_input = steps.reshape(*steps.shape[:2], -1)
        seconds = None if simulated is None else _seconds(simulated)
        kinematics = {} if simulated is None else contact_kinematics(simulated.dataset)
        errors = () if simulated is None else (simulated.error, simulated.promise)
        return ModelResponses(
            card, labels, activations, options.time, model_input, origin, kinematics, seconds, *errors
        )


def follows_seed(model: Any) -> bool:
    """Return whether the weights of a model follow from a seed: those of untrained networks, by name or from a file.

    Trained weights, activations and models in memory are what they are.
    """
    from brainbench.models.recipes import Architecture, is_path
    from brainbench.models.training.checkpoints import PREFIXES

    if not isinstance(model, str) or model.startswith(PREFIXES) or Path(model).suffix.lower() in (".h5", ".hdf5"):
        return False
    return is_path(model) or Architecture.parse(model).tag is None


def resolve_model(model: Any, *, seed: int = 0) -> ResolvedModel:
    """Find what ``model`` names, and load it; see :func:`brainbench.scoring.scores.score`."""
    if isinstance(model, Mapping):
        return ResolvedModel(ModelCard("features", family=_ELSEWHERE), activations=model)
    if isinstance(model, (str, os.PathLike)) and Path(model).suffix.lower() in (".h5", ".hdf5"):
        from brainbench.models.features import read_features

        path = Path(model)
        features = read_features(path)
        card = ModelCard(path.stem, family=_ELSEWHERE, weights=file_hash(path))
        return ResolvedModel(card, None, features.activations, features.labels, {"features": path.name})
    from brainbench.models.registry import load_user_model, locate_model
    from brainbench.models.training.checkpoints import CONFIG, PREFIXES

    is_code = isinstance(model, str) and not model.startswith(PREFIXES) and (":" in model or model.endswith(".py"))
    # A name that stands for nothing is told before PyTorch is imported.
    entry = locate_model(model) if isinstance(model, str) and not is_code else None
    import torch

    from brainbench.models.ops.layers import check_weights, weights_hash
    from brainbench.models.proof import unwrapped
    from brainbench.models.zoo import graph_of

    model = unwrapped(model)
    if isinstance(model, torch.nn.Module):
        module, card = model, ModelCard(type(model).__name__, family="user module")
    elif is_code:
        module = unwrapped(load_user_model(model, seed=seed))
        card = ModelCard(model, family="user module", seed=seed)
    elif entry is None:
        raise UsageError(
            "A model is a registry name, FILE.py:FUNCTION, a file of activations, a mapping of activations or a "
            f"torch.nn.Module; received {type(model).__name__}."
        )
    else:
        module = entry.build(seed)
        count = getattr(module, "multiply_adds", None)
        card = ModelCard(
            model,
            family=entry.record.family,
            encoder=entry.architecture.memory_encoder,
            attender=entry.architecture.attender or "none",
            objective="untrained",
            multiply_adds=count() if count is not None else None,
            seed=seed,
            citation=entry.record.citation or None,
        )
        with readable(f"{model}/{CONFIG}", "configuration of a trained model"):
            card = replace(card, **_trained(entry.trained))
    check_weights(module, card.name)
    count = sum(parameter.numel() for parameter in module.parameters())
    layer = card.layer or getattr(module, "committed_layer", None)
    facts = {"parameters": count, "weights": weights_hash(module), "graph": graph_of(module), "layer": layer}
    return ResolvedModel(replace(card, **facts), module)


def _trained(config: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return what a checkpoint's configuration says of its training, by the fields of a card."""
    if config is None:
        return {}
    evaluation, twin = config.get("evaluation") or {}, config.get("twin_evaluation") or {}
    facts = ("epochs", "published_epochs", "best_epoch", "licence", "version", "evaluated_split")
    stated = {name: config.get(name) for name in facts}
    stated |= {f"{name} top-1": item.get("top1") for name, item in (config.get("baselines") or {}).items()}
    options = {name: value for name, value in (config.get("training") or {}).items() if name not in ("model", "seed")}
    return {
        **{name: config.get(name) for name in ("objective", "augmentation", "seed")},
        "twin": (config.get("twin") or {}).get("name"),
        "layer": config.get("committed_layer"),
        **{name: evaluation.get(name) for name in ("top1", "top5", "collapsed")},
        "accuracy_interval": Interval(**evaluation["interval"]) if evaluation.get("interval") else None,
        "accuracy_data": evaluation.get("data"),
        "twin_top1": twin.get("top1"),
        "twin_interval": Interval(**twin["interval"]) if twin.get("interval") else None,
        "training": {name: value for name, value in {**options, **stated}.items() if value is not None},
    }


def _as_steps(layer: str, values: Any, rows: int) -> NDArray[np.floating]:
    array = np.asarray(values)
    if array.ndim not in (2, 3) or array.shape[0] != rows:
        raise UsageError(f"Layer {layer!r} has shape {list(array.shape)}; expected [{rows}, F] or [{rows}, T, F].")
    return array[:, None, :] if array.ndim == 2 else array


def _seconds(stimuli: Stimuli) -> float | None:
    """Return the duration of simulated stimuli; None for arrays from a file, which do not say it."""
    if stimuli.dataset is None or stimuli.dataset.sizes["time"] < 2:
        return None
    times = stimuli.dataset["time"].values
    return float((times[-1] - times[0]) * len(times) / (len(times) - 1))


def _network_input(module: torch.nn.Module, stimuli: Stimuli, normalize: bool) -> tuple[Any, Any, str]:
    """Return the model's input [K, T, …], the stimuli with forces and moments comparable, and how they were made."""
    given = scaled = stimuli.input
    if stimuli.dataset is not None:
        import torch

        from brainbench.models.network import Normaliser

        with torch.device("cpu"):  # whatever device the program works on
            scaled = Normaliser.physical(given.shape[2] // len(CHANNELS))(torch.from_numpy(given)).numpy()
    if takes_si(module):
        return given, scaled, "SI (N, N·m); normalised inside the model"
    if stimuli.dataset is None:
        return given, scaled, "as given"
    return (scaled, scaled, "forces in 1e-4 N, moments in 1e-6 N·m") if normalize else (given, scaled, "SI (N, N·m)")


def takes_si(module: torch.nn.Module) -> bool:
    """Return whether a module, or a network of ours inside it, normalises SI values by itself."""
    from brainbench.models.network import Normaliser

    return _has_contract(module) or any(isinstance(part, Normaliser) for part in module.modules())


def _has_contract(module: Any) -> bool:
    """Return whether a module is a network of ours, or made like ours."""
    return hasattr(getattr(module, "spec", None), "sample_rate")


def _unlike_training(module: Any, stimuli: Stimuli) -> str:
    """Return how the frames of simulated stimuli differ from those that a network of ours is made for; else ''."""
    spec: Any = getattr(module, "spec", None)
    dataset = stimuli.dataset
    if dataset is None or not _has_contract(module):
        return ""
    differences = []
    gaps, axes = np.diff(dataset["time"].values), dataset.attrs.get("axes", "world")
    if len(gaps) and not math.isclose(rate := 1 / (spec.sub_steps * np.median(gaps)), spec.sample_rate, rel_tol=0.05):
        differences.append(f"{rate:.4g} time steps per second, there {spec.sample_rate:.4g}")
    if not spec.frame.startswith(axes):
        differences.append(f"{axes} axes, there {spec.frame.partition(' ')[0]} axes")
    return " and ".join(differences)


def reduce_time(values: NDArray[np.floating], time: str) -> NDArray[np.floating]:
    """Return [K, T, F] as [K, F'] by the time rule; NaN activations stay NaN, since here nothing is "not recorded"."""
    if time == "mean" and values.shape[1] > 1:
        return values.mean(axis=1, dtype=np.float64)
    flat = values.reshape(len(values), -1)
    return flat.astype(np.float64, copy=False) if time == "mean" else flat


def contact_kinematics(dataset: Any) -> dict[str, NDArray[np.float64]]:
    """Return what a stimulus set states of contacts by name, [K, W]; nothing of a set without contacts.

    *First contact* (s) is the end of the stimulus for a whisker that touches nothing, whose *contact arc* (m along the
    whisker, mean over the contact) is 0; *contact duration* is a share of the stimulus.
    """
    if not {"contact", "contact_arc", "first_contact"} <= set(getattr(dataset, "data_vars", ())):
        return {}
    contact = dataset["contact"].values.astype(bool)
    count = contact.sum(axis=1)
    arc = np.nansum(np.where(contact, dataset["contact_arc"].values, 0.0), axis=1, dtype=np.float64)
    first, time = dataset["first_contact"].values, dataset["time"].values
    return {
        "first contact": np.where(np.isfinite(first), first, float(time[-1])),
        "contact duration": count / contact.shape[1],
        "contact arc": arc / np.maximum(count, 1),
    }
