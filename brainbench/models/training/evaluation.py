"""The accuracy of a trained network, its collapse, the linear probe that reads classes from it, and baselines.

Nothing before the probe's layer changes, so every sweep is encoded once, without augmentation. Features are
standardised over the training sweeps for the optimiser's sake; that map is folded into the layer afterwards, which
stays one linear layer of the raw features. SGD with momentum, learning rate .1, a tenth every 30 epochs, batch 256
(thesis). Letters: N sweeps, F features.

What is written beside a trained model says it all: its configuration, its card, and its untrained twin. The twin is the
network that the training started from, to the last bit. Nothing of it is stored but its name, its seed and a hash:
``load_model(name, seed=seed)`` draws it again, and the hash shows where another version of PyTorch draws other numbers.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import hash_arrays, provenance, to_plain
from brainbench.core.records import Interval
from brainbench.core.statistics import wilson_interval
from brainbench.models.activations import evaluating
from brainbench.models.network import Normaliser
from brainbench.models.ops.layers import Linear
from brainbench.models.parts import AllStepsDecoder
from brainbench.models.recipes import BATCH_SIZE, PROBE
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.objectives import make_optimizer, rate_factor

RAW, RANDOM, TWIN = CONTROLS = ("raw-input", "random-features", "untrained-twin")
"""Controls of a network's accuracy, each read by the linear probe."""

SPREAD_LIMIT = 0.01
"""A collapsed network's unit-length features scatter by less than this times what random directions do."""


@dataclass(frozen=True)
class Evaluation:
    """Accuracy on a set of labelled sweeps."""

    top1: float
    top5: float
    interval: Interval
    """Interval of ``top1`` (Wilson 1927)."""
    count: int
    """N."""
    predicted: int
    """Number of classes that were ever the first answer."""
    spread: float
    """Standard deviation of unit-length features × √F, averaged: about 1 when spread over the sphere, 0 when one
    point. NaN for a network that names no features."""
    collapsed: bool
    reason: str
    """Reason why it counts as collapsed; empty otherwise."""
    data: str
    """Hash of the sweeps and labels."""

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> Evaluation:
        """Return the evaluation that a file states."""
        spread = values["spread"] if values["spread"] is not None else math.nan
        return cls(**{**values, "spread": spread, "interval": Interval(**values["interval"])})


def topk(answers: torch.Tensor, labels: torch.Tensor, k: int) -> int:
    """Return how many of [N, classes] have their label among the k largest answers.

    Ties count against the network: a constant answer knows nothing. NaN answers are wrong.
    """
    correct = answers.gather(1, labels[:, None])
    # The label's own answer is among those not smaller, so it is taken off.
    ahead = (answers >= correct).sum(1) - 1
    return int(((ahead < k) & torch.isfinite(answers).all(1)).sum())


class SweepsHash:
    """Hash of labelled sweeps, whatever the batches in which they come: after each block, its labels."""

    _BLOCK = 1024  # batch of the published recipes, in which the networks that come with the package were evaluated

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._labels: list[bytes] = []

    def add(self, x: torch.Tensor, labels: torch.Tensor) -> None:
        """Take sweeps [B, ...] and their labels [B]."""
        for sweep, label in zip(x.contiguous().cpu().numpy(), labels.cpu().long().numpy(), strict=True):
            self._digest.update(sweep)
            self._labels.append(label.tobytes())
            if len(self._labels) == self._BLOCK:
                self._end_block()

    def _end_block(self) -> None:
        self._digest.update(b"".join(self._labels))
        self._labels.clear()

    def value(self) -> str:
        """Return the hash of all that came; nothing can be added after it."""
        self._end_block()
        return self._digest.hexdigest()[:16]


def sweeps_hash(batches: Iterable[tuple[torch.Tensor, torch.Tensor]]) -> str:
    """Return the hash of labelled sweeps that :attr:`Evaluation.data` of them would have."""
    digest = SweepsHash()
    for x, labels in batches:
        digest.add(x, labels)
    return digest.value()


