"""The objectives of training (supervised, SimCLR, SimSiam, autoencoding) and how they are lowered.

A :class:`Learner` is a network with an objective's head; its forward pass gives the loss of a batch, so that it can
be wrapped for several processes. Letters: B batch, T step, F features.

Optimisers and learning-rate schedules have the published defaults (thesis, table 3.2). The gradients are compiled, and
on CUDA recorded as a graph: a recurrent network of 22 steps launches some ten thousand kernels per optimiser step, and
on a fast GPU the launching takes longest. A recorded step is launched by one call and reads its inputs from tensors
that stay in place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import nn
from torch.nn import functional
from torch.optim import Optimizer

from brainbench.core.devices import record_step
from brainbench.core.errors import UsageError, check_number
from brainbench.models.cells import Cell, GatedCell
from brainbench.models.encoders import BasicBlock, GPTBlock, MambaBlock, S4Block
from brainbench.models.ops.layers import RECTIFIER_GAIN, Linear, copy_named, perceptron

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

    Heads are left behind after training; their sizes are the published ones at 512 features: SimCLR 1,315,072
    parameters, SimSiam 11,556,352, autoencoder 289,665.

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
        self.head = nn.ModuleDict()


class Supervised(Learner):
    """Cross-entropy of the decoder's answer to the class labels."""

    supervised = True

    def forward(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> torch.Tensor:
        """Return the loss, a scalar of the batch (nats)."""
        return functional.cross_entropy(self.model(views[0]).float(), labels)


HIDDEN = 2048  # width of projections


class SimCLR(Learner):
    """Contrast of two views at the last step's features, projected F → 2048 → 128 (Chen et al. 2020).

    The projection has batch norms, and linear layers without bias.
    """

    views = 2

    def __init__(self, model: nn.Module) -> None:
        super().__init__(model)
        self.head["layers"] = perceptron(self.model.features, HIDDEN, 128, norms=2, use_bias=False)

    def forward(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> torch.Tensor:
        """Return the loss; labels have no part in it."""
        del labels
        return nt_xent(*self.head["layers"](self.model.encode(torch.cat(views), last=True)).chunk(2))


class SimSiam(Learner):
    """Prediction of one view's projection from the other's (Chen & He 2021).

    Projector F → 2048 → 2048 → 2048 and predictor 2048 → 512 → 2048.
    """

    views = 2

    def __init__(self, model: nn.Module) -> None:
        super().__init__(model)
        self.head["projector"] = perceptron(self.model.features, HIDDEN, HIDDEN, HIDDEN, norms=3)
        self.head["predictor"] = perceptron(HIDDEN, 512, HIDDEN, norms=1)

    def forward(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> torch.Tensor:
        """Return the loss; labels have no part in it."""
        del labels
        first, second = self.model.encode(torch.cat(views), last=True).chunk(2)
        # The head sees one view at a time, so its batch norms never mix the statistics of both.
        p1 = self.head["predictor"](z1 := self.head["projector"](first))
        p2 = self.head["predictor"](z2 := self.head["projector"](second))
        return simsiam_loss(p1, z1, p2, z2)


class Autoencoding(Learner):
    """Reconstruction of every step of the stimulus, in normalised units, from the features.

    Features know a step only after the encoder's latency, so those of step t + latency reconstruct step t: a linear
    layer to C/2 channels, and three transposed convolutions.
    """

    def __init__(self, model: nn.Module) -> None:
        super().__init__(model)
        channels, *grid = self.model.spec.input_shape
        check_number("The number of channels of an autoencoder", channels, least=2, whole=True)
        self.shape = (channels // 2, *grid)
        self.head["dense"] = Linear(self.model.features, math.prod(self.shape), gain=RECTIFIER_GAIN)
        self.head["layers"] = layers = nn.Sequential()
        for width in (channels // 2, channels, channels):
            layers.extend((nn.ReLU(), nn.ConvTranspose2d(width, channels, 3, padding=1)))

    def reconstruct(self, features: torch.Tensor) -> torch.Tensor:
        """Return every step [B, T, C, H, W], in normalised units, from its features [B, T, F]."""
        hidden = self.head["dense"](features.flatten(0, -2)).unflatten(-1, self.shape)
        return self.head["layers"](hidden).unflatten(0, features.shape[:-1])

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
        return autoencoder_loss(self.reconstruct(latent), target, latent)


LEARNERS = {"supervised": Supervised, "simclr": SimCLR, "simsiam": SimSiam, "ae": Autoencoding}


def make_learner(objective: str, model: nn.Module) -> Learner:
    """Join a network and an objective by name."""
    return LEARNERS[objective](model)


def _gathered(values: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Return the values [B, ...] of all processes and where this one's begin; gradients flow to all."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return values, 0
    from torch.distributed.nn.functional import all_gather

    parts = all_gather(values)
    return torch.cat(tuple(parts)), torch.distributed.get_rank() * len(values)


MOMENTUM = 0.9
WEIGHT_DECAY = 1e-4
TRUST = 1e-3
STEP_EPOCHS = 30
STEP_FACTOR = 0.1
WARMUP_RATIO = 1e-4


class LARS(Optimizer):
    """SGD with momentum whose step in every tensor is scaled to that tensor's norm (You, Gitman & Ginsburg 2017).

    trust = η ‖w‖ / (‖g + λ w‖), v ← m v + trust (g + λ w), w ← w − lr v, with momentum m, weight decay λ and ``trust``
    η. Biases and norm parameters (tensors of fewer than two axes) are excluded: they take plain momentum steps without
    decay, as in SimCLR.
    """

    def __init__(self, parameters: Iterable[Any], lr: float) -> None:
        options = {"lr": lr, "momentum": MOMENTUM, "weight_decay": WEIGHT_DECAY, "trust": TRUST}
        super().__init__(parameters, options)

    @torch.no_grad()
    def step(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Take one step."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                update = weight.grad
                # Trust ratio η ‖w‖/‖g + λ w‖ of each tensor (You, Gitman & Ginsburg 2017); 1 where either is zero.
                if weight.ndim > 1:
                    update = update + group["weight_decay"] * weight
                    size, length = weight.norm(), update.norm()
                    ratio = group["trust"] * size / length
                    update = update * torch.where((size > 0) & (length > 0), ratio, torch.ones_like(ratio))
                state = self.state[weight]
                if "velocity" not in state:
                    state["velocity"] = torch.zeros_like(weight)
                state["velocity"].mul_(group["momentum"]).add_(update)
                weight.sub_(group["lr"] * state["velocity"])


_MAKERS: Mapping[str, Callable[..., Optimizer]] = {
    "sgd": lambda p, lr: torch.optim.SGD(p, lr=lr, momentum=MOMENTUM, weight_decay=WEIGHT_DECAY),
    "adam": lambda p, lr: torch.optim.Adam(p, lr=lr, weight_decay=WEIGHT_DECAY),
    "adamw": lambda p, lr: torch.optim.AdamW(p, lr=lr, weight_decay=WEIGHT_DECAY),
    "lars": LARS,
}
"""Optimisers by name; each takes parameters and a learning rate."""


def make_optimizer(name: str, parameters: Iterable[nn.Parameter], learning_rate: float) -> Optimizer:
    """Build an optimiser by name over the parameters that want a gradient."""
    return _MAKERS[name]([p for p in parameters if p.requires_grad], learning_rate)


def rate_factor(schedule: str, epoch: float, *, epochs: int, warmup_epochs: int = 0) -> float:
    """Return the learning rate after so many epochs of all, relative to the initial one.

    For ``cosine`` fractions of an epoch count, and ``warmup_epochs`` of linear rise from 1e-4.
    """
    if schedule == "constant":
        return 1.0
    if schedule == "step":
        # StepLR (thesis, table 3.2): a tenth every 30 epochs, constant within them.
        return STEP_FACTOR ** (int(epoch) // STEP_EPOCHS)
    # A run shorter than the published one keeps the share of its warm-up below half.
    warmup = min(warmup_epochs, epochs / 2)
    # Linear rise from the warm-up ratio of table 3.2: steps stay small while gradients are still large.
    if epoch < warmup:
        return WARMUP_RATIO + (1 - WARMUP_RATIO) * epoch / warmup
    # Cosine annealing ½(1 + cos πt) to zero, with t from the end of the warm-up (thesis, table 3.2).
    done = (epoch - warmup) / max(epochs - warmup, 1e-9)
    return 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))


PARTS = (Cell, GPTBlock, MambaBlock, S4Block, BasicBlock)
"""Modules that are compiled on their own: called at every step or block, with few shapes."""


def compiled(module: torch.nn.Module, how: str) -> Any:
    """Return a module compiled in one of the ways of ``TrainingConfig.compile``."""
    if how == "off":
        return module
    if how == "parts":
        for part in module.modules():
            if isinstance(part, PARTS):
                part.compile()
        return module
    if how == "graphs":
        fuse(module)
        return module
    return torch.compile(module)


def fuse(module: nn.Module, on: bool = True) -> None:
    """Fuse what follows the convolutions of all gated cells in a module, or undo it."""
    cells = [part for part in module.modules() if isinstance(part, GatedCell)]
    if on and cells:
        import torch._dynamo

        # One version per width and batch of every cell, for training and for evaluation.
        torch._dynamo.config.recompile_limit = max(torch._dynamo.config.recompile_limit, 64)
    for cell in cells:
        cell.fuse(on)


class Gradients:
    """The loss of a batch, its clipped gradients in the parameters of a module, and their norm.

    What a pass does to the buffers of ``module`` is undone after the runs that precede a recording. ``forward`` is the
    module as it is computed, compiled or wrapped: (views, labels) → loss, in a context that ``autocast`` makes.
    ``clip`` is the largest norm; 0 leaves it alone. With ``record`` the pass is recorded for the shape that comes
    first, and replayed whenever that shape comes again. ``average`` replaces a vector by its mean over several
    processes, each of which then returns the loss and norm of the whole batch.
    """

    def __init__(
        self,
        module: nn.Module,
        forward: Callable[..., Any],
        *,
        clip: float,
        autocast: Callable[[], Any],
        record: bool = False,
        average: Callable[[torch.Tensor], None] | None = None,
    ) -> None:
        self.module, self.forward, self.clip, self.autocast, self.record = module, forward, clip, autocast, record
        self.average = average
        self.parameters = [parameter for parameter in module.parameters() if parameter.requires_grad]
        self._inputs: tuple[torch.Tensor, ...] = ()
        self._kept: list[torch.Tensor | None] = []
        self._found = (torch.empty(()), torch.empty(()))

    def __call__(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (loss, norm of the gradients before clipping), not yet waited for."""
        results = self._pass((*views, labels))
        return results if self.average is None else self._clip(self._averaged(results[0]))

    def _pass(self, given: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        if not self.record:
            return self._compute(given)
        if not self._inputs:
            self._record(given)
        if [item.shape for item in given] != [item.shape for item in self._inputs]:
            return self._compute(given)
        for mine, tensor in zip(self._inputs, given, strict=True):
            mine.copy_(tensor)
        self._replay()
        # The recorded pass writes to these, whatever stood in the parameters meanwhile.
        for parameter, gradient in zip(self.parameters, self._kept, strict=True):
            parameter.grad = gradient
        return self._found

    def _compute(self, given: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        for parameter in self.parameters:
            parameter.grad = None
        with self.autocast():
            loss = self.forward(given[:-1], given[-1])
        loss.backward()
        # The gradient of several processes is clipped once it is the mean of all.
        return self._clip(loss.detach()) if self.average is None else (loss.detach(), loss.detach())

    def _clip(self, loss: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        # One norm over all tensors keeps the direction of the step; an infinite limit measures it alone.
        return loss, torch.nn.utils.clip_grad_norm_(self._trained, self.clip or float("inf"))

    def _averaged(self, loss: torch.Tensor) -> torch.Tensor:
        """Average gradients and loss over processes in one vector: one collective, also beside a recorded pass."""
        gradients = [parameter.grad for parameter in self._trained if parameter.grad is not None]
        vector = torch.cat([*(item.reshape(-1).float() for item in gradients), loss.reshape(1).float()])
        if self.average is not None:
            self.average(vector)
        parts = vector.split([*(item.numel() for item in gradients), 1])
        means = [part.view_as(item) for part, item in zip(parts, gradients, strict=False)]
        torch._foreach_copy_(gradients, means)  # pyright: ignore[reportPrivateImportUsage] - a launch for all
        return parts[-1][0]

    @property
    def _trained(self) -> list[nn.Parameter]:
        return [parameter for parameter in self.parameters if parameter.grad is not None]

    def _record(self, given: tuple[torch.Tensor, ...]) -> None:
        device = given[0].device
        self._inputs = tuple(item.clone() for item in given)
        # The runs before a recording draw random numbers and move averages of batch norm; both are put back after it.
        buffers = {name: value.clone() for name, value in self.module.named_buffers()}
        random = torch.cuda.get_rng_state(device) if device.type == "cuda" else torch.get_rng_state()

        def _work() -> None:
            self._found = self._compute(self._inputs)
            self._kept = [parameter.grad for parameter in self.parameters]

        self._replay = record_step(_work, device)
        if device.type == "cuda":
            torch.cuda.set_rng_state(random, device)
        else:
            torch.set_rng_state(random)
        copy_named(dict(self.module.named_buffers()), buffers)
