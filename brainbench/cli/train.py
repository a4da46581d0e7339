"""``brainbench train``: train a model on a data set of whisker sweeps."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import out_folder_option, part_of, with_options
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import read_mapping
from brainbench.core.progress import Progress

if TYPE_CHECKING:
    from brainbench.datasets import WhiskingDataset
    from brainbench.models.training.batches import BatchOptions
    from brainbench.models.training.trainer import TrainingResult


TRAINING = "brainbench.models.training.config:TrainingConfig"
OFFERED = (
    "objective", "epochs", "batch_size", "optimizer", "schedule", "learning_rate", "augmentation", "masking",
    "precision", "compile", "weights_dtype", "seed",
)  # fmt: skip
"""Fields of the configuration that have a flag; a file sets the others too."""


@with_options(TRAINING, OFFERED, given=True)
def train(
    model: Annotated[str, typer.Argument(help="A registry name, such as zhuang-intersection-ln-small.")],
    data: Annotated[
        Path, typer.Option("--data", "-d", help="Data set of brainbench stimuli sweep, or published sweeps.")
    ],
    options: dict[str, Any],
    config: Annotated[
        Path | None, typer.Option(help="TOML or JSON file of training options; options given here win.")
    ] = None,
    out: Annotated[Path | None, out_folder_option("Folder of the run; started again, it goes on.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu, cuda or cuda:N; CUDA when there is one.")] = None,
    stop_after: Annotated[float | None, typer.Option(help="Save the state and stop after so many seconds.")] = None,
    sweep: Annotated[
        str | None,
        typer.Option(help="Train the whole published search space: 'all', or NUMBER/COUNT for one job's share."),
    ] = None,
) -> Output:
    """Train a model with its published recipe, or go on with a run that was interrupted.

    Several GPUs: torchrun --nproc-per-node N -m brainbench train …
    """
    from brainbench.models.training.config import TrainingConfig, best_run, sweep_runs

    options = (read_mapping(config) if config is not None else {}) | options
    if (stated := options.pop("model", model)) != model:
        raise UsageError(f"The configuration is for the model {stated!r} and the command names {model!r}.")
    wanted = options.pop("objective", "supervised")
    chosen = TrainingConfig.published(model, wanted, **options)
    where = out or Path("brainbench-training") / f"{model}.{wanted}"
    runs = [(chosen, where)]
    if sweep is not None:
        job = (0, 1) if sweep == "all" else part_of(sweep, "--sweep takes 'all', or")
        runs = sweep_runs(chosen, where, job=job, warmup=wanted.endswith("-warmup"))
    results: dict[str, TrainingResult] = {}
    with progress_bar() as progress:
        source = SweepFolder(data, progress)
        # What is wrong with options or data is told before PyTorch is imported.
        from brainbench.models.training.evaluation import RANDOM, RAW, TWIN
        from brainbench.models.training.trainer import BEST
        from brainbench.models.training.trainer import train as run

        for training, folder in runs:
            report = _named(progress, folder.name) if sweep is not None else progress
            results[str(folder)] = run(
                training, source, out=folder, device=device, stop_after=stop_after, progress=report,
                controls=where if sweep is not None else None,
            )  # fmt: skip
    if os.environ.get("RANK", "0") != "0":
        raise typer.Exit
    columns = {
        "run": "{0[0]}",
        "status": "{0[1].status}",
        ">epochs": "{0[1].epochs}",
        ">best": lambda row: "–" if row[1].best_epoch is None else row[1].best_epoch,
        ">top-1": lambda row: _evaluated(row[1], "{0.top1:.3f} [{0.interval.low:.3f}, {0.interval.high:.3f}]"),
        ">top-5": lambda row: _evaluated(row[1], "{0.top5:.3f}"),
        ">raw": lambda row: _control(row[1], RAW),
        ">random": lambda row: _control(row[1], RANDOM),
        ">twin": lambda row: _control(row[1], TWIN),
        "collapsed": lambda row: _evaluated(row[1], "{0.reason}") or "no",
    }
    text = table_of("", results.items(), columns)
    text += "".join(f"\n{folder}: {result.reason}" for folder, result in results.items() if result.reason)
    done = [result for result in results.values() if result.status == "finished"]
    payload: dict[str, Any] = {"config": chosen, "runs": results}
    best = done[-1].folder if done else None
    if sweep is not None and done:
        winner, scores = best_run(where)
        payload |= {"best": winner, "validation": scores}
        text += f"\n\nbest by validation  {winner}"
        best = winner / BEST
    if done:
        text += f"\n\nscore it: brainbench score local-dir:{best}"
    diverged = [folder for folder, result in results.items() if result.status == "diverged"]
    failure = DataError(f"Training diverged in {', '.join(diverged)}.") if diverged else None
    return Output(payload, text, failure=failure)


class SweepFolder:
    """The splits of a folder of sweeps, as training asks for them; damaged shards are told first."""

    def __init__(self, folder: Path, progress: Progress | None = None) -> None:
        self.folder = folder
        whole = self._open("all", batch_size=1)
        if os.environ.get("RANK", "0") == "0":
            whole.verify(again=False, progress=progress)
        self.classes = whole.classes
        self.summary: Mapping[str, Any] = whole.summary
        self.cells, self.axes = whole.cells, whole.axes
        self.manifest = whole.manifest

    def _open(self, split: str, **options: Any) -> WhiskingDataset:
        from brainbench.datasets import WhiskingDataset

        return WhiskingDataset(self.folder, split=split, **options)

    def batches(self, split: str, options: BatchOptions) -> Any:
        """Return the batches of a split; None if it has no sweeps."""
        if not self.manifest["splits"].get(split, {}).get("sweeps"):
            return None
        # The data set counts the sweeps of one process.
        return self._open(split, **vars(options) | {"batch_size": options.batch_size // options.part[1]})


def _named(progress: Progress, name: str) -> Progress:
    return lambda done, total, what: progress(done, total, f"{what}: {name}")


def _control(result: TrainingResult, name: str) -> str:
    return f"{result.controls[name].top1:.3f}" if name in result.controls else "–"


def _evaluated(result: TrainingResult, form: str) -> str:
    return "–" if result.evaluation is None else form.format(result.evaluation)
