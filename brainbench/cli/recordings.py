"""``brainbench recordings``: look into files, check and copy them, and see what their responses can support."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import SCORE, beside, option, out_folder_option, with_options
from brainbench.cli.output import Output, progress_bar, table, table_of
from brainbench.cli.score import left_out

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from brainbench.metrics.reliability.subject_rdm import SubjectRDM

_LARGEST_SHOWN = 12
"""RDMs of more conditions are only written as JSON."""

app = typer.Typer(no_args_is_help=True, help="Inspect, check, copy and fetch neural recordings.")


@app.command("inspect")
def inspect(
    path: Annotated[str, typer.Argument(help="'demo', an NWB, HDF5 or published .npz file, a folder, or a glob.")],
    strict: Annotated[bool, option(SCORE, "strict", "--strict")] = False,
) -> Output:
    """Show what a file holds and which --conditions could label its trials."""
    from brainbench.datasets import inspect as inspect_file

    files = _found(path)
    with progress_bar() as progress:
        inspection = inspect_file(files, strict=strict, progress=progress)
    return Output(inspection, str(inspection))


@app.command("rdm")
@with_options(SCORE, ("conditions", "select", "window", "strict"), build=False)
def rdm(
    source: Annotated[str, typer.Argument(help="'demo', an NWB, HDF5 or published .npz file, a folder, or a glob.")],
    options: Any = None,
    pool: Annotated[str, typer.Option(help="One RDM per 'subject', per 'session', or of 'all' together.")] = "subject",
    seed: Annotated[int, typer.Option(help="Seed of the split halves.")] = 0,
    metric: Annotated[str, typer.Option(help="RSA metric of the RDMs; 'rsa' is that of scores.")] = "rsa-correlation",
) -> Output:
    """Compute every animal's RDM and its split-half reliability."""
    from dataclasses import replace

    from brainbench.core.errors import UsageError
    from brainbench.datasets.trials.session_trials import pooled
    from brainbench.metrics import get_metric
    from brainbench.metrics.measures.rsa import RSA
    from brainbench.scoring.neural_responses import open_neural_responses
    from brainbench.scoring.options import ScoreOptions

    measure = get_metric(metric)
    if not isinstance(measure, RSA):
        raise UsageError(f"The metric {metric!r} has no RDM of animals; choose 'rsa' or another metric of RDMs.")
    with progress_bar() as progress:
        brain = open_neural_responses(source, **options, progress=progress)
    brain = replace(brain, dataset=pooled(brain.dataset, pool))
    labels = brain.vocabulary
    animals = brain.animals(labels, measure, ScoreOptions(seed=seed))
    columns = ("subject", "units", "trials", "reliability", "problem", "notes", "rdm")
    rows = [{name: getattr(item, name) for name in columns} for item in animals]
    data = {"labels": labels, "recordings": brain.origin, "animals": rows}
    text = table_of(
        f"{brain.dataset.attrs['conditions']}, {brain.dataset.attrs['window']}; RDM: {measure.brain_method} distance",
        animals,
        {
            "animal": "{0.subject}",
            ">units": "{0.units}",
            ">trials": "{0.trials}",
            ">reliability": lambda row: "–" if math.isnan(row.reliability) else f"{row.reliability:.3f}",
            "": _verdict,
        },
    )
    text += "".join(f"\n{line}" for line in (*left_out(brain.origin), *(f"Note: {doubt}." for doubt in brain.doubts)))
    if len(labels) <= _LARGEST_SHOWN:
        for animal in animals:
            text += "\n\n" + _matrix(f"RDM of animal {animal.subject}", labels, animal.rdm)
    return Output(data, text)


