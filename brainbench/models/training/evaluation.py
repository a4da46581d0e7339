"""How well a trained network tells classes apart, and whether it has collapsed.

Letters: N sweeps, F features.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError
from brainbench.core.records import Interval

if TYPE_CHECKING:
    import torch
    from torch import nn

SPREAD_LIMIT = 0.01
"""A collapsed network's unit-length features scatter by less than this times what random directions do."""


@dataclass(frozen=True)
class Evaluation:
    """Accuracy on a set of labelled sweeps."""

    top1: float
    top5: float
    interval: Interval
    """Of ``top1`` (Wilson 1927)."""
    count: int
    """N."""
    predicted: int
    """How many classes were ever the first answer."""
    spread: float
    """Standard deviation of unit-length features × √F, averaged: about 1 when spread over the sphere, 0 when one
    point. NaN for a network that names no features."""
    collapsed: bool
    reason: str
    """Why it counts as collapsed; empty otherwise."""
    data: str
    """Hash of the sweeps and labels."""


def wilson(correct: int, count: int, *, level: float = 0.95) -> Interval:
    """Return Wilson's score interval of a proportion.

    Raises:
        DataError: there is nothing to count.
    """
    from statistics import NormalDist

    if count < 1:
        raise DataError("A proportion needs at least one observation.")
    z = NormalDist().inv_cdf(0.5 + level / 2)
    share = correct / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return Interval(max(0.0, middle - half), min(1.0, middle + half), level, "Wilson score")


def topk(answers: torch.Tensor, labels: torch.Tensor, k: int) -> int:
    """Return how many of [N, classes] have their label among the k largest answers.

    Ties count against the network: a constant answer knows nothing. NaN answers are wrong.
    """
    import torch

    own = answers.gather(1, labels[:, None])
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
    import hashlib

    import torch

    from brainbench.models.activations import evaluating
    from brainbench.models.heads.decoders import AllStepsDecoder

    encode: Any = getattr(model, "encode", None)
    decoder: Any = getattr(model, "decoder", None)
    digest, seen, first, five = hashlib.sha256(), 0, 0, 0
    predictions, labelled = set(), set()
    moments: list[torch.Tensor] = []
    with evaluating(model), torch.no_grad():
        for x, labels in batches:
            digest.update(x.contiguous().cpu().numpy().tobytes() + labels.cpu().long().numpy().tobytes())
            x, labels = x.to(device), labels.to(device).long()
            if encode is not None and decoder is not None:
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
            five += topk(answers, labels, min(5, answers.shape[1] - 1))
            predictions.update(answers.argmax(1).tolist())
            labelled.update(labels.tolist())
            if features is not None:
                unit = torch.nn.functional.normalize(features[:, -1].double(), dim=1)
                sums = torch.stack((unit.sum(0), unit.square().sum(0)))
                moments = [sums if not moments else moments[0] + sums]
    if not seen:
        raise DataError("There is nothing to evaluate on: the data set gave no batch.")
    spread = math.nan
    if moments:
        mean, square = moments[0] / seen
        spread = float((square - mean.square()).clamp_min(0).sqrt().mean() * math.sqrt(len(mean)))
    reason = collapse(len(predictions), len(labelled), spread)
    return Evaluation(
        top1=first / seen,
        top5=five / seen,
        interval=wilson(first, seen),
        count=seen,
        predicted=len(predictions),
        spread=spread,
        collapsed=bool(reason),
        reason=reason,
        data=digest.hexdigest()[:16],
    )
