"""``brainbench recordings``: look into files, check and copy them, and see what their responses can support."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from brainbench.cli.options import (
    SCORE,
    SeedOption,
    beside,
    needs,
    option,
    out_file_option,
    out_folder_option,
    with_options,
)
from brainbench.cli.output import Output, facts, progress_bar, table, table_of
from brainbench.cli.score import left_out
from brainbench.core.contracts import join_labels
from brainbench.core.errors import DataError, UsageError, listing
from brainbench.scoring.demo import DEMOS, demo_recordings
from brainbench.scoring.options import ScoreOptions

if TYPE_CHECKING:
    from brainbench.datasets import StoredRDMs
    from brainbench.metrics.measures.rsa import RSA
    from brainbench.metrics.reliability.subject_rdm import SubjectRDM

Metric = Annotated[str, typer.Option(help="RSA metric of the RDMs; 'rsa' is that of scores.")]

_LARGEST_SHOWN = 12  # RDMs of more conditions are only written as JSON

app = typer.Typer(no_args_is_help=True, help="Inspect, check, copy and fetch neural recordings.")


@app.command("inspect")
def inspect(
    path: Annotated[str, typer.Argument(help="'demo', an NWB, HDF5 or published .npz file, a folder, or a glob.")],
    strict: Annotated[bool, option(SCORE, "strict", "--strict")] = False,
) -> Output:
    """Show what a file holds and which --conditions could label its trials."""
    from brainbench.datasets import inspect as inspect_file
    from brainbench.datasets.rdm_files import HoldsRDMsError

    files = _found(path)
    try:
        with progress_bar() as progress:
            inspection = inspect_file(files, strict=strict, progress=progress)
    except HoldsRDMsError as error:
        return Output(error.rdms, f"{path} (rsatoolbox)\n{_described(error.rdms)}\n{facts(error.rdms.contents)}")
    return Output(inspection, str(inspection))


@app.command("rdm")
@with_options(SCORE, ("conditions", "select", "window", "strict"), build=False)
def rdm(
    source: Annotated[str, typer.Argument(help="'demo', an NWB, HDF5 or published .npz file, a folder, or a glob.")],
    options: Any = None,
    pool: Annotated[str, typer.Option(help="One RDM per 'subject', per 'session', or of 'all' together.")] = "subject",
    seed: Annotated[int, typer.Option(help="Seed of the split halves.")] = 0,
    metric: Metric = "rsa-correlation",
    out: Annotated[Path | None, out_file_option("File to write too, as rsatoolbox reads it (.h5).")] = None,
) -> Output:
    """Compute every animal's RDM and its split-half reliability; or show the RDMs in a file of rsatoolbox."""
    from brainbench.datasets.rdm_files import HoldsRDMsError, StoredRDMs, write_rdms
    from brainbench.datasets.trials.session_trials import pooled
    from brainbench.scoring.neural_responses import open_neural_responses

    measure = _of_rdms(metric)
    if out is not None and out.suffix.lower() not in (".h5", ".hdf5"):
        raise UsageError(f"--out ends in .h5, from which rsatoolbox tells its kind; received {out.name!r}.")
    try:
        with progress_bar() as progress:
            brain = open_neural_responses(source, **options, progress=progress)
    except HoldsRDMsError as error:
        if out is not None or any(options.values()):
            raise UsageError(f"{source} holds RDMs and no trials; leave out what chooses trials, and --out.") from error
        read = error.rdms
        return Output(read, _described(read) + _matrices("RDM", read.stimuli, read.names, read.values))
    brain = replace(brain, dataset=pooled(brain.dataset, pool))
    labels = brain.vocabulary
    animals = brain.animals(labels, measure, ScoreOptions(seed=seed))
    columns = ("subject", "units", "trials", "reliability", "problem", "notes", "rdm")
    rows = [{**{name: getattr(item, name) for name in columns}, "verdict": _verdict(item)} for item in animals]
    about = {name: str(brain.dataset.attrs[name]) for name in ("conditions", "window")}
    data = {**about, "distance": measure.brain_method, "labels": labels, "recordings": brain.origin}
    data |= {"doubts": brain.doubts, "animals": rows}
    text = table_of(
        f"{about['conditions']}, {about['window']}; RDM: {measure.brain_method} distance",
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
    names, rdms = [item.subject for item in animals], [item.rdm for item in animals]
    text += _matrices("RDM of animal", labels, names, rdms)
    if out is not None:
        about |= {"content_hash": str(brain.dataset.attrs["content_hash"]), "recordings": brain.source}
        about["responses"] = str(brain.dataset.attrs.get("measure", "spikes"))
        more = {name: [getattr(item, name) for item in animals] for name in ("units", "trials", "reliability")}
        write_rdms(out, StoredRDMs(np.stack(rdms), labels, tuple(names), measure.brain_method, more, about))
        text += f"\n\nWritten: {out}"
    return Output(data, text)


@app.command("compare")
@needs(cache=True)
@with_options(SCORE, ("stimuli", "match"), build=False)
def compare(
    rdms: Annotated[str, typer.Argument(help="A file of RDMs, as rsatoolbox and recordings rdm --out write it.")],
    model: Annotated[str, typer.Argument(help="A model as brainbench score takes it, or another file of RDMs.")],
    options: Any = None,
    metric: Metric = "rsa-correlation",
    seed: SeedOption = 0,
) -> Output:
    """Compare RDMs of a file with those of a model's layers, or of another file, as they are.

    A file of RDMs has no trials, so nothing is corrected for noise and nothing is tested: that is a score's part.
    """
    from brainbench.metrics.rdms.comparison import compare as compare_rdms
    from brainbench.scoring.model_responses import resolve_model

    measure, stored = _of_rdms(metric), _stored(rdms)
    if stored is None:
        raise UsageError(
            f"{rdms} is no file of RDMs; recordings rdm {rdms} --out FILE.h5 writes one, score needs none."
        )
    if (side := _stored(model)) is not None:
        pairs = join_labels(stored.stimuli, side.stimuli, options["match"])
        order = np.array([side.stimuli.index(partner) for partner in pairs.values()])
        layers = {name: measure.take(values, order) for name, values in zip(side.names, side.values, strict=True)}
    else:
        with progress_bar() as progress:
            resolved = resolve_model(model, seed=seed)
            responses = resolved.respond(ScoreOptions(stimuli=options["stimuli"], seed=seed), progress=progress)
        pairs = join_labels(stored.stimuli, responses.labels, options["match"])
        features = responses.features([responses.labels.index(partner) for partner in pairs.values()])
        layers = {name: measure.layer(values) for name, values in features.items()}
    if len(pairs) < measure.fewest:
        raise DataError(
            f"{rdms} and {model} have {listing(pairs)} in common; a comparison needs {measure.fewest} stimuli."
        )
    rows = np.array([stored.stimuli.index(label) for label in pairs])
    brain = np.stack([measure.take(values, rows) for values in stored.values])
    values = compare_rdms(np.stack([*layers.values()])[:, None], brain, method=measure.comparison)
    title = f"{measure.comparison} of {len(pairs)} stimuli, {_described(stored)}"
    columns = {"": "{0[0]}", **{f">{name}": f"{{0[1][{place}]:.3f}}" for place, name in enumerate(stored.names)}}
    text = table_of(title, list(zip(layers, values.tolist(), strict=True)), columns)
    text += (
        "\nNothing is corrected for noise or tested, since a file of RDMs has no trials; the largest of many layers is "
        "no finding."
    )
    data = {"comparison": measure.comparison, "stimuli": pairs, "rdms": stored.names, "noise": "unknown"}
    return Output({**data, "values": dict(zip(layers, values.tolist(), strict=True))}, text)


def _of_rdms(metric: str) -> RSA:
    from brainbench.metrics import get_metric
    from brainbench.metrics.measures.rsa import RSA

    measure = get_metric(metric)
    if not isinstance(measure, RSA):
        raise UsageError(f"The metric {metric!r} has no RDM of animals; choose 'rsa' or another metric of RDMs.")
    return measure


def _stored(source: str) -> StoredRDMs | None:
    """Return the RDMs that a file of rsatoolbox (.h5, .hdf5) holds; None of whatever is no such file."""
    from brainbench.datasets.rdm_files import read_rdms

    path = Path(source)
    return read_rdms(path) if path.suffix.lower() in (".h5", ".hdf5") and path.is_file() else None


def _described(stored: StoredRDMs) -> str:
    about = "".join(f"; {name} {value}" for name, value in stored.about.items())
    notes = f"\nNote: {stored.note}." if stored.note else ""
    title = f"{len(stored.names)} RDM{'s' * (len(stored.names) > 1)} of {len(stored.stimuli)} stimuli"
    return f"{title} ({stored.measure or 'measure unknown'}{about}){notes}"


@app.command("check")
def check(
    source: Annotated[
        str, typer.Argument(help="'demo', an NWB, HDF5 or published .npz file, a folder, a glob, or LAYOUT:PATH.")
    ],
    conditions: Annotated[str | None, option(SCORE, "conditions")] = None,
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
    format: Annotated[
        str | None,
        typer.Option(help="'brainbench', 'nwb', or 'temporaldata' for torch_brain; by default the ending's."),
    ] = None,
) -> Output:
    """Write a small copy without raw data: spike times and tables. Scores of the copy are identical."""
    from brainbench.datasets import export as export_files

    sources = _found(source)
    with progress_bar("copying the recordings"):
        files = export_files(sources, target, select=select, format=format)
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


def _matrices(title: str, labels: Sequence[str], names: Iterable[str], rdms: Iterable[NDArray[np.float64]]) -> str:
    """Show upper triangles [P] as squares of numbers, if they are small."""
    from scipy.spatial.distance import squareform

    texts = []
    for name, rdm in zip(names, rdms, strict=True) if len(labels) <= _LARGEST_SHOWN else ():
        rows = [[label, *(f"{value:.3f}" for value in row)] for label, row in zip(labels, squareform(rdm), strict=True)]
        right = tuple(range(1, len(labels) + 1))
        texts.append("\n\n" + table(f"{title} {name}", ["", *labels], rows, right=right))
    return "".join(texts)


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