@app.command("check")
def check(
    source: Annotated[
        str, typer.Argument(help="'demo', an NWB, HDF5 or published .npz file, a folder, a glob, or LAYOUT:PATH.")
    ],
    conditions: Annotated[
        str | None, typer.Option(help="TABLE:COLUMN[,COLUMN] whose labels are checked; the layout's by default.")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Fail on warnings too.")] = False,
) -> Output:
    """Look for what would make scores wrong: clock, coverage, labels, units, tables, times. Worst first.

    Exit status: 0 nothing wrong (notes and warnings may be there), 1 errors (or warnings with --strict),
    2 no such file.
    """
    from brainbench.datasets import check as check_files

    files = _found(source)
    with progress_bar() as progress:
        checkup = check_files(files, conditions=conditions, progress=progress)
    keys = ("verdict", "source", "sessions", "findings")
    failed = checkup.count("error") or (strict and checkup.count("warning"))
    failure = typer.Exit(1) if failed else None
    return Output({name: getattr(checkup, name) for name in keys}, str(checkup), failure=failure)


@app.command("export")
def export(
    source: Annotated[str, typer.Argument(help="'demo', an NWB or HDF5 file, a folder, a glob, or LAYOUT:PATH.")],
    target: Annotated[
        Path, typer.Argument(callback=beside, help="*.h5 (any number of sessions), *.nwb (one), or a folder of NWB.")
    ],
    select: Annotated[str | None, option(SCORE, "select")] = None,
) -> Output:
    """Write a small copy without raw data: spike times and tables. Scores of the copy are identical."""
    from brainbench.datasets import export as export_files

    sources = _found(source)
    with progress_bar("copying the recordings"):
        files = export_files(sources, target, select=select)
    columns = {"file": "{0}", ">": lambda path: f"{path.stat().st_size / 1e6:.2f} MB"}
    return Output({"files": files}, table_of("", files, columns))


@app.command("fetch")
def fetch(
    name: Annotated[str, typer.Argument(help="A layout ('rodgers') or the six digits of a dandiset.")],
    out: Annotated[Path, out_folder_option("Folder to put it in.")] = Path(),
    assets: Annotated[str | None, typer.Option(help="Glob of the files wanted, e.g. 'sub-231CR/*'.")] = None,
) -> Output:
    """Download a public data set with the dandi client; without a network or that client, nothing is tried."""
    from brainbench.datasets import fetch as fetch_files

    with progress_bar("downloading"):
        folder = fetch_files(name, out, assets=assets)
    return Output({"folder": folder}, str(folder))


def _found(source: str) -> str:
    """Return a source as the files' readers take it: the demo recordings by their folder."""
    from brainbench.scoring.demo import DEMOS, demo_recordings

    if source not in DEMOS:
        return source
    with progress_bar() as progress:
        return str(demo_recordings(source, progress=progress))


def _verdict(animal: SubjectRDM) -> str:
    from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE

    if animal.problem:
        return f"undefined: {animal.problem}"
    trusted = animal.reliability >= RELIABILITY_GATE
    verdict = "ok" if trusted else f"unreliable: below {RELIABILITY_GATE}, where no correction for noise can be trusted"
    return "; ".join((verdict, *animal.notes))


def _matrix(title: str, labels: tuple[str, ...], rdm: NDArray[np.float64]) -> str:
    """Show an upper triangle [P] as a square of numbers."""
    from scipy.spatial.distance import squareform

    rows = [[label, *(f"{value:.3f}" for value in line)] for label, line in zip(labels, squareform(rdm), strict=True)]
    return table(title, ["", *labels], rows, right=tuple(range(1, len(labels) + 1)))


@app.command("recipe")
def recipe(
    name: Annotated[str | None, typer.Argument(help="A recording layout; all are listed without one.")] = None,
) -> Output:
    """Print every rule by which a recording layout selects trials and units and cuts windows."""
    from brainbench.datasets.layouts.registry import get_layout, list_layouts

    if name is None:
        titles = {item: get_layout(item).title for item in list_layouts()}
        return Output(titles, table("", ["layout", ""], [[key, text] for key, text in titles.items()]))
    layout = get_layout(name)
    return Output({"name": layout.name, "rules": layout.describe().splitlines()}, layout.describe())
