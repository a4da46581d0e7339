"""Train one network of ``train_zoo.py`` on sweeps that lie in the device's memory, whole steps as CUDA graphs.

Epochs, order, rates and losses are tensors on the device; a step is one launch. What is trained is what ``brainbench
train`` trains (same learners, augmentations, optimisers, evaluation and checkpoints); the loop is not.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from recorded_optimizer import make_capturable, reset_optimizer
from zoo_jobs import Job

from brainbench.core.cuda_graphs import record_step
from brainbench.core.files import read_json, write_json
from brainbench.datasets import WhiskingDataset
from brainbench.models.normaliser import Normaliser
from brainbench.models.ops.seeding import seeded
from brainbench.models.registry import load_model
from brainbench.models.training.augmentation import Augmentation
from brainbench.models.training.card import checkpoint_info, model_card
from brainbench.models.training.checkpoints import WEIGHTS, load_weights, save_checkpoint
from brainbench.models.training.evaluation import evaluate, fit_probe
from brainbench.models.training.gradients import copy_state, fuse
from brainbench.models.training.objectives import make_learner
from brainbench.models.training.optimizers import make_optimizer, rate_factor
from brainbench.models.training.run_folder import load_state, save_state
from brainbench.models.training.twins import describe_twin

STATE, BEST, RESULT, LOG = "state.safetensors", "best", "result.json", "log.jsonl"
EVALUATED = 512
LARGEST = 100.0
"""Sweeps with a force above 10 mN or a moment above 100 µN·m are failed simulations that were not noticed: usual sweeps
stay five times below."""
SAVED = 30.0
"""Seconds between saved states."""
HOPELESS = 0.5
"""A job diverges when more than this share of an epoch's steps has a gradient that is not finite."""
_log = logging.getLogger("train_zoo")


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

    def batches(self, size: int = 1024) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield all sweeps in SI, with their labels."""
        for rows in torch.arange(len(self), device=self.labels.device).split(size):
            yield self.take(rows), self.labels[rows]

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        return self.batches()


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
    """One job on one device, epoch by epoch.

    Args:
        job: What is trained.
        data: The sweeps.
        device: Where they are.
        epochs: Passes over the training sweeps.
        precision: ``bf16`` (mixed) or ``float32`` (TF32 where the device has it).
        batch: Sweeps per step.
        steps: Steps of a pass, for trainings of few epochs; a whole epoch when None. All counts of epochs but
            :attr:`done` are then counts of passes.
    """

    def __init__(
        self,
        job: Job,
        data: Resident,
        device: torch.device,
        epochs: int,
        precision: str,
        batch: int = 256,
        steps: int | None = None,
    ) -> None:
        self.job, self.data, self.device, self.precision = job, data, device, precision
        self.config = dataclasses.replace(job.config(epochs), precision=precision, batch_size=batch)
        self.options = {"classes": len(data.classes), "decoder": self.config.decoder}
        with seeded(job.seed):
            model = load_model(job.model, seed=job.seed, **self.options)
            self.twin = describe_twin(job.model, job.seed, model)
            self.learner: Any = make_learner(job.objective, model).to(device)
        torch.manual_seed(job.seed)  # of dropout
        if device.type == "cuda":
            self.learner = self.learner.to(memory_format=torch.channels_last)
        self.model = self.learner.model
        self.rate = torch.zeros((), device=device)
        self.optimizer = make_optimizer(self.config.optimizer, self.learner.parameters(), self.config.learning_rate)
        make_capturable(self.optimizer, self.rate)
        self.bad, self.skipped = torch.zeros(1, device=device), torch.zeros(1, device=device)
        self.optimizer.found_inf = self.bad.view(())  # pyright: ignore[reportAttributeAccessIssue]
        self.trained = [parameter for parameter in self.learner.parameters() if parameter.requires_grad]
        self.augmentation = Augmentation(self.config.augmentation, self.config.masking)
        self.generator = torch.Generator(device).manual_seed(job.seed)
        # A contrastive loss depends on how many sweeps are compared, and of which classes they are.
        self._checked = min(EVALUATED if self.learner.supervised else batch, len(data.validation))
        whole = max(1, len(data.train) // batch)
        self.steps, self.checks = min(steps or whole, whole), math.ceil(len(data.validation) / self._checked)
        options: dict[str, Any] = {"device": device}
        self.cursor = torch.zeros(1, dtype=torch.long, **options)
        self.order = torch.zeros(self.steps, min(batch, len(data.train)), dtype=torch.long, **options)
        self.rates = torch.zeros(self.steps, **options)
        self.losses = torch.zeros(self.steps, **options)
        self.checked = torch.zeros(1, dtype=torch.long, **options)
        rows = torch.arange(self.checks * self._checked, **options).view(self.checks, -1)
        mixed = torch.randperm(len(data.validation), generator=torch.Generator().manual_seed(job.seed)).to(device)
        self.check_rows, self.check_weights = mixed[rows % len(mixed)], (rows < len(mixed)).float()
        self.found = torch.zeros((), **options)
        self.epoch, self.best, self.best_epoch = 0, math.inf, None
        self.kept: dict[str, torch.Tensor] = {}
        self.refit = steps is not None
        """Whether a supervised network's decoder is fitted anew at the end: a short training hardly moved it."""
        self.seconds = 0.0

    def done(self, passes: int | None) -> float | None:
        """Return how many epochs so many passes are; whole numbers where a pass is an epoch."""
        whole = max(1, len(self.data.train) // self.order.shape[1])
        return passes if passes is None or self.steps == whole else round(passes * self.steps / whole, 1)

    def prepare(self, *, fused: bool = True, graphs: bool = True) -> None:
        """Warm up and capture the training step and the validation step; the network is as new afterwards."""
        # Compiling takes longer than it saves a small network.
        fuse(self.learner, fused and self.job.full and self.device.type == "cuda")
        start = {name: value.detach().clone() for name, value in self.learner.state_dict().items()}
        self._set_epoch(0)
        self.learner.train()
        options: dict[str, Any] = {"generators": (self.generator,), "warm_up": 3 if self.device.type == "cuda" else 0}
        self.step = record_step(self._step, self.device, **options) if graphs else self._step
        self.learner.eval()
        with torch.no_grad():
            self.check = record_step(self._check, self.device, **options) if graphs else self._check
        copy_state(self.learner, start)
        reset_optimizer(self.optimizer)
        self.kept = {name: value.clone() for name, value in self.learner.state_dict().items()}

    def _step(self) -> None:
        rows = self.order.index_select(0, self.cursor)[0]
        x, labels = self.data.train.take(rows), self.data.train.labels.index_select(0, rows)
        self.rate.copy_(self.rates.index_select(0, self.cursor)[0])
        self.optimizer.zero_grad(set_to_none=True)
        with self._autocast():
            loss = self.learner(self._views(x), labels)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.trained, self.config.clip)
        self.bad.copy_(1 - torch.isfinite(norm).float())  # the optimiser leaves such a step out
        self.skipped.add_(self.bad)
        self.optimizer.step()
        self.losses.index_copy_(0, self.cursor, torch.nan_to_num(loss.detach().float()).view(1))
        self.cursor.add_(1).remainder_(self.steps)

    def _check(self) -> None:
        """Count what one batch of the validation sweeps adds: right answers, or the self-supervised loss."""
        rows = self.check_rows.index_select(0, self.checked)[0]
        weights = self.check_weights.index_select(0, self.checked)[0]
        x, labels = self.data.validation.take(rows), self.data.validation.labels.index_select(0, rows)
        with self._autocast():
            if self.learner.supervised:
                self.found.add_(((self.model(x).argmax(1) == labels).float() * weights).sum())
            else:
                loss = self.learner(self._views(x), labels)
                self.found.add_(loss.float())
        self.checked.add_(1).remainder_(self.checks)

    def _views(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(self.augmentation(x, self.generator) for _ in range(self.learner.views))

    def _autocast(self) -> Any:
        return torch.autocast(self.device.type, dtype=torch.bfloat16) if self.precision == "bf16" else nullcontext()

    def _set_epoch(self, epoch: int, start: float = 0.0, stop: float = 0.01) -> None:
        """Draw the order of an epoch that takes training from ``start`` to ``stop``, shares of its whole."""
        config = self.config
        generator = torch.Generator().manual_seed(job_seed(config.seed, epoch))
        order = torch.randperm(len(self.data.train), generator=generator)[: self.order.numel()]
        rates = [
            config.learning_rate
            * rate_factor(
                config.schedule, 100 * (start + (stop - start) * step / self.steps), epochs=100, warmup_epochs=10
            )
            for step in range(self.steps)
        ]
        self.order.copy_(order.view_as(self.order))
        self.rates.copy_(torch.tensor(rates))
        self.cursor.zero_()
        self.generator.manual_seed(job_seed(config.seed, epoch))

    def progress(self, budget: float, epochs: int, epoch_seconds: float) -> float:
        """Return how far training is, from 0 to 1, by time or by epochs; what lacks less than half an epoch is done."""
        done = max(self.seconds / budget, self.epoch / epochs)
        return 1.0 if done + 0.5 * epoch_seconds / budget >= 1.0 or self.epoch >= epochs else done

    def train_epoch(self, start: float, stop: float) -> float:
        """Train one epoch that lies between ``start`` and ``stop`` (0 to 1) in the schedule; return its mean loss."""
        began = time.monotonic()
        self._set_epoch(self.epoch, start, min(stop, 1.0))
        self.learner.train()
        for _ in range(self.steps):
            self.step()
        loss = float(self.losses.mean())
        self.seconds += time.monotonic() - began
        self.epoch += 1
        return loss

    def validate(self) -> float:
        """Return what the best network has least of: 1 − accuracy, or the self-supervised loss; keep the best."""
        self.learner.eval()
        # The same views in every epoch, so that losses can be compared.
        self.generator.manual_seed(job_seed(self.config.seed, -1))
        with torch.no_grad():
            self.checked.zero_()
            self.found.zero_()
            for _ in range(self.checks):
                self.check()
            found = float(self.found)
        score = 1 - found / len(self.data.validation) if self.learner.supervised else found / self.checks
        if score < self.best:
            self.best, self.best_epoch = score, self.epoch
            for name, value in self.learner.state_dict().items():
                self.kept[name].copy_(value)
        return score

    def save(self, path: Path) -> None:
        """Write everything that going on needs."""
        plain = {
            "epoch": self.epoch,
            "epochs": self.config.epochs,
            "precision": self.precision,
            "best": self.best if math.isfinite(self.best) else None,
            "best_epoch": self.best_epoch,
            "seconds": self.seconds,
            "skipped": float(self.skipped),
            "data": self.data.hash,
        }
        for group in self.optimizer.param_groups:
            group["lr"] = float(self.rate)
        save_state(path, _Both(self.learner, self.kept), self.optimizer, plain)
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate

    def load(self, path: Path) -> None:
        """Go on where :meth:`save` was called; after :meth:`prepare`."""
        holder = _Both(self.learner, self.kept)
        rate, flags = self.rate, [dict(group) for group in self.optimizer.param_groups]
        moments = {id(p): dict(self.optimizer.state[p]) for p in self.trained if p in self.optimizer.state}
        plain = load_state(path, holder, self.optimizer)
        # The captured step reads the tensors that were there when it was recorded.
        for parameter in self.trained:
            for key, old in moments.get(id(parameter), {}).items():
                if isinstance(old, torch.Tensor):
                    old.copy_(self.optimizer.state[parameter][key])
                    self.optimizer.state[parameter][key] = old
        for group, old in zip(self.optimizer.param_groups, flags, strict=True):
            group.update({key: value for key, value in old.items() if key != "params"})
            group["lr"] = rate
        self.epoch, self.best_epoch, self.seconds = plain["epoch"], plain["best_epoch"], plain["seconds"]
        self.skipped.fill_(plain["skipped"])
        self.best = plain["best"] if plain["best"] is not None else math.inf

    def finish(self, out: Path) -> dict[str, Any]:
        """Evaluate the best network as it will be shipped; write it."""
        copy_state(self.learner, self.kept)
        fuse(self.learner, False)
        if self.device.type == "cuda":
            self.model = self.model.to(memory_format=torch.contiguous_format)
        return publish(self, out)


class _Both(torch.nn.Module):
    """A learner and its best weights so far, as one thing to be saved."""

    def __init__(self, learner: torch.nn.Module, kept: dict[str, torch.Tensor]) -> None:
        super().__init__()
        self.learner = learner
        for index, value in enumerate(kept.values()):
            self.register_buffer(f"kept{index}", value)


def job_seed(seed: int, epoch: int) -> int:
    """Return the seed of the order of an epoch."""
    return seed * 1_000_003 + epoch


def publish(trainer: Trainer, out: Path) -> dict[str, Any]:
    """Write a network in half precision, load it again, probe and evaluate it; return what was found."""
    job, model, config, data, device = trainer.job, trainer.model, trainer.config, trainer.data, trainer.device
    options, epochs, best_epoch = trainer.options, trainer.done(trainer.epoch), trainer.done(trainer.best_epoch)

    def write(evaluation: Any) -> None:
        info = checkpoint_info(
            config,
            data.classes,
            epochs_done=epochs,
            best_epoch=best_epoch,
            evaluation=evaluation,
            twin=trainer.twin,
        )
        info |= {"data": data.summary(), "refit_decoder": trainer.refit and job.objective == "supervised"}
        card = model_card(config, info)
        save_checkpoint(
            out / BEST, model, architecture=job.model, options=options, info=info, card=card, dtype="float16"
        )

    write(None)
    load_weights(model, out / BEST / WEIGHTS, what=job.model)
    if job.objective != "supervised" or trainer.refit:
        fit_probe(
            model,
            data.train.batches(),
            classes=len(data.classes),
            epochs=config.probe_epochs,
            seed=job.seed,
            device=device,
        )
        write(None)
        load_weights(model, out / BEST / WEIGHTS, what=job.model)
    found = evaluate(model, data.test.batches(), device=device)
    checked = evaluate(model, data.validation.batches(), device=device)
    write(found)
    return {
        "job": dataclasses.asdict(job),
        "name": job.name,
        "epochs": epochs,
        "best_epoch": best_epoch,
        "evaluation": dataclasses.asdict(found),
        "validation": checked.top1,
        "data": data.summary(),
    }


def evaluate_as_is(job: Job, data: Resident, out: Path, device: torch.device) -> dict[str, Any]:
    """Evaluate a network of the package with its own decoder, or probe and evaluate one as it was drawn."""
    model = load_model(job.model, seed=job.seed, classes=len(data.classes)).to(device)
    if job.objective == "untrained":
        config = Job(job.model, "simclr", seed=job.seed).config(1)
        probed = {"classes": len(data.classes), "epochs": config.probe_epochs, "seed": job.seed, "device": device}
        fit_probe(model, data.train.batches(), **probed)
    found = evaluate(model, data.test.batches(), device=device)
    checked = evaluate(model, data.validation.batches(), device=device)
    result = {
        "job": dataclasses.asdict(job),
        "name": job.name,
        "epochs": 0,
        "evaluation": dataclasses.asdict(found),
        "validation": checked.top1,
        "data": data.summary(),
    }
    write_json(out / RESULT, result)
    return result


def run_job(
    job: Job,
    data: Resident,
    device: torch.device,
    out: Path,
    *,
    budget: float,
    deadline: float,
    precision: str = "bf16",
    batch: int = 256,
    steps: int | None = None,
    last_call: bool = False,
) -> str:
    """Train a job to its end, or until the deadline; return ``finished``, ``diverged`` or ``stopped``.

    Args:
        job, data, device: What, on what, where.
        out: The job's folder; a state in it is gone on with.
        budget: Seconds that the training may take over all calls; the schedule ends with them, or with the job's
            epochs if they come first.
        deadline: time.monotonic() at which it stops and saves its state.
        precision: ``bf16`` or ``float32``.
        batch: Sweeps per step.
        steps: Steps of a pass; see :class:`Trainer`.
        last_call: Nobody will go on with it: let the schedule end at the deadline.
    """
    out.mkdir(parents=True, exist_ok=True)
    if (out / RESULT).is_file():
        return str(read_json(out / RESULT).get("status", "finished"))
    started = time.monotonic()
    if not job.trained:
        evaluate_as_is(job, data, out, device)
        return "finished"
    state = read_plain(out / STATE)
    if state and state["data"] != data.hash:
        _log.warning("%s: the state belongs to other data; starting anew", job.name)
        state = None
    precision = str(state["precision"]) if state else precision
    trainer = prepared_trainer(job, data, device, job.epochs, precision, batch, steps)
    if state:
        trainer.load(out / STATE)
    prepared = time.monotonic() - started
    log = (out / LOG).open("a", encoding="utf-8")

    def note(**values: Any) -> None:
        log.write(json.dumps({"job": job.name, "epoch": trainer.done(trainer.epoch), **values}) + "\n")
        log.flush()

    note(kind="start", prepared=prepared, steps=trainer.steps, precision=precision)
    if last_call:
        budget = min(budget, trainer.seconds + deadline - time.monotonic())
    status, took, checked, saved, validating = "finished", 0.0, 0.0, time.monotonic(), 0.0
    while (progress := trainer.progress(budget, job.epochs, took)) < 1.0:
        began, skipped = time.monotonic(), float(trainer.skipped)
        # An epoch that would pass the deadline is not begun; later ones are as long as the last.
        if began + 0.8 * took > deadline:
            trainer.save(out / STATE)
            note(kind="stopped", progress=progress)
            return "stopped"
        ahead = max(progress + took / budget, (trainer.epoch + 1) / job.epochs)
        loss = trainer.train_epoch(progress, ahead)
        took = time.monotonic() - began
        missed = float(trainer.skipped) - skipped
        line: dict[str, Any] = {"kind": "epoch", "loss": loss, "seconds": took, "progress": progress, "skipped": missed}
        if missed > HOPELESS * trainer.steps:
            note(**line)
            status = "diverged"
            break
        if trainer.epoch == 1 or trainer.progress(budget, job.epochs, took) >= min(1.0, checked + 0.1):
            began = time.monotonic()
            line["validation"], checked = trainer.validate(), progress
            validating += time.monotonic() - began
        note(**line)
        if time.monotonic() - saved > SAVED:
            trainer.save(out / STATE)
            saved = time.monotonic()
    trainer.config = dataclasses.replace(
        job.config(max(1, math.ceil(trainer.done(trainer.epoch) or 0))), precision=precision, batch_size=batch
    )
    began = time.monotonic()
    result = trainer.finish(out)
    result |= {
        "status": status,
        "training_seconds": trainer.seconds,
        "sweeps_per_second": trainer.steps * trainer.order.shape[1] * trainer.epoch / max(trainer.seconds, 1e-9),
        "best": trainer.best if math.isfinite(trainer.best) else None,
        "precision": precision,
        "skipped_steps": float(trainer.skipped),
        "seconds": {
            "prepare": prepared,
            "train": trainer.seconds,
            "validate": validating,
            "probe and evaluate": time.monotonic() - began,
        },
    }
    write_json(out / RESULT, result)
    note(kind=status, top1=result["evaluation"]["top1"])
    (out / STATE).unlink(missing_ok=True)
    return status


def prepared_trainer(
    job: Job, data: Resident, device: torch.device, epochs: int, precision: str, batch: int, steps: int | None
) -> Trainer:
    """Return a trainer, in the fastest way that works here."""
    for fused, graphs in ((True, True), (False, True), (False, False)):
        trainer = Trainer(job, data, device, epochs, precision, batch, steps)
        try:
            trainer.prepare(fused=fused, graphs=graphs)
        except Exception:  # compilers and drivers fail in many ways
            if not graphs or device.type != "cuda":
                raise
            _log.exception("%s: fused %s, recorded %s does not work here", job.name, fused, graphs)
            torch.cuda.synchronize(device)
        else:
            return trainer
    raise RuntimeError("unreachable")


def read_plain(path: Path) -> dict[str, Any] | None:
    """Return the plain values of a saved state, None if there is none."""
    if not path.is_file():
        return None
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["state"])["plain"]
