"""The objectives of training: supervised, SimCLR, SimSiam, autoencoding.

A :class:`Learner` is a network with an objective's head; its forward pass gives the loss of a batch, so that it can
be wrapped for several processes. Letters: B batch, T step, F features.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError, check_name
from brainbench.models.parts import AutoencoderHead, SimCLRHead, SimSiamHead

TEMPERATURE = 0.1
RECONSTRUCTION_WEIGHT = 0.5
SPARSITY_WEIGHT = 1e-4


def nt_xent(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return the normalised temperature-scaled cross-entropy of embeddings [B, D] of two views (Chen et al. 2020).

    Each view must find its partner among the 2 B − 1 others. Over several processes the embeddings of all are
    compared, so the loss is that of one large batch.
    """
    both = functional.normalize(torch.stack((first.float(), second.float()), 1), dim=-1)  # [B, 2, D]
    embeddings = both.flatten(0, 1)
    every, start = _gathered(both)
    every = every.flatten(0, 1)
    row = torch.arange(len(embeddings), device=embeddings.device)
    itself = row + 2 * start
    # Mixed precision would round cosines to three digits before they are divided by the temperature.
    with torch.autocast(embeddings.device.type, enabled=False):
        similarity = embeddings @ every.T / TEMPERATURE
    # A view is no candidate of its own: the softmax runs over the 2 B − 1 others.
    similarity = similarity.index_put(
        (row, itself), torch.full((), -torch.inf, device=embeddings.device).expand(len(embeddings))
    )
    # Both views of a sweep stand side by side, so indices of partners differ in the last bit.
    return functional.cross_entropy(similarity, itself ^ 1)


def simsiam_loss(p1: torch.Tensor, z1: torch.Tensor, p2: torch.Tensor, z2: torch.Tensor) -> torch.Tensor:
    """Return −½ (cos(p1, stop(z2)) + cos(p2, stop(z1))), averaged over [B, D] (Chen & He 2021, equation 4)."""
    # No gradient flows into z: that keeps both branches from one constant answer (Chen & He 2021).
    first = functional.cosine_similarity(p1.float(), z2.detach().float()).mean()
    return -0.5 * (first + functional.cosine_similarity(p2.float(), z1.detach().float()).mean())


def autoencoder_loss(reconstruction: torch.Tensor, target: torch.Tensor, latent: torch.Tensor) -> torch.Tensor:
    """Return .5 mean squared error + 1e-4 mean |latent| (thesis, chapter 3)."""
    # The mean of absolute values makes the latent representation sparse, as the thesis asks (section 3.3.3).
    error = functional.mse_loss(reconstruction.float(), target.float())
    return RECONSTRUCTION_WEIGHT * error + SPARSITY_WEIGHT * latent.float().abs().mean()


class Learner(nn.Module):
    """A network [B, T, C, H, W] in SI → [B, classes] with its objective's head: (views, labels [B]) → loss [].

    Self-supervised objectives need a network with ``encode``, ``features`` and ``normaliser``, as
    :class:`~brainbench.models.network.EncoderAttenderDecoder` has them.
    """

    views: int = 1
    """Augmented views of a batch that the forward pass takes."""
    supervised: bool = False

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model: Any = model
        if not self.supervised and not all(hasattr(model, name) for name in ("encode", "features", "normaliser")):
            raise UsageError(
                f"{type(self).__name__} learns from features, which {type(model).__name__} does not name; train it "
                "supervised, or build it as a brainbench.models.network.EncoderAttenderDecoder."
            )
        if not self.supervised and hasattr(model, "decoder"):
            # The decoder has no part in it and is fitted afterwards, by the linear probe.
            self.model.decoder.requires_grad_(False)


class Supervised(Learner):
    """Cross-entropy of the decoder's answer to the class labels."""

    supervised = True

    def forward(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> torch.Tensor:
        """Return the loss."""
        return functional.cross_entropy(self.model(views[0]).float(), labels)


class SimCLR(Learner):
    """Contrast of two views at the last step's features."""

    views = 2

    def __init__(self, model: nn.Module) -> None:
        super().__init__(model)
        self.head = SimCLRHead(self.model.features)

    def forward(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> torch.Tensor:
        """Return the loss; labels have no part in it."""
        del labels
        return nt_xent(*self.head(self.model.encode(torch.cat(views), last=True)).chunk(2))


class SimSiam(Learner):
    """Prediction of one view's projection from the other's."""

    views = 2

    def __init__(self, model: nn.Module) -> None:
        super().__init__(model)
        self.head = SimSiamHead(self.model.features)

    def forward(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> torch.Tensor:
        """Return the loss; labels have no part in it."""
        del labels
        first, second = self.model.encode(torch.cat(views), last=True).chunk(2)
        # The head sees one view at a time, so its batch norms never mix the statistics of both.
        (z1, p1), (z2, p2) = self.head(first), self.head(second)
        return simsiam_loss(p1, z1, p2, z2)


class Autoencoding(Learner):
    """Reconstruction of every step of the stimulus, in normalised units, from the features.

    Features know a step only after the encoder's latency, so those of step t + latency reconstruct step t.
    """

    def __init__(self, model: nn.Module) -> None:
        super().__init__(model)
        channels, *grid = self.model.spec.input_shape
        self.head = AutoencoderHead(self.model.features, channels=channels, grid=(grid[0], grid[1]))

    def forward(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> torch.Tensor:
        """Return the loss; labels have no part in it."""
        del labels
        x, latency = views[0], self.model.spec.latency
        if x.shape[1] <= latency:
            raise UsageError(
                f"Autoencoding needs sweeps longer than the encoder's latency of {latency} steps; "
                f"received {x.shape[1]}."
            )
        latent = self.model.encode(x)[:, latency:]
        target = self.model.normaliser(x[:, : x.shape[1] - latency])
        return autoencoder_loss(self.head(latent), target, latent)


LEARNERS = {"supervised": Supervised, "simclr": SimCLR, "simsiam": SimSiam, "ae": Autoencoding}


def make_learner(objective: str, model: nn.Module) -> Learner:
    """Join a network and an objective by name."""
    check_name("objective", objective, LEARNERS)
    return LEARNERS[objective](model)


def _gathered(values: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Return the values [B, ...] of all processes and where this one's begin; gradients flow to all."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return values, 0
    from torch.distributed.nn.functional import all_gather

    parts = all_gather(values)
    return torch.cat(tuple(parts)), torch.distributed.get_rank() * len(values)
