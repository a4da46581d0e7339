"""Train one network of the campaign on sweeps that lie in the device's memory, whole steps as CUDA graphs.

Order, rates and losses are tensors on the device; a step is one launch. What is trained is what ``brainbench train``
trains (same learners, augmentations, optimisers, evaluation and checkpoints); the loop is not.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import torch._dynamo

from benchmarks.models.campaign_jobs import RATES, SEARCH_EPOCHS, Job
from benchmarks.models.recorded_optimizer import make_capturable, reset_optimizer
from brainbench.core.cuda_graphs import record_step
from brainbench.core.files import read_json, to_plain, write_json
from brainbench.datasets import WhiskingDataset
from brainbench.models.normaliser import Normaliser
from brainbench.models.ops.parameters import copy_named
from brainbench.models.ops.seeding import seeded
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.augmentation import Augmentation
from brainbench.models.training.card import checkpoint_info, model_card
from brainbench.models.training.checkpoints import WEIGHTS, load_weights, save_checkpoint
from brainbench.models.training.evaluation import baselines, evaluate, fit_probe
from brainbench.models.training.gradients import PARTS, fuse
from brainbench.models.training.objectives import make_learner
from brainbench.models.training.optimizers import make_optimizer, rate_factor
from brainbench.models.training.twins import describe_twin

BEST, RESULT, LOG = "best", "result.json", "log.jsonl"
LARGEST = 100.0
"""Sweeps with a force above 10 mN or a moment above 100 µN·m are failed simulations that were not noticed: usual sweeps
stay five times below."""
HOPELESS = 0.5
"""A job diverges when more than this share of an epoch's steps has a gradient that is not finite."""
PROBED = 8192
"""Sweeps that the probe of a self-supervised try of a learning rate is fitted to."""
_log = logging.getLogger("campaign")


