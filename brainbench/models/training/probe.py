"""The linear probe: how well a linear layer reads classes from a frozen network.

Nothing before the layer changes, so every sweep is encoded once, without augmentation. Features are standardised
over the training sweeps for the optimiser's sake; that map is folded into the layer afterwards, which stays one
linear layer of the raw features. SGD with momentum, learning rate .1, a tenth every 30 epochs, batch 256 (thesis).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import DataError
from brainbench.models.activations import evaluating
from brainbench.models.ops.layers import Linear
from brainbench.models.recipes import BATCH_SIZE, PROBE
from brainbench.models.training.optimizers import make_optimizer, rate_factor


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

    Args:
        model: A network with ``encode`` and ``features``; its weights stay as they are.
        batches: One pass over labelled training sweeps.
        classes: Number of classes.
        epochs: Passes over the features.
        seed: Of the layer's first weights and of the order.
        device: Where the network is.

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
        layer.weight.div_(scale)
        layer.bias.sub_(layer.weight @ mean)
    model.decoder = layer
    return layer
