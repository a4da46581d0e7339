"""``brainbench score``: the main job."""

from __future__ import annotations

import math
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.output import JsonOption, SelectOption, WindowOption, emit, progress_bar, table

if TYPE_CHECKING:
    from brainbench.core.records import ResultRecord, Score


_RELIABILITY = {
    True: "split halves, Spearman-Brown, mean over animals",
    False: "share of the variance between stimuli that is not trial noise, mean over animals",
}


def _complete_model(incomplete: str) -> list[str]:
    from brainbench.models.registry import list_models

    return [name for name in list_models() if name.startswith(incomplete)]


def score(
    model: Annotated[
        str,
        typer.Argument(
            help="A registry name, FILE.py:FUNCTION that returns a torch module, or an HDF5 file of activations.",
            autocompletion=_complete_model,
        ),
    ],
    recordings: Annotated[
        str, typer.Option("--recordings", "-r", help="'demo' (synthetic), an NWB or HDF5 file, a folder, or a glob.")
    ] = "demo",
    stimuli: Annotated[
        str, typer.Option("--stimuli", "-s", help="A recipe, a scene file, a stimulus-set file, or an HDF5 array.")
    ] = "rodgers",
    conditions: Annotated[
        str | None, typer.Option(help="TABLE:COLUMN[,COLUMN] of the recordings that labels the trials.")
    ] = None,
    match: Annotated[
        Path | None, typer.Option(help="JSON, TOML or CSV file: recording label → stimulus label.")
    ] = None,
    select: SelectOption = None,
    window: WindowOption = None,
    whiskers: Annotated[str, typer.Option(help="Whiskers to simulate: all, C0-C3, C2,D1, …")] = "all",
    fidelity: Annotated[
        str, typer.Option(help="Simulation preset: balanced, accurate, or fast (to try things out; coarse RDMs).")
    ] = "balanced",
    layers: Annotated[str | None, typer.Option(help="Comma-separated layers to compare; all by default.")] = None,
    time: Annotated[
        str, typer.Option(help="Time axis of both sides: 'mean' averages over it, 'concatenate' keeps every step.")
    ] = "mean",
    bin: Annotated[float | None, typer.Option(help="Bin width of the spike counts in seconds.")] = None,
    estimator: Annotated[str, typer.Option(help="default, thesis or thesis-input (as published).")] = "default",
    metric: Annotated[
        str,
        typer.Option(
            help="rsa, rsa-crossnobis, rsa-partial, cka, decoding, ridge, procrustes, or FILE.py:CLASS of your own."
        ),
    ] = "rsa",
    normalize: Annotated[
        bool, typer.Option(help="Give plain modules forces in 1e-4 N and moments in 1e-6 N·m instead of SI.")
    ] = True,
    seed: Annotated[int, typer.Option(help="Seed of untrained weights and of split halves.")] = 0,
    weights_seed: Annotated[
        int | None, typer.Option(help="Seed of untrained weights alone; --seed then keeps that of the statistics.")
    ] = None,
    explain_estimator: Annotated[
        bool,
        typer.Option(
            "--explain-estimator",
            help="Also walk from the published estimator to the default one, fault by fault; MODEL may then be an .npz "
            "of stored splits (arrays r_xy, r_yy and r_xx).",
        ),
    ] = False,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the record and the report.")] = Path(
        "brainbench-results"
    ),
    report_file: Annotated[
        Path | None,
        typer.Option("--report", help="Also write a report for a paper: FILE.md, FILE.html or FILE.pdf."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score a model against neural recordings and write a result record and an HTML report."""
    from brainbench.scoring.scores import score_record
    from leaderboards.report.score_report import write_report
    from leaderboards.store import write_record

    if explain_estimator and Path(model).suffix == ".npz":
        _explain_splits(Path(model), as_json=as_json)
        return
    with progress_bar() as progress:
        record = score_record(
            model,
            recordings=recordings,
            stimuli=stimuli,
            conditions=conditions,
            match=match,
            select=select,
            window=window,
            whiskers=whiskers,
            fidelity=fidelity,
            layers=tuple(name.strip() for name in layers.split(",")) if layers else None,
            time=time,  # pyright: ignore[reportArgumentType]  # checked there, with the allowed values
            bin=bin,
            estimator=estimator,
            metric=metric,
            normalize=normalize,
            seed=seed,
            weights_seed=weights_seed,
            explain=explain_estimator,
            command=_command(),
            progress=progress,
        )
    path = write_record(record, out)
    report = write_report(record, path.with_suffix(".html"))
    data: dict[str, Any] = {"record": record, "record_path": path, "report_path": report}
    text = f"{_text(record)}\n\nrecord  {path}\nreport  {report}"
    if report_file is not None:
        from leaderboards.report.paper import write_paper

        data["paper_paths"] = write_paper([record], report_file, title=f"{record.score.name}: brainbench score")
        text += f"\npaper   {', '.join(map(str, data['paper_paths'][:2]))}"
    emit(data, text, as_json=as_json)


def _alike(record: ResultRecord, animals: Score) -> str:
    """Test the score against the animals' own consistency (NeuroAI Turing test)."""
    from brainbench.metrics import turing_test

    return turing_test(record.score, animals).summary()


def _explain_splits(path: Path, *, as_json: bool) -> None:
    """Print the walk through stored split halves."""
    import numpy as np

    from brainbench.core.errors import DataError, DataFileNotFoundError
    from brainbench.core.files import to_plain
    from brainbench.metrics.explain import explain_splits

    if not path.is_file():
        raise DataFileNotFoundError(f"There is no file {path}.")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is no .npz file of plain arrays ({error}).") from error
    if missing := {"r_xy", "r_yy"} - arrays.keys():
        raise DataError(f"{path} lacks the array {sorted(missing)[0]!r}; it has {sorted(arrays)}.")
    steps = [to_plain(step) for step in explain_splits(arrays["r_xy"], arrays["r_yy"], r_xx=arrays.get("r_xx"))]
    emit({"estimator_walk": steps}, _walk(steps), as_json=as_json)


def _walk(steps: list[dict[str, Any]]) -> str:
    """Lay out the walk from the published estimator to the default one."""
    rows = [
        ["–" if step["value"] is None else f"{step['value']:.3f}", step["change"], step["status"], step["detail"]]
        for step in steps
    ]
    title = "From the published estimator to the default, one fault at a time"
    return f"{title}\n{table('', ['value', 'step', 'status', ''], rows, right=(0,))}"


def _command() -> str:
    """The command as typed, without what only says where and how to print."""
    words = iter(sys.argv[1:])
    kept = []
    for word in words:
        if word in ("--out", "-o", "--report"):
            next(words, None)
        elif word not in ("--json", "-v", "--verbose") and not word.startswith(("--out=", "--report=")):
            kept.append(word)
    return shlex.join(["brainbench", *kept])


def _text(record: ResultRecord) -> str:
    score = record.score
    source = score.provenance["recordings"]["source"]
    known = score.subjects or (record.animal_to_animal.subjects if record.animal_to_animal else ())
    lines = [f"{score.name}  ·  {len(score.stimuli)} stimuli  ·  {len(known)} animals  ·  {source}"]
    if record.synthetic:
        lines.append("Synthetic recordings: ranks on them say nothing about brains.")
    rsa = score.metric.startswith("RSA")
    facts = [
        [
            "score",
            f"{_number(score.value)} {_interval(score)}",
            "noise-corrected RSA, 1 = explains all that is reliable" if rsa else score.metric,
        ],
        ["status", score.status, "; ".join(score.reasons)],
        ["raw r", _number(score.r), _ceiling(score)],
        ["reliability", _number(score.reliability), _RELIABILITY[rsa]],
        ["permutation p", _number(score.p), f"{score.p_method}; smallest possible {_number(score.p_smallest)}"],
        ["layer", str(score.layer), score.layer_rule],
        ["best layer", f"{_number(score.best_layer_value)}", f"{score.best_layer}: optimistic maximum, not a result"],
        ["estimator", score.estimator, score.metric],
    ]
    others = [("animal to animal", record.animal_to_animal), *record.baselines.items()]
    rows = [
        [name, f"{_number(item.value)} {_interval(item)}", item.status] for name, item in others if item is not None
    ]
    text = "\n".join(lines) + "\n\n" + table("", ["", "", ""], facts)
    if found := _details(score.provenance.get("statistics", {})):
        text += f"\n\n{found}"
    if record.animal_to_animal is not None and score.estimator == "default" and score.subjects:
        text += f"\n\nAs much like the animals as they are like one another? {_alike(record, record.animal_to_animal)}"
    if walk := score.provenance.get("statistics", {}).get("estimator_walk"):
        text += f"\n\n{_walk(walk)}"
    if rows:
        text += "\n\n" + table("Baselines, same estimator", ["", "score", "status"], rows)
    return text


def _details(statistics: dict[str, Any]) -> str:
    """Lay out what single metrics add: accuracies by property, shares of variance."""
    parts = []
    if accuracies := statistics.get("decoding"):
        rows = [
            [
                item["property"],
                *(f"{item[name]:.2f}" for name in ("accuracy", "expected", "chance")),
                f"{item['p']:.2g}",
            ]
            for item in accuracies
        ]
        columns = ["property", "accuracy", "without information", "1 / classes", "p"]
        parts.append(table("Decoding of stimuli left out", columns, rows, right=(1, 2, 3, 4)))
    if shares := statistics.get("variance_partition"):
        parts.append(
            f"Variance of the animals' RDMs: {shares['total']:.2f} explained; by the model alone "
            f"{shares['unique_model']:.2f} (by luck {shares['chance']:.2f}), by {', '.join(shares['nuisances'])} alone "
            f"{shares['unique_nuisance']:.2f}, by either {shares['shared']:.2f}"
        )
    return "\n\n".join(parts)


def _number(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "–"


def _interval(score: Score) -> str:
    if score.interval is None:
        return ""
    return f"[{_number(score.interval.low)}, {_number(score.interval.high)}]"


def _ceiling(score: Score) -> str:
    if score.ceiling is None:
        return "no noise ceiling"
    return f"noise ceiling {_number(score.ceiling.lower)} to {_number(score.ceiling.upper)}"