class Split:
    """Sweeps of one split in device memory, normalised and in half precision: [N, T, S·C, H, W]."""

    def __init__(self, folder: Path, split: str, device: torch.device) -> None:
        data = WhiskingDataset(folder, split=split, batch_size=1024, shuffle=False, device=device)
        self.scale = Normaliser.physical().scale.to(device)
        parts, labels = [], []
        for batch in data:
            part = batch.input / self.scale
            good = (part.abs().flatten(1).amax(1) < LARGEST).nonzero()[:, 0]
            parts.append(part[good].half())
            labels.append(batch.label[good].clone())
        self.sweeps, self.labels = torch.cat(parts), torch.cat(labels)
        self.left_out = data.sweeps + data.skipped - len(self.labels)

    def __len__(self) -> int:
        return len(self.labels)

    def take(self, rows: torch.Tensor) -> torch.Tensor:
        """Return chosen sweeps in SI, single precision."""
        return self.sweeps.index_select(0, rows).float() * self.scale

    def batches(self, size: int = 1024, most: int | None = None) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield all sweeps in SI, or the first ``most``, with their labels."""
        for rows in torch.arange(len(self), device=self.labels.device)[:most].split(size):
            yield self.take(rows), self.labels[rows]


class Resident:
    """A data set in device memory."""

    def __init__(self, folder: Path, device: torch.device) -> None:
        manifest = read_json(folder / "manifest.json")
        self.classes = tuple(str(name) for name in manifest["classes"])
        self.hash = str(manifest["content_hash"])
        self.train, self.validation, self.test = (
            Split(folder, name, device) for name in ("train", "validation", "test")
        )

    def summary(self) -> dict[str, Any]:
        """Return what a table says of it."""
        splits = {name: len(getattr(self, name)) for name in ("train", "validation", "test")}
        left_out = sum(getattr(self, name).left_out for name in splits)
        return {"hash": self.hash, "classes": len(self.classes), "left_out": left_out, **splits}


class Trainer:
    """One job on one device, epoch by epoch; the network is at first what its training begins with."""

    def __init__(self, job: Job, data: Resident, device: torch.device) -> None:
        self.job, self.data, self.device = job, data, device
        self.config = job.config(RATES[1])
        self.options = {"classes": len(data.classes), "decoder": self.config.decoder}
        with seeded(job.seed):
            model = load_model(job.model, seed=job.seed, **self.options)
            self.twin = describe_twin(job.model, job.seed, model)
            self.learner: Any = make_learner(job.objective, model).to(device)
        torch.manual_seed(job.seed)  # of dropout
        if device.type == "cuda":
            self.learner = self.learner.to(memory_format=torch.channels_last)
        self.model = self.learner.model
        self.start = {name: value.detach().clone() for name, value in self.learner.state_dict().items()}
        self.rate = torch.zeros((), device=device)
        self.optimizer = make_optimizer(self.config.optimizer, self.learner.parameters(), self.config.learning_rate)
        make_capturable(self.optimizer, self.rate)
        self.bad, self.skipped = torch.zeros(1, device=device), torch.zeros(1, device=device)
        self.optimizer.found_inf = self.bad.view(())  # pyright: ignore[reportAttributeAccessIssue]
        self.trained = [parameter for parameter in self.learner.parameters() if parameter.requires_grad]
        self.augmentation = Augmentation(self.config.augmentation, self.config.masking)
        self.generator = torch.Generator(device).manual_seed(job.seed)
        batch = min(self.config.batch_size, len(data.train))
        self.steps = len(data.train) // batch
        self.cursor = torch.zeros(1, dtype=torch.long, device=device)
        self.order = torch.zeros(self.steps, batch, dtype=torch.long, device=device)
        self.rates, self.losses = torch.zeros(self.steps, device=device), torch.zeros(self.steps, device=device)
        self.best, self.best_epoch = -1.0, 0
        self.kept = {name: value.clone() for name, value in self.start.items()}
        # Compiling takes longer than it saves a small network, except for Mamba's many small kernels (2.7 × as fast).
        worth = not job.architecture.small or job.architecture.attender == "mamba"
        self._record(worth and device.type == "cuda")

    def _record(self, compiled: bool) -> None:
        """Record the training step, its gates and blocks compiled or not; the network is as new afterwards."""
        fuse(self.learner, compiled)
        blocks = [part for part in self.learner.modules() if isinstance(part, PARTS[1:])] if compiled else []
        if blocks:
            # One version for every block of a network; beyond the limit PyTorch would leave the others as they are.
            torch._dynamo.config.recompile_limit = 64
        for block in blocks:
            block.compile(dynamic=False)
        self._set_epoch(0, 1, RATES[0])
        self.learner.train()
        warm_up = 3 if self.device.type == "cuda" else 0
        self.step: Callable[[], Any] = record_step(
            self._step, self.device, generators=(self.generator,), warm_up=warm_up
        )
        # Evaluation has batches of other sizes and would be compiled for each.
        fuse(self.learner, False)
        for block in blocks:
            block._compiled_call_impl = None
        self.restart()

    def restart(self) -> None:
        """Put network and optimiser back to where training begins."""
        copy_named(self.learner.state_dict(), self.start)
        reset_optimizer(self.optimizer)
        self.skipped.zero_()

    def _step(self) -> None:
        rows = self.order.index_select(0, self.cursor)[0]
        x, labels = self.data.train.take(rows), self.data.train.labels.index_select(0, rows)
        self.rate.copy_(self.rates.index_select(0, self.cursor)[0])
        self.optimizer.zero_grad(set_to_none=True)
        with self._autocast():
            views = tuple(self.augmentation(x, self.generator) for _ in range(self.learner.views))
            loss = self.learner(views, labels)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.trained, self.config.clip)
        self.bad.copy_(1 - torch.isfinite(norm).float())  # the optimiser leaves such a step out
        self.skipped.add_(self.bad)
        self.optimizer.step()
        self.losses.index_copy_(0, self.cursor, torch.nan_to_num(loss.detach().float()).view(1))
        self.cursor.add_(1).remainder_(self.steps)

    def _autocast(self) -> torch.autocast:
        # On the processor PyTorch's bf16 gradients of strided convolutions are now and then not finite.
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.device.type == "cuda")

    def _set_epoch(self, epoch: int, epochs: int, rate: float) -> None:
        """Draw the order of an epoch of a training that has so many, with a highest rate."""
        generator = torch.Generator().manual_seed(self.job.seed * 1_000_003 + epoch)
        order = torch.randperm(len(self.data.train), generator=generator)[: self.order.numel()]
        done = [100 * (epoch + step / self.steps) / epochs for step in range(self.steps)]
        factors = [rate_factor(self.config.schedule, value, epochs=100, warmup_epochs=10) for value in done]
        self.order.copy_(order.view_as(self.order))
        self.rates.copy_(rate * torch.tensor(factors))
        self.cursor.zero_()
        self.generator.manual_seed(self.job.seed * 1_000_003 + epoch)

    def train_epoch(self, epoch: int, epochs: int, rate: float) -> float:
        """Train one epoch; return its mean loss."""
        self._set_epoch(epoch, epochs, rate)
        self.learner.train()
        for _ in range(self.steps):
            self.step()
        return float(self.losses.mean())

    def accuracy(self) -> float:
        """Return the share of validation sweeps named rightly: by the decoder, or by a ridge probe of the features."""
        self.learner.eval()
        with torch.no_grad(), self._autocast():
            if self.learner.supervised:
                right = [(self.model(x).argmax(1) == labels).sum() for x, labels in self.data.validation.batches()]
                return float(sum(right)) / len(self.data.validation)
            features, labels = self._features(self.data.train, PROBED)
            checked, wanted = self._features(self.data.validation, None)
        mean, scale = features.mean(0), features.std(0).clamp_min(1e-6)
        x, y = (features - mean) / scale, torch.eye(len(self.data.classes), device=self.device)[labels]
        gram = x.T @ x + 1e-3 * len(x) * torch.eye(x.shape[1], device=self.device)
        answers = ((checked - mean) / scale) @ torch.linalg.solve(gram, x.T @ (y - y.mean(0)))
        return float((answers.argmax(1) == wanted).float().mean())

    def _features(self, split: Split, most: int | None) -> tuple[torch.Tensor, torch.Tensor]:
        pairs = [(self.model.encode(x, last=True).float(), labels) for x, labels in split.batches(most=most)]
        return torch.cat([x for x, _ in pairs]), torch.cat([labels for _, labels in pairs])

    def search(self) -> dict[float, float]:
        """Try every learning rate for the same few epochs; return the validation accuracy by rate."""
        found = {}
        for rate in RATES:
            self.restart()
            for epoch in range(SEARCH_EPOCHS):
                self.train_epoch(epoch, SEARCH_EPOCHS, rate)
            hopeless = float(self.skipped) > HOPELESS * self.steps
            found[rate] = 0.0 if hopeless else self.accuracy()
        self.restart()
        return found

    def keep(self, epoch: int, accuracy: float) -> None:
        """Keep the weights: of the best validation with labels, else the last, since accuracy needs labels."""
        if accuracy > self.best or not self.learner.supervised:
            self.best, self.best_epoch = accuracy, epoch
            for name, value in self.learner.state_dict().items():
                self.kept[name].copy_(value)


def run_job(job: Job, data: Resident, device: torch.device, out: Path, known_rate: float | None) -> dict[str, Any]:
    """Do a job and write its result, its log and its checkpoint.

    Args:
        job: What to do.
        data: The sweeps.
        device: Where they are.
        out: Its folder.
        known_rate: Learning rate that seed 0 of the same network found; None to search.
    """
    out.mkdir(parents=True, exist_ok=True)
    if job.objective == "baseline":
        result = measure_baselines(job, data, device)
    elif not job.trained:
        model = load_model(job.model, seed=job.seed, classes=len(data.classes)).to(device)
        result = _described(job, data) | _evaluated(job, model, data, device)
    else:
        result = _train(job, data, device, out, known_rate)
    write_json(out / RESULT, to_plain(result))
    return result


def _train(job: Job, data: Resident, device: torch.device, out: Path, known_rate: float | None) -> dict[str, Any]:
    began = time.monotonic()
    trainer = Trainer(job, data, device)
    prepared = time.monotonic() - began
    search = trainer.search() if known_rate is None else {}
    rate = max(search, key=search.__getitem__) if known_rate is None else known_rate
    trainer.config = job.config(rate)
    searched = time.monotonic() - began - prepared
    training, status = 0.0, "finished"
    with (out / LOG).open("a", encoding="utf-8") as log:
        for epoch in range(job.epochs):
            start, skipped = time.monotonic(), float(trainer.skipped)
            loss = trainer.train_epoch(epoch, job.epochs, rate)
            seconds = time.monotonic() - start
            training += seconds
            line = {"job": job.name, "epoch": epoch + 1, "loss": loss, "seconds": seconds}
            line["sweeps_per_second"] = trainer.order.numel() / seconds
            if float(trainer.skipped) - skipped > HOPELESS * trainer.steps:
                status = "diverged"
            if (epoch + 1) % 3 == 0 or epoch == 0 or status == "diverged":
                line["validation"] = trainer.accuracy()
                trainer.keep(epoch + 1, line["validation"])
            log.write(json.dumps(line) + "\n")
            log.flush()
            if status == "diverged":
                break
    copy_named(trainer.learner.state_dict(), trainer.kept)
    model = trainer.model.to(memory_format=torch.contiguous_format)
    result = _described(job, data) | {
        "learning_rate": rate,
        "search": search,
        "status": status,
        "best_epoch": trainer.best_epoch,
        "skipped_steps": float(trainer.skipped),
        "training_seconds": training,
        "sweeps_per_second": trainer.order.numel() * (epoch + 1) / training,
        "twin": trainer.twin,
    }
    began = time.monotonic()
    result |= _published(job, trainer, model, result, out)
    result["seconds"] = {"prepare": prepared, "search": searched, "train": training, "probe": time.monotonic() - began}
    return result


def _published(job: Job, trainer: Trainer, model: Any, known: dict[str, Any], out: Path) -> dict[str, Any]:
    """Write a network in half precision, load it again, probe and evaluate it; return what was found."""

    def write(found: dict[str, Any]) -> None:
        info = checkpoint_info(
            trainer.config,
            trainer.data.classes,
            epochs_done=job.epochs,
            best_epoch=trainer.best_epoch,
            evaluation=found.get("evaluation"),
            twin=trainer.twin,
            data=known["data"],
        )
        info |= {"search": known["search"]}
        save_checkpoint(
            out / BEST, model, architecture=job.model, options=trainer.options, info=to_plain(info),
            card=model_card(trainer.config, info), dtype=trainer.config.weights_dtype,
        )  # fmt: skip

    write({})
    load_weights(model, out / BEST / WEIGHTS, what=job.model)
    found = _evaluated(job, model, trainer.data, trainer.device)
    write(found)
    return found


def _evaluated(job: Job, model: Any, data: Resident, device: torch.device) -> dict[str, Any]:
    """Evaluate a network, after a probe was fitted to it if it did not learn from labels."""
    if job.objective != "supervised":
        epochs = job.config(RATES[0]).probe_epochs if job.trained else 40
        fit_probe(model, data.train.batches(), classes=len(data.classes), epochs=epochs, seed=job.seed, device=device)
    return {
        "evaluation": evaluate(model, data.test.batches(), device=device),
        "validation": evaluate(model, data.validation.batches(), device=device).top1,
    }


def _described(job: Job, data: Resident) -> dict[str, Any]:
    return {
        "name": job.name,
        **dataclasses.asdict(job),
        "epochs": job.epochs if job.trained else 0,
        "parameters": describe_model(job.model).parameters,
        "status": "finished",
        "data": data.summary(),
    }


def measure_baselines(job: Job, data: Resident, device: torch.device) -> dict[str, Any]:
    """Return how well linear probes read the raw input and random features of it, as many as a small network has."""
    found = baselines(
        _Repeated(data.train), _Repeated(data.test), features=96, classes=len(data.classes), epochs=40, device=device,
        memory=2**34,
    )  # fmt: skip
    return {"name": job.name, "objective": job.objective, "evaluations": found, "data": data.summary()}


@dataclasses.dataclass(frozen=True)
class _Repeated:
    """The batches of a split, as often as they are asked for."""

    split: Split

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        return self.split.batches()
