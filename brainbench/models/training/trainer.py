"""Train one network, in one folder, exactly resumable.

The folder holds ``run.json`` (what is trained), ``state.safetensors`` (where it stands), ``log.jsonl``,
``tensorboard/``, and ``best/``: the model of the best validation (highest accuracy, or lowest self-supervised
loss), ready for ``local-dir:``. A run that was interrupted at any moment goes on when it is started again, and ends
with the weights of an unbroken one: on the CPU to the last bit, on CUDA up to its own reproducibility.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import torch
from torch import nn

from brainbench.core.errors import DataError, UsageError, check_kind
from brainbench.core.files import read_mapping, write_json, write_tensors
from brainbench.core.progress import Progress
from brainbench.core.reading.regular import readable
from brainbench.core.runs import folder
from brainbench.core.runs.log import RunLog, read_log
from brainbench.models.activations import evaluating
from brainbench.models.ops.layers import seeded
from brainbench.models.registry import load_model
from brainbench.models.training.batches import (
    MOUSE,
    Augmentation,
    Batches,
    BatchOptions,
    CheckedBatches,
    Data,
    Processes,
    processes,
)
from brainbench.models.training.checkpoints import WEIGHTS, load_weights, save_checkpoint
from brainbench.models.training.config import TrainingConfig, check_start, config_warnings
from brainbench.models.training.evaluation import (
    CONTROLS,
    TWIN,
    Evaluation,
    baselines,
    checkpoint_info,
    describe_twin,
    difference,
    draw_twin,
    evaluate,
    fit_probe,
    model_card,
    sweeps_hash,
)
from brainbench.models.training.objectives import Gradients, compiled, make_learner, make_optimizer, rate_factor

_log = logging.getLogger(__name__)

BEST, FAILED, CONTROLS_FILE = "best", "failed-batch.safetensors", "controls.json"
_LOG_STEPS = 50
_OF_SEVERAL = ("simclr", "simsiam")  # objectives that compare the sweeps of a batch


@dataclass(frozen=True)
class TrainingResult(folder.RunEnd):
    """End of a run; its folder is that of the model, for ``local-dir:``."""

    steps: int
    epochs: int
    best_epoch: int | None
    """Epoch of the best validation, from 1."""
    evaluation: Evaluation | None
    """Accuracy on the test split (else validation, else training); None until the run is finished, and for a
    self-supervised network without passes of a probe."""
    controls: Mapping[str, Evaluation]
    """Accuracy of :data:`~brainbench.models.training.evaluation.CONTROLS` on the same sweeps; empty until then, and
    without passes of a probe."""
    seconds: float
    """Time of this session."""


def train(
    config: TrainingConfig,
    data: Data,
    *,
    out: str | Path,
    device: str | None = None,
    stop_after: float | None = None,
    controls: str | Path | None = None,
    progress: Progress | None = None,
) -> TrainingResult:
    """Train a network, or go on with a run that was interrupted.

    Args:
        config: What is trained and how.
        data: Labelled sweeps; the split ``train`` is needed, ``validation`` and ``test`` are used when they exist.
        out: The run's folder.
        device: ``cpu``, ``cuda`` or ``cuda:N``; None takes CUDA when there is one. Under torchrun every process
            takes its own.
        stop_after: Save the state and return after so many seconds.
        controls: Folder where the accuracies of raw input, random features and the untrained twin are kept, for all
            runs of one model on one data set; the run's own when None.
        progress: Called with (steps done, steps in all, what).

    Returns:
        How it ended. A loss or gradient that is not finite ends it as ``diverged``: the last good state and model
        stay, and the batch is kept in ``failed-batch.safetensors``.
    """
    check_kind("data of a training", data, Data, "an object with classes, a summary and batches(split, options)")
    stop = folder.Stop(stop_after)
    with processes(device) as where, folder.occupied(Path(out), stop, lock=where.first), seeded(config.seed):
        run = _Run(config, data, Path(out), where, progress, Path(controls or out) / CONTROLS_FILE)
        try:
            return run.run(stop)
        finally:
            run.log.close()


@dataclass
class _Position:
    """Progress of a run."""

    step: int = 0
    epoch: int = 0
    best: float = math.inf  # lowest validation score so far
    best_epoch: int | None = None
    total: float = 0.0  # sum of the losses of this epoch's steps
    count: int = 0


class _Run:
    def __init__(
        self, config: TrainingConfig, data: Data, out: Path, where: Processes, progress: Progress | None, controls: Path
    ) -> None:
        check_start(config.model)
        if config.precision == "auto":
            config = replace(config, precision="bf16" if where.device.type == "cuda" else "float32")
        self.config, self.data, self.out, self.where = config, data, out, where
        self.controls_file, self.controls = controls, {}
        self.progress = progress if progress is not None and where.first else (lambda done, total, what: None)
        self.saved = time.monotonic()
        self.options: dict[str, Any] = {"classes": len(data.classes), "decoder": config.decoder}
        self._claim(write=False)
        model = load_model(config.model, seed=config.seed, **self.options).train()
        start = describe_twin(config.model, config.seed, model)
        learner = make_learner(config.objective, model)
        if where.count > 1 and config.batch_size % where.count:
            raise UsageError(f"A batch of {config.batch_size} cannot be shared evenly by {where.count} processes.")
        self.learner: Any = where.prepare(learner)
        self.model: nn.Module = self.learner.model
        self.optimizer = make_optimizer(config.optimizer, self.learner.parameters(), config.learning_rate)
        self.gradients = Gradients(
            self.learner,
            compiled(self.learner, config.compile),
            clip=config.clip,
            autocast=self._precision,
            record=config.compile == "graphs",
            average=where.average if where.count > 1 else None,
        )
        # Data in memory need not say where their whiskers are.
        cells: tuple[int, ...] = getattr(data, "cells", MOUSE)
        axes: str = getattr(data, "axes", "world")
        self.augmentation = Augmentation(config.augmentation, config.masking, cells, axes)
        batches = self._batches("train", shuffle=True)
        if batches is None:
            raise DataError("The data set has no split 'train', so there is nothing to train on.")
        self.batches: Batches = batches
        self._try_batches()
        # What cannot be trained has ended by now, and takes no folder.
        self._claim(write=where.first)
        where.wait()
        self.twin = self._twin(start)
        self.at = _Position()
        if (out / folder.STATE).exists():  # what is no file is refused there
            self._restore()
        self.log = RunLog(out, "step", self.at.step, active=where.first)
        for warning in config_warnings(config, self.model) if where.first else ():
            _log.warning("%s", warning)

    def _try_batches(self) -> None:
        """Show the network two sweeps of each split, which it refuses where it cannot read them."""
        for split in ("train", "validation", "test"):
            for x, _ in self._batches(split, shuffle=False) or ():
                with evaluating(self.model), torch.no_grad(), self._precision():
                    self.model(x[:2].to(self.where.device))
                break

    def _claim(self, *, write: bool) -> None:
        identity = {**self.config.identity, "classes": list(self.data.classes)}
        begin = {"run": identity, "status": "running"}
        stated = {"stated": lambda document: document.get("run"), "write": write}
        folder.claim(self.out / folder.RUN, identity, lambda: begin, **stated)

    def _twin(self, now: dict[str, Any]) -> dict[str, Any]:
        """Return what is told of the network that the run started from, which may have been drawn elsewhere."""
        if not self.where.first:
            return now
        stored = read_mapping(self.out / folder.RUN).get("twin")
        if stored is None:
            folder.mark(self.out / folder.RUN, twin=now)
        elif reason := difference(stored, now):
            _log.warning("The run goes on, but without its untrained twin: %s.", reason)
        return stored or now

    def run(self, stop: folder.Stop) -> TrainingResult:
        """Train until all epochs are done or it is to stop; return how it ended."""
        self.stop = stop
        steps = len(self.batches)
        if self.where.first and self.at.epoch < self.config.epochs:
            _log.info("%s %s: step %d of %d.", self.config.model, self.config.objective, self.at.step, self._steps)
        while self.at.epoch < self.config.epochs:
            self.learner.train()
            over, reason = False, ""
            self.began, self.seen = time.monotonic(), 0
            for x, labels in self.batches:
                failure = self._advance(x, labels, steps)
                if failure:
                    return self._result("diverged", failure)
                self.progress(self.at.step, self._steps, f"training {self.config.model}")
                late, reason = 0 < self.config.checkpoint_seconds < time.monotonic() - self.saved, stop.reason()
                over, due = self.where.any(bool(reason), late)
                # After an epoch's last batch the end of the epoch saves; a state between the two would lose it.
                if (over or due) and self.at.step % steps:
                    self._save()
                    if over:
                        return self._result("stopped", reason)
            self.at.epoch += 1
            self._end_epoch()
            if over and self.at.epoch < self.config.epochs:
                return self._result("stopped", reason)
        return self._finish()

    @property
    def _steps(self) -> int:
        return len(self.batches) * self.config.epochs

    def _advance(self, x: torch.Tensor, labels: torch.Tensor, steps: int) -> str:
        """Take one optimiser step; return why it could not be taken, or ''."""
        config = self.config
        if len(x) < 2 and config.objective in _OF_SEVERAL:
            # The rest of an epoch: a single sweep has no others to compare with, nor batch norms their statistics.
            self.at.step += 1
            return ""
        x, labels = x.to(self.where.device, non_blocking=True), labels.to(self.where.device, non_blocking=True)
        views = self._views(x, self.at.step)
        span = {"epochs": config.epochs, "warmup_epochs": config.warmup_epochs}
        factor = rate_factor(config.schedule, self.at.step / steps, **span)
        # The rate is a function of the step alone, so a resumed run needs no state of a scheduler.
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * factor
        results = self.gradients(views, labels)
        # This waits for the device: a step that is not finite must be found before it changes the weights.
        value, norm = map(float, results)
        # Loss and gradients are averaged over processes, so all of them decide alike.
        if not math.isfinite(norm) or not math.isfinite(value):
            return self._keep_failure(views, labels, value, norm)
        self.optimizer.step()
        self.seen += len(x) * self.where.count
        self.at.step += 1
        self.at.total, self.at.count = self.at.total + value, self.at.count + 1
        if self.at.step % _LOG_STEPS == 0:
            rate = config.learning_rate * factor
            self.log.write("train", self.at.step, loss=value, gradient_norm=norm, learning_rate=rate)
        return ""

    def _views(self, x: torch.Tensor, step: int) -> tuple[torch.Tensor, ...]:
        """Return augmented copies of a batch, which depend on nothing but the seed and a step's number."""
        views = []
        for view in range(self.learner.views):
            # Distinct numbers for every step and view of a run; the modulus keeps negative steps (validation) valid.
            seed = ((self.config.seed * 1_000_003 + step) * 2 + view) % 2**63
            views.append(self.augmentation(x, torch.Generator().manual_seed(seed), part=self.where.part))
        return tuple(views)

    def _end_epoch(self) -> None:
        if not self.at.count:
            raise DataError(f"No batch of the training sweeps has two of them, which {self.config.objective} compares.")
        loss = self.at.total / self.at.count
        self.at.total, self.at.count = 0.0, 0
        # Of the part of the epoch that this session trained, without its validation.
        seconds = time.monotonic() - self.began
        rate = self.seen / seconds if seconds else 0.0
        speed = {"seconds": round(seconds, 3), "sweeps_per_second": round(rate, 1)}
        self.log.write("epoch", self.at.step, epoch=self.at.epoch, loss=loss, **speed)
        if self.where.first:
            facts = (self.config.model, self.at.epoch, self.config.epochs, loss, seconds, rate)
            _log.info("%s: epoch %d of %d, loss %.4f, %.1f s, %.0f sweeps/s.", *facts)
        score = self._validate(loss)
        # Strictly better, so of equal epochs the first is kept, and a NaN never is.
        if score < self.at.best:
            self.at.best, self.at.best_epoch = score, self.at.epoch
            if self.where.first:
                self._publish(None)
        self._save()

    def _validate(self, loss: float) -> float:
        """Return what the best model has least of: 1 − accuracy, or the self-supervised loss."""
        # The other sweeps of a batch are what SimCLR compares with: in stored order, all would be of one class.
        contrast = self.config.objective != "supervised"
        batches = self._batches("validation", shuffle=contrast, part=contrast)
        if batches is None:
            return loss
        if self.config.objective == "supervised":
            with self._precision():
                evaluation = evaluate(self.model, batches, device=self.where.device)
            accuracy = {name: getattr(evaluation, name) for name in ("top1", "top5", "spread")}
            self.log.write("validation", self.at.step, **accuracy)
            return 1.0 - evaluation.top1
        total, count = 0.0, 0
        with evaluating(self.learner), torch.no_grad(), self._precision():
            for index, (x, labels) in enumerate(batches):
                x, labels = x.to(self.where.device), labels.to(self.where.device)
                # The same views in every epoch, so that losses can be compared.
                views = self._views(x, -1 - index)
                if len(x) > 1 or self.config.objective not in _OF_SEVERAL:
                    # Each sweep counts alike, also where the last batch is short.
                    total, count = total + len(x) * float(self.learner(views, labels)), count + len(x)
        if not count:  # as without a validation: nothing can be compared
            return loss
        mean = self.where.mean(total / count)
        self.log.write("validation", self.at.step, loss=mean)
        return mean if math.isfinite(mean) else math.inf

    def _finish(self) -> TrainingResult:
        result, split = None, "test"
        if self.where.first:
            document = read_mapping(self.out / folder.RUN)
            self.controls = _evaluations(document.get("controls") or {})
            done = document.get("evaluation")
            if done is not None:
                self.where.wait()
                return self._result("finished", "", Evaluation.from_plain(done))
            # The best weights as they were published, so that what is evaluated is what is shipped.
            if not (self.out / BEST / WEIGHTS).is_file():
                self._publish(None)
            load_weights(self.model, self.out / BEST / WEIGHTS, what=self.config.model)
            probed = self.config.objective != "supervised"
            if probed and self.config.probe_epochs:
                self.progress(self._steps, self._steps, "fitting the linear probe")
                train = self._batches("train", shuffle=False, part=False) or ()
                fit_probe(self.model, train, classes=len(self.data.classes), device=self.where.device, **self._probe)
                # The probe is rounded too where the weights are.
                self._publish(None)
                load_weights(self.model, self.out / BEST / WEIGHTS, what=self.config.model)
            # The split that was used least for training, of those that the data set has.
            # Without a probe the decoder of a self-supervised network is random, and its accuracy says nothing.
            for split in () if probed and not self.config.probe_epochs else ("test", "validation", "train"):
                batches = self._batches(split, shuffle=False, part=False)
                if batches is not None:
                    result = evaluate(self.model, batches, device=self.where.device)
                    self.controls = self._compare(result, batches)
                    break
            if result is not None and split != "test":
                advice = "There is no split 'test': the accuracy is that of %s sweeps, which chose the weights."
                _log.warning(advice, split)
            if repeated := self.data.summary.get("test_of_trained_objects"):
                advice = "%d test sweeps are of objects that were trained on: the accuracy counts memory of them too."
                _log.warning(advice, repeated)
            self._publish(result, split)
            if result is not None:
                # A run that was killed after this line, and before it is marked as finished, has it already.
                if not read_log(self.out, "test"):
                    self.log.write("test", self.at.step, top1=result.top1, top5=result.top5, spread=result.spread)
                if result.collapsed:
                    _log.warning("%s has collapsed: %s.", self.config.model, result.reason)
            controls = {name: asdict(item) for name, item in self.controls.items()}
            stated = asdict(result) if result else None
            folder.mark(self.out / folder.RUN, evaluation=stated, controls=controls, status="finished")
        self.where.wait()
        return self._result("finished", "", result)

    def _compare(self, result: Evaluation, test: Batches) -> dict[str, Evaluation]:
        """Return how well the raw input, random features of it and the untrained twin are read on the same sweeps."""
        features, train = getattr(self.model, "features", None), self._batches("train", shuffle=True, part=False)
        if features is None or train is None or not self.config.probe_epochs:
            return {}
        probe = self._probe
        # The probes are fitted to the training sweeps; where their data set names no hash, their content is hashed.
        fitted = dict(self.data.summary) or sweeps_hash(self._batches("train", shuffle=False, part=False) or ())
        key = {**probe, "classes": list(self.data.classes), "data": result.data, "train": fitted, "twin": self.twin}
        # Batches of another size bring the sweeps to the probes in another order.
        key["batch_size"] = self.config.batch_size
        if self.controls_file.is_file() and (stored := read_mapping(self.controls_file)).get("of") == key:
            return _evaluations(stored["controls"])
        self.progress(self._steps, self._steps, "probing raw input, random features and the untrained twin")
        device = self.where.device
        probe |= {"classes": len(self.data.classes), "device": device}
        memory = torch.cuda.get_device_properties(device).total_memory // 8 if device.type == "cuda" else 2**31
        evaluations = baselines(train, test, features=features, memory=memory, **probe)
        twin, reason = draw_twin(self.twin, self.options)
        if not reason:
            fit_probe(twin.to(device), train, **probe)
            evaluations[TWIN] = evaluate(twin, test, device=device)
        plain = {name: asdict(evaluation) for name, evaluation in evaluations.items()}
        write_json(self.controls_file, {"of": key, "controls": plain})
        return evaluations

    @property
    def _probe(self) -> dict[str, Any]:
        return {"epochs": self.config.probe_epochs, "seed": self.config.seed}

    def _publish(self, result: Evaluation | None, split: str = "test") -> None:
        config, reached = self.config, {"epochs_done": self.at.epoch, "best_epoch": self.at.best_epoch}
        facts = {"twin": self.twin, "controls": self.controls, "data": self.data.summary, "split": split}
        info = checkpoint_info(config, self.data.classes, evaluation=result, **reached, **facts)
        dtype = "bfloat16" if config.precision == "bf16" else "float32"
        dtype = dtype if config.weights_dtype == "auto" else config.weights_dtype
        stated = {"options": self.options, "info": info, "card": model_card(config, info), "dtype": dtype}
        save_checkpoint(self.out / BEST, self.model, architecture=config.model, **stated)

    def _save(self) -> None:
        self.saved = time.monotonic()
        if not self.where.first:
            return
        progress = {"position": asdict(self.at), "batches": self.batches.state_dict()}
        # Dropout draws random numbers; augmentation does not, its numbers depend on seed, step and view alone.
        random = folder.random_state(self.where.device)
        learner = folder.learner_state(self.learner, self.optimizer)
        folder.save_state(self.out / folder.STATE, {**learner, **progress, "random": random})

    def _restore(self) -> None:
        state = folder.load_state(self.out / folder.STATE)
        with readable(self.out / folder.STATE, "training state", folder.RESTART):
            folder.restore_learner(state, self.learner, self.optimizer, self.out / folder.STATE)
            batches = dict(state["batches"])
            if "part" in batches:  # every process reads its own part, and the first one's state was saved
                batches["part"] = list(self.where.part)
            self.batches.load_state_dict(batches)
            self.at = msgspec.convert(state["position"], _Position)
            folder.set_random_state(state["random"], self.where.device)

    def _keep_failure(self, views: tuple[torch.Tensor, ...], labels: torch.Tensor, loss: float, norm: float) -> str:
        advice = "A lower learning rate, a smaller clipping norm or the -ln variant of the network may help"
        if lost := sum(int((~view.isfinite()).sum()) for view in views):
            advice = f"{lost:,} values of this batch are not finite (NaN or infinite): leave those out"
        reason = (
            f"at step {self.at.step + 1} the loss was {loss:g} and the gradient's norm {norm:g}; the last good model "
            f"is kept and the batch is in {FAILED}. {advice}"
        )
        if self.where.first:
            tensors = {f"view{index}": view for index, view in enumerate(views)}
            write_tensors(self.out / FAILED, {**tensors, "labels": labels}, step=str(self.at.step))
            # Before the first validation there is no best model: the last saved state takes its place.
            state = self.out / folder.STATE
            if not (self.out / BEST / WEIGHTS).is_file() and state.is_file():
                folder.restore_learner(folder.load_state(state), self.learner, self.optimizer, state)
                self._publish(None)
            folder.mark(self.out / folder.RUN, status="diverged", reason=reason)
        return reason

    def _result(self, status: Any, reason: str, evaluation: Evaluation | None = None) -> TrainingResult:
        at, seconds = self.at, round(self.stop.elapsed, 3)
        return TrainingResult(
            status, reason, self.out / BEST, at.step, at.epoch, at.best_epoch, evaluation, self.controls, seconds
        )

    def _batches(self, split: str, *, shuffle: bool, part: bool = True) -> Batches | None:
        mine = self.where.part if part else (0, 1)
        options = BatchOptions(self.config.batch_size, shuffle, self.config.seed, mine, self.where.device)
        batches = self.data.batches(split, options)
        return None if batches is None else CheckedBatches(batches, split, len(self.data.classes))

    def _precision(self) -> Any:
        if self.config.precision == "float32":
            return nullcontext()
        # bfloat16 has the range of single precision, so losses need no scaling.
        return torch.autocast(self.where.device.type, dtype=torch.bfloat16)


def _evaluations(plain: Mapping[str, Any]) -> dict[str, Evaluation]:
    # In the order in which they were made, which files do not keep: a card that is written again stays the same.
    return {name: Evaluation.from_plain(plain[name]) for name in CONTROLS if name in plain}