def collapse(predicted: int, classes: int, spread: float) -> str:
    """Return why a network counts as collapsed: one class for everything, or features in one point; else ''."""
    if predicted == 1 and classes > 1:
        return "one class is predicted for every sweep"
    if spread < SPREAD_LIMIT:
        return f"the features of all sweeps are nearly equal (spread {spread:.2g})"
    return ""


def evaluate(model: nn.Module, batches: Iterable[tuple[Any, Any]], *, device: Any = None) -> Evaluation:
    """Evaluate a network on labelled batches ([B, T, C, H, W] in SI, [B]), in evaluation mode."""
    encode: Any = getattr(model, "encode", None)
    decoder: Any = getattr(model, "decoder", None)
    digest, seen, first, five = SweepsHash(), 0, 0, 0
    predictions, labelled = set(), set()
    moments: torch.Tensor | None = None
    with evaluating(model), torch.no_grad():
        for x, labels in batches:
            digest.add(x, labels)
            x, labels = x.to(device), labels.to(device).long()
            if encode is not None and decoder is not None:
                # Encoded once for both, the accuracy and the spread of the features.
                features = encode(x)
                answers = decoder(features if isinstance(decoder, AllStepsDecoder) else features[:, -1]).float()
            else:
                features, answers = None, model(x).float()
            if answers.ndim != 2 or len(answers) != len(labels):
                shapes = f"{list(answers.shape)} to {len(labels)} sweeps; expected [batch, classes]"
                raise DataError(f"{type(model).__name__} answers {shapes}.")
            seen += len(labels)
            first += topk(answers, labels, 1)
            # Of five classes or fewer every one would be among the first five: one answer fewer keeps it a test.
            five += topk(answers, labels, min(5, answers.shape[1] - 1))
            predictions.update(answers.argmax(1).tolist())
            labelled.update(labels.tolist())
            if features is not None:
                # Double precision: for collapsed features the variance below is a difference of nearly equal numbers.
                unit = functional.normalize(features[:, -1].double(), dim=1)
                sums = torch.stack((unit.sum(0), unit.square().sum(0)))
                moments = sums if moments is None else moments + sums
    if not seen:
        raise DataError("There is nothing to evaluate on: the data set gave no batch.")
    spread = math.nan
    if moments is not None:
        # A coordinate of a random unit vector in F dimensions has standard deviation 1/√F, so × √F makes it 1.
        mean, square = moments / seen
        spread = float((square - mean.square()).clamp_min(0).sqrt().mean() * math.sqrt(len(mean)))
    reason = collapse(len(predictions), len(labelled), spread)
    return Evaluation(
        top1=first / seen,
        top5=five / seen,
        interval=wilson_interval(first, seen, over="sweeps"),
        count=seen,
        predicted=len(predictions),
        spread=spread,
        collapsed=bool(reason),
        reason=reason,
        data=digest.value(),
    )


