"""``brainbench train``: train a model on a data set of whisker sweeps."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table

if TYPE_CHECKING:
    import torch

    from brainbench.core.progress import Progress
    from brainbench.datasets import WhiskingDataset
    from brainbench.models.training.trainer import TrainingResult


def train(
    model: Annotated[str, typer.Argument(help="A registry name, such as zhuang-intersection-ln-small.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="Folder that brainbench stimuli sweep wrote.")],
    objective: Annotated[
        str | None, typer.Option(help="supervised, simclr, simsiam, simsiam-warmup or ae; supervised if not given.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="TOML or JSON file of training options; options given here win.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder of the run; started again, it goes on.")
    ] = None,
    epochs: Annotated[int | None, typer.Option(help="Passes over the data (published: 100).")] = None,
    batch_size: Annotated[int | None, typer.Option(help="Sweeps per step over all processes.")] = None,
    optimizer: Annotated[str | None, typer.Option(help="sgd, adam, adamw or lars.")] = None,
    schedule: Annotated[str | None, typer.Option(help="step, constant or cosine.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Initial learning rate.")] = None,
    augmentation: Annotated[str | None, typer.Option(help="none, physical, thesis or image.")] = None,
    masking: Annotated[float | None, typer.Option(help="Share of masked time steps (published with 0.75).")] = None,
    precision: Annotated[str | None, typer.Option(help="bf16 (mixed), float32, or auto: bf16 on CUDA.")] = None,
    compile: Annotated[
        str | None,
        typer.Option(help="off, parts (of the network), default (the whole) or graphs (whole steps as CUDA graphs)."),
    ] = None,
    weights_dtype: Annotated[
        str | None,
        typer.Option(
            help="Precision of the model that is written: auto (that of the training), float32, float16 or bfloat16."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of weights, order, augmentation and dropout.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu, cuda or cuda:N; CUDA when there is one.")] = None,
    stop_after: Annotated[float | None, typer.Option(help="Save the state and stop after so many seconds.")] = None,
    sweep: Annotated[
        str | None,
        typer.Option(help="Train the whole published search space: 'all', or NUMBER/COUNT for one job's share."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Train a model with its published recipe, or go on with a run that was interrupted.

    Several GPUs: torchrun --nproc-per-node N -m brainbench train …
    """
    from brainbench.core.errors import DataError, UsageError
    from brainbench.models.training.config import TrainingConfig, read_options
    from brainbench.models.training.search_space import SweepRun, best_run, sweep_runs
    from brainbench.models.training.trainer import train as run

    options = read_options(config) if config is not None else {}
    given = {
        "epochs": epochs,
        "batch_size": batch_size,
        "optimizer": optimizer,
        "schedule": schedule,
        "learning_rate": learning_rate,
        "augmentation": augmentation,
        "masking": masking,
        "precision": precision,
        "compile": compile,
        "weights_dtype": weights_dtype,
        "seed": seed,
    }
    options |= {name: value for name, value in given.items() if value is not None}
    if (named := options.pop("model", model)) != model:
        raise UsageError(f"The configuration is for the model {named!r} and the command names {model!r}.")
    wanted = objective or options.pop("objective", "supervised")
    options.pop("objective", None)
    chosen = TrainingConfig.published(model, wanted, **options)
    where = out or Path("brainbench-training") / f"{model}.{wanted}"
    runs = [SweepRun(chosen, where)]
    if sweep is not None:
        runs = sweep_runs(chosen, where, job=_job(sweep), warmup=wanted.endswith("-warmup"))
    source = SweepFolder(data)
    results: dict[str, TrainingResult] = {}
    with progress_bar() as progress:
        for item in runs:
            results[str(item.folder)] = run(
                item.config,
                source,
                out=item.folder,
                device=device,
                stop_after=stop_after,
                progress=_named(progress, item.folder.name) if sweep is not None else progress,
            )
    if os.environ.get("RANK", "0") != "0":
        return
    rows = [[folder, *_row(result)] for folder, result in results.items()]
    columns = ["run", "status", "epochs", "best", "top-1", "top-5", "collapsed"]
    text = table("", columns, rows, right=(2, 3, 4, 5))
    text += "".join(f"\n{folder}: {result.reason}" for folder, result in results.items() if result.reason)
    done = [result for result in results.values() if result.status == "finished"]
    payload: dict[str, Any] = {"config": chosen, "runs": results}
    if sweep is not None and done:
        winner, scores = best_run(where)
        payload |= {"best": winner, "validation": scores}
        text += f"\n\nbest by validation  {winner}"
    if done:
        text += f"\n\nscore it: brainbench score local-dir:{done[-1].folder}"
    emit(payload, text, as_json=as_json)
    diverged = [folder for folder, result in results.items() if result.status == "diverged"]
    if diverged:
        raise DataError(f"Training diverged in {', '.join(diverged)}.")


class SweepFolder:
    """The splits of a folder of sweeps, as training asks for them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        whole = self._open("all", batch_size=1)
        self.classes = whole.classes
        self.manifest = whole.manifest

    def _open(self, split: str, **options: Any) -> WhiskingDataset:
        from brainbench.datasets import WhiskingDataset

        return WhiskingDataset(self.folder, split=split, **options)

    def batches(
        self,
        split: str,
        *,
        batch_size: int,
        shuffle: bool,
        seed: int,
        part: tuple[int, int],
        device: torch.device,
    ) -> Any:
        """Return the batches of a split; None if it has no sweeps."""
        if not self.manifest["splits"].get(split, {}).get("sweeps"):
            return None
        return self._open(split, batch_size=batch_size // part[1], shuffle=shuffle, seed=seed, part=part, device=device)


def _job(text: str) -> tuple[int, int]:
    from brainbench.core.errors import UsageError

    if text == "all":
        return 0, 1
    number, slash, count = text.partition("/")
    if not slash or not number.isdigit() or not count.isdigit():
        raise UsageError(f"--sweep takes 'all', or NUMBER/COUNT with numbers from 0; received {text!r}.")
    return int(number), int(count)


def _named(progress: Progress, name: str) -> Progress:
    return lambda done, total, what: progress(done, total, f"{what}: {name}")


def _row(result: TrainingResult) -> list[str]:
    found = result.evaluation
    best = "–" if result.best_epoch is None else str(result.best_epoch)
    if found is None:
        return [result.status, str(result.epochs), best, "–", "–", "–"]
    low, high = found.interval.low, found.interval.high
    top1 = f"{found.top1:.3f} [{low:.3f}, {high:.3f}]"
    return [result.status, str(result.epochs), best, top1, f"{found.top5:.3f}", found.reason or "no"]
