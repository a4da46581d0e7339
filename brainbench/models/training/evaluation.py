"""The accuracy of a trained network, its collapse, and the linear probe that reads classes from it.

Nothing before the probe's layer changes, so every sweep is encoded once, without augmentation. Features are
standardised over the training sweeps for the optimiser's sake; that map is folded into the layer afterwards, which
stays one linear layer of the raw features. SGD with momentum, learning rate .1, a tenth every 30 epochs, batch 256
(thesis). Letters: N sweeps, F features.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import DataError
from brainbench.core.records import Interval
from brainbench.core.statistics import wilson_interval
from brainbench.models.activations import evaluating
from brainbench.models.heads.decoders import AllStepsDecoder
from brainbench.models.ops.layers import Linear
from brainbench.models.recipes import BATCH_SIZE, PROBE
from brainbench.models.training.optimizers import make_optimizer, rate_factor

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
    own = answers.gather(1, labels[:, None])
    # The label's own answer is among those not smaller, so it is taken off.
    ahead = (answers >= own).sum(1) - 1
    return int(((ahead < k) & torch.isfinite(own[:, 0])).sum())


def collapse(predicted: int, classes: int, spread: float) -> str:
    """Return why a network counts as collapsed: one class for everything, or features in one point; else ''."""
    if predicted == 1 and classes > 1:
        return "one class is predicted for every sweep"
    if spread < SPREAD_LIMIT:
        return f"the features of all sweeps are nearly equal (spread {spread:.2g})"
    return ""


def evaluate(model: nn.Module, batches: Iterable[tuple[Any, Any]], *, device: Any = None) -> Evaluation:
    """Evaluate a network on labelled batches ([B, T, C, H, W] in SI, [B]), in evaluation mode.

    Raises:
        DataError: there are no batches, or an answer is not [B, classes].
    """
    encode: Any = getattr(model, "encode", None)
    decoder: Any = getattr(model, "decoder", None)
    digest, seen, first, five = hashlib.sha256(), 0, 0, 0
    predictions, labelled = set(), set()
    moments: torch.Tensor | None = None
    with evaluating(model), torch.no_grad():
        for x, labels in batches:
            digest.update(x.contiguous().cpu().numpy().tobytes() + labels.cpu().long().numpy().tobytes())
            x, labels = x.to(device), labels.to(device).long()
            if encode is not None and decoder is not None:
                # Encoded once for both, the accuracy and the spread of the features.
                features = encode(x)
                answers = decoder(features if isinstance(decoder, AllStepsDecoder) else features[:, -1]).float()
            else:
                features, answers = None, model(x).float()
            if answers.ndim != 2 or len(answers) != len(labels):
                raise DataError(
                    f"{type(model).__name__} answers {list(answers.shape)} to {len(labels)} sweeps; expected "
                    "[batch, classes]."
                )
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
        data=digest.hexdigest()[:16],
    )


def fit_probe(
    model: Any,
    batches: Iterable[tuple[torch.Tensor, torch.Tensor]],
    *,
    classes: int,
    epochs: int,
    seed: int = 0,
    device: torch.device | str | None = None,
) -> nn.Linear:
    """Fit a linear layer [F] → [classes] to the last step's features and put it in place as ``model.decoder``.

    The network, on ``device``, has ``encode`` and ``features``; its weights stay as they are. ``batches`` are one pass
    over labelled training sweeps, ``epochs`` passes over their features.

    Raises:
        DataError: there are no batches, or the features are not finite.
    """
    found, labelled = [], []
    with evaluating(model), torch.no_grad():
        for x, labels in batches:
            found.append(model.encode(x.to(device), last=True).float())
            labelled.append(labels.to(device).long())
    if not found:
        raise DataError("There is nothing to fit a probe to: the data set gave no batch.")
    features, labels = torch.cat(found), torch.cat(labelled)
    if not torch.isfinite(features).all():
        raise DataError("The features of the training sweeps are not finite, so no probe can be fitted.")
    mean, scale = features.mean(0), features.std(0)
    # What hardly varies is left small: blown up, its weights would be too large to be stored.
    scale = scale.clamp_min(max(1e-4 * float(scale.max()), 1e-12))
    features = (features - mean) / scale
    generator = torch.Generator().manual_seed(seed)
    layer = Linear(features.shape[1], classes).to(features.device)
    with torch.no_grad():
        # Variance 1/fan_in from a generator of its own, so that the probe does not depend on what was drawn before.
        bound = (3.0 / features.shape[1]) ** 0.5
        layer.weight.copy_((2 * torch.rand(layer.weight.shape, generator=generator) - 1) * bound)
    optimizer = make_optimizer(PROBE.optimizer, layer.parameters(), PROBE.learning_rate)
    for epoch in range(epochs):
        for group in optimizer.param_groups:
            group["lr"] = PROBE.learning_rate * rate_factor(PROBE.schedule, epoch, epochs=epochs)
        for chosen in torch.randperm(len(labels), generator=generator).to(labels.device).split(BATCH_SIZE):
            optimizer.zero_grad()
            functional.cross_entropy(layer(features[chosen]), labels[chosen]).backward()
            optimizer.step()
    with torch.no_grad():
        # w·(x − m)/s + b = (w/s)·x + (b − (w/s)·m): standardisation becomes part of the layer.
        layer.weight.div_(scale)
        layer.bias.sub_(layer.weight @ mean)
    model.decoder = layer
    return layer