def fit_probe(
    model: Any,
    batches: Iterable[tuple[torch.Tensor, torch.Tensor]],
    *,
    classes: int,
    epochs: int,
    seed: int = 0,
    device: torch.device | str | None = None,
    memory: float = math.inf,
) -> nn.Linear:
    """Fit a linear layer [F] → [classes] to the last step's features and put it in place as ``model.decoder``.

    The network, on ``device``, has ``encode``; its weights stay as they are. ``batches`` are one pass over labelled
    training sweeps, ``epochs`` passes over their features. Features of more than ``memory`` bytes are not held: every
    pass asks ``batches`` for the sweeps again and shuffles as many as fit, so they should come in a new order. Raises
    DataError: there are no batches, or the features are not finite; UsageError: there are more features than memory,
    and ``batches`` can be read but once.
    """
    held, pools, count, moments = None, 0, 0, torch.zeros(())
    for held in _feature_pools(model, batches, device, memory):
        pools, count = pools + 1, count + len(held[1])
        for part in held[0].split(BATCH_SIZE):
            # Double precision: the variance below is a difference of sums.
            part = part.double()
            moments = moments.to(part) + torch.stack((part.sum(0), part.square().sum(0)))
    if held is None:
        raise DataError("There is nothing to fit a probe to: the data set gave no batch.")
    if not torch.isfinite(moments).all():
        raise DataError("The features of the training sweeps are not finite, so no probe can be fitted.")
    if pools > 1:
        _check_repeatable(batches, "sweeps whose features do not fit into memory")
        held = None
    center = moments[0] / count
    scale = ((moments[1] / count - center.square()).clamp_min(0) * (count / max(count - 1, 1))).sqrt().float()
    mean = center.float()
    # What hardly varies is left small: blown up, its weights would be too large to be stored.
    scale = scale.clamp_min(max(1e-4 * float(scale.max()), 1e-12))
    generator = torch.Generator().manual_seed(seed)
    layer = Linear(len(mean), classes).to(mean.device)
    with torch.no_grad():
        # Variance 1/fan_in from a generator of its own, so that the probe does not depend on what was drawn before.
        bound = (3.0 / len(mean)) ** 0.5
        layer.weight.copy_((2 * torch.rand(layer.weight.shape, generator=generator) - 1) * bound)
    optimizer = make_optimizer(PROBE.optimizer, layer.parameters(), PROBE.learning_rate)
    for epoch in range(epochs):
        for group in optimizer.param_groups:
            group["lr"] = PROBE.learning_rate * rate_factor(PROBE.schedule, epoch, epochs=epochs)
        for features, labels in [held] if held else _feature_pools(model, batches, device, memory):
            for chosen in torch.randperm(len(labels), generator=generator).to(labels.device).split(BATCH_SIZE):
                optimizer.zero_grad()
                functional.cross_entropy(layer((features[chosen] - mean) / scale), labels[chosen]).backward()
                optimizer.step()
    with torch.no_grad():
        # w·(x − m)/s + b = (w/s)·x + (b − (w/s)·m): standardisation becomes part of the layer.
        layer.weight.div_(scale)
        layer.bias.sub_(layer.weight @ mean)
    model.decoder = layer
    return layer


