"""``brainbench stimuli separability``: are the classes of a data set of sweeps told apart above chance?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table


def separability(
    folder: Annotated[Path, typer.Argument(help="Data set that brainbench stimuli sweep --out made.")],
    classes: Annotated[
        str | None, typer.Option(help="Classes, with commas between them. [default: the four with the most objects]")
    ] = None,
    counts: Annotated[str, typer.Option(help="How many classes at a time, with commas between them.")] = "2,3,4",
    sweeps_per_class: Annotated[int, typer.Option(min=2, help="Sweeps drawn of each class.")] = 400,
    split: Annotated[str, typer.Option(help="all, train, validation or test.")] = "all",
    seed: Annotated[int, typer.Option(help="Of the draw, the folds and the resampling.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Train support vector machines on 2, 3 and 4 classes; print their accuracy on new objects against chance."""
    from brainbench.cli.stimuli.options import whole_numbers
    from brainbench.datasets.whisking.dataset import WhiskingDataset
    from brainbench.datasets.whisking.separability import separability as measure

    data = WhiskingDataset(folder, split=split, view="raw")
    names = None if classes is None else [name.strip() for name in classes.split(",")]
    with progress_bar() as progress:
        found = measure(
            data,
            classes=names,
            counts=whole_numbers(counts, "--counts"),
            sweeps_per_class=sweeps_per_class,
            seed=seed,
            progress=progress,
        )
    rows = [
        [
            f"{item.count}",
            f"{item.accuracy:.3f}",
            f"[{item.interval.low:.3f}, {item.interval.high:.3f}]",
            f"{item.chance:.3f}",
            ("above chance" if item.above_chance else "not above chance")
            + (f" ({item.status}: {item.reason})" if item.status != "ok" else ""),
        ]
        for item in found
    ]
    used = dict.fromkeys(name for item in found for choice in item.choices for name in choice)
    title = f"{', '.join(used)}: {found[0].objects} objects, {found[0].sweeps} sweeps"
    text = table(title, ["classes", "accuracy", "95 % interval", "chance", ""], rows)
    if data.skipped:
        text += f"\n\n{data.skipped} unstable sweeps were left out"
    result = {
        "content_hash": data.manifest["content_hash"],
        "split": split,
        "unstable": data.skipped,
        "results": [
            {**{key: getattr(item, key) for key in item.__dataclass_fields__}, "above_chance": item.above_chance}
            for item in found
        ],
    }
    emit(result, text, as_json=as_json)