def _feature_pools(
    model: Any, batches: Iterable[tuple[torch.Tensor, torch.Tensor]], device: Any, memory: float
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield the last step's features [N, F] and labels [N] of one pass, as many together as fit into ``memory``."""
    pool: list[tuple[torch.Tensor, torch.Tensor]] = []
    size = 0
    for x, labels in batches:
        with evaluating(model), torch.no_grad():
            features = model.encode(x.to(device), last=True).float()
        if pool and size + features.nbytes > memory:
            yield torch.cat([item for item, _ in pool]), torch.cat([item for _, item in pool])
            pool, size = [], 0
        pool.append((features, labels.to(device).long()))
        size += features.nbytes
    if pool:
        yield torch.cat([item for item, _ in pool]), torch.cat([item for _, item in pool])


def _check_repeatable(batches: Iterable[Any], what: str) -> None:
    if iter(batches) is batches:
        raise UsageError(
            f"The {what} are read several times, and a {type(batches).__name__} can be read but once; give a list of "
            "batches or an object whose __iter__ starts anew."
        )


class RawInput(nn.Module):
    """Network without weights: its features [B, F] are the whole sweep, in the normaliser's units.

    With a number of ``features`` they are that many fixed random projections of it, rectified (Rahimi & Recht 2008).
    """

    def __init__(self, features: int | None = None, *, seed: int = 0) -> None:
        super().__init__()
        self.features, self.seed = features, seed
        self.weight: torch.Tensor | None = None

    def encode(self, x: torch.Tensor, *, last: bool = False) -> torch.Tensor:
        """Return the features [B, F] of sweeps [B, T, S·C, H, W] in SI, or without ``last`` [B, 1, F]."""
        normaliser = Normaliser.physical(x.shape[2] // len(CHANNELS)).to(x.device)
        flat = normaliser(x.float()).flatten(1)
        if self.features is not None:
            if self.weight is None:
                # On the CPU, so that every device has the same. Variance 2/fan_in keeps the scale behind a rectifier.
                generator = torch.Generator().manual_seed(self.seed)
                weight = torch.randn(flat.shape[1], self.features, generator=generator)
                self.weight = (weight * math.sqrt(2 / flat.shape[1])).to(x.device)
            flat = functional.relu(flat @ self.weight)
        return flat if last else flat[:, None]


def baselines(
    train: Iterable[tuple[torch.Tensor, torch.Tensor]],
    test: Iterable[tuple[torch.Tensor, torch.Tensor]],
    *,
    features: int,
    classes: int,
    epochs: int,
    seed: int = 0,
    device: torch.device | str | None = None,
    memory: float = 2**31,
) -> dict[str, Evaluation]:
    """Evaluate what a linear probe reads without any network: from the raw input, and from random features of it.

    The probe is that of :func:`fit_probe`. Both see all steps of a sweep. Training and test sweeps ([B, T, S·C, H, W]
    in SI, [B]) are read several times; those of training best come in a new order each time. ``features`` is the number
    of random features: as many as the probe of the network beside it sees. Up to ``memory`` bytes of raw sweeps are
    held (about three times as many are used); a larger training set is read again in every pass. Returns evaluations on
    the test sweeps by the names ``raw-input`` and ``random-features``.
    """
    for batches in (train, test):
        _check_repeatable(batches, "sweeps of a baseline")
    evaluations = {}
    for name, reader in ((RAW, RawInput()), (RANDOM, RawInput(features, seed=seed))):
        fit_probe(reader, train, classes=classes, epochs=epochs, seed=seed, device=device, memory=memory)
        evaluations[name] = evaluate(reader, test, device=device)
    return evaluations


def checkpoint_info(
    config: TrainingConfig,
    classes: tuple[str, ...],
    *,
    epochs_done: float | None,
    best_epoch: float | None,
    evaluation: Evaluation | None,
    twin: Mapping[str, Any],
    controls: Mapping[str, Evaluation] | None = None,
    data: Mapping[str, Any] | None = None,
    split: str = "test",
) -> dict[str, Any]:
    """Return what a checkpoint's configuration says beside the architecture, in plain values.

    ``twin`` is what :func:`describe_twin` told of the network before its training, ``controls`` are evaluations of
    :data:`CONTROLS`, ``data`` the :attr:`~brainbench.models.training.batches.Data.summary` of the sweeps, ``split`` the
    part of them that the evaluation is of.
    """
    compared = {name: to_plain(found) for name, found in (controls or {}).items()}
    return {
        "objective": config.objective,
        "augmentation": config.augmentation + (f" + {config.masking:.0%} masking" if config.masking else ""),
        "seed": config.seed,
        "classes": list(classes),
        "epochs": epochs_done,
        "published_epochs": 100,
        "best_epoch": best_epoch,
        "training": dataclasses.asdict(config),
        "evaluation": to_plain(evaluation),
        "twin": dict(twin),
        "licence": "MIT",
        "provenance": provenance(),
        **({"data": dict(data)} if data else {}),
        **({"evaluated_split": split} if split != "test" else {}),
    } | ({"twin_evaluation": compared.pop(TWIN, None), "baselines": compared} if compared else {})


def model_card(config: TrainingConfig, info: Mapping[str, Any]) -> str:
    """Return the text of the model card (Mitchell et al. 2019), in Markdown."""
    model = describe_model(config.model)
    evaluation, data = info["evaluation"], info.get("data")
    repeated = (data or {}).get("test_of_trained_objects", 0)
    tested = (
        f"to test, {repeated:,} of them of objects that were trained on" if repeated else "of other objects to test"
    )
    rows = {
        "architecture": f"{config.model} ({model.citation})",
        "parameters": f"{model.parameters:,} with 117 classes; {len(info['classes'])} classes here",
        "input": "sweeps [B, T, 30, 5, 7] in N and N·m; normalised inside",
        "data": data
        and f"{data['hash']}: {data['train']:,} sweeps to train, {data['validation']:,} to validate, "
        f"{data['test']:,} {tested}; {data['left_out']:,} left out as unstable",
        "epochs": f"{info['epochs']} (published: {info['published_epochs']}); best: {info['best_epoch']}",
        "optimiser": f"{config.optimizer}, {config.schedule}, learning rate {config.learning_rate:g}, batch "
        f"{config.batch_size}, gradients clipped to a norm of {config.clip:g}, {config.precision}",
        "augmentation": info["augmentation"],
        "seed": str(config.seed),
    }
    if evaluation is not None:
        low, high = evaluation["interval"]["low"], evaluation["interval"]["high"]
        read = "linear probe on the frozen network" if config.objective != "supervised" else "its own decoder"
        split = info.get("evaluated_split")
        rows |= {
            "top-1": f"{evaluation['top1']:.3f} [{low:.3f}, {high:.3f}] on {evaluation['count']} sweeps ({read})",
            "beware": split and f"these accuracies are of the {split} sweeps, which chose the weights",
            "top-5": f"{evaluation['top5']:.3f}",
            "test data": evaluation["data"],
            "collapsed": f"yes: {evaluation['reason']}" if evaluation["collapsed"] else "no",
        }
    for name, text in (info.get("baselines") or {}).items():
        rows[name.replace("-", " ")] = f"linear probe: {_top1(text)}"
    twin = info["twin"]
    rows["untrained twin"] = f"{twin['name']}, seed {twin['seed']}{_beside(evaluation, info.get('twin_evaluation'))}"
    rows["licence"] = info["licence"]
    table = "".join(f"| {name} | {told} |\n" for name, told in rows.items() if told)
    return (
        f"# {config.model}.{config.objective}\n\n{model.description}, trained with brainbench: {config.objective}.\n\n"
        f"| | |\n|---|---|\n{table}\n"
        "Trained on simulated touch alone; what it says about brains is what `brainbench score` measures.\n"
    )


def _beside(trained: Mapping[str, Any] | None, twin: Mapping[str, Any] | None) -> str:
    """Return how a twin, read by a linear probe, compares with what was trained."""
    if not trained or not twin:
        return ""
    low, high = twin["interval"]["low"], twin["interval"]["high"]
    if trained["interval"]["low"] > high:
        verdict = "training helped"
    elif trained["interval"]["high"] < low:
        verdict = "**training made it worse**"
    else:
        verdict = "**training changed less than these intervals can tell**"
    return f", linear probe: {_top1(twin)}; {verdict}"


def _top1(evaluation: Mapping[str, Any]) -> str:
    return f"top-1 {evaluation['top1']:.3f} [{evaluation['interval']['low']:.3f}, {evaluation['interval']['high']:.3f}]"


def describe_twin(name: str, seed: int, model: nn.Module) -> dict[str, Any]:
    """Return what a configuration says of a network before its training: how to get it, and what it was.

    ``state`` is a SHA-256 (32 digits) over names, types, shapes and bytes of all parameters and buffers, the decoder's
    included: it belongs to a number of classes.
    """
    state = hash_arrays({key: value.detach().cpu().numpy() for key, value in model.state_dict().items()})
    return {"name": name, "seed": seed, "state": state, "torch": torch.__version__}


def difference(twin: Mapping[str, Any], drawn: Mapping[str, Any]) -> str:
    """Return why a network that was drawn again is not the twin, as :func:`describe_twin` tells of both; else ''."""
    if twin["state"] == drawn["state"]:
        return ""
    return (
        f"{twin['name']} with seed {twin['seed']} is not the network that training started from: PyTorch "
        f"{drawn['torch']} here draws other weights than PyTorch {twin['torch']} there"
    )


def draw_twin(twin: Mapping[str, Any], options: Mapping[str, Any]) -> tuple[nn.Module, str]:
    """Return the twin that a checkpoint's configuration names, and why it is another network after all, or ''.

    ``twin`` and ``options`` are entries of the configuration.
    """
    model = load_model(twin["name"], seed=twin["seed"], **options)
    return model, difference(twin, describe_twin(twin["name"], twin["seed"], model))
