"""``brainbench score``: the main job."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli import destinations
from brainbench.cli.options import SCORE, SCORE_FLAGS, with_options
from brainbench.cli.output import JsonOption, emit, progress_bar, table, table_of
from brainbench.core.files import to_plain
from brainbench.core.records import Interval, ResultRecord, Score
from brainbench.scoring.options import ScoreOptions


def _complete_model(incomplete: str) -> list[str]:
    from brainbench.models.registry import list_models
    from brainbench.models.training.checkpoints import shipped

    return [name for name in (*list_models(), *shipped()) if name.startswith(incomplete)]


@with_options(SCORE, flags=SCORE_FLAGS)
def score(
    model: Annotated[
        str,
        typer.Argument(
            help="A registry name, FILE.py:FUNCTION that returns a torch module, or an HDF5 file of activations.",
            autocompletion=_complete_model,
        ),
    ],
    options: ScoreOptions,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", callback=destinations.out_folder, help="Folder of record and report."),
    ] = Path("brainbench-results"),
    report_file: Annotated[
        Path | None,
        typer.Option(
            "--report",
            callback=destinations.report_file,
            help="Also write a report for a paper: FILE.md, FILE.html or FILE.pdf.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score a model against neural recordings and write a result record and an HTML report."""
    from brainbench.metrics.explain import explain_file
    from brainbench.scoring.scores import score_record
    from leaderboards.site.score_page import write_report
    from leaderboards.store import write_record

    if options.explain and Path(model).suffix == ".npz":
        steps = to_plain(explain_file(model))
        emit({"estimator_walk": steps}, _walk(steps), as_json=as_json)
        return
    with progress_bar() as progress:
        record = score_record(model, options, command=_command(), progress=progress)
    path = write_record(record, out)
    report = write_report(record, path.with_suffix(".html"))
    data: dict[str, Any] = {"record": record, "record_path": path, "report_path": report}
    text = f"{_text(record)}\n\nrecord  {path}\nreport  {report}"
    if report_file is not None:
        from leaderboards.report.paper import write_paper

        data["paper_paths"] = write_paper([record], report_file, title=f"{record.score.name}: brainbench score")
        text += f"\npaper   {', '.join(map(str, data['paper_paths'][:2]))}"
    emit(data, text, as_json=as_json)


def _command() -> str:
    """Return the command as typed, without what only says where and how to print."""
    words = iter(sys.argv[1:])
    kept = []
    for word in words:
        if word in ("--out", "-o", "--report"):
            next(words, None)
        elif word not in ("--json", "-v", "--verbose") and not word.startswith(("--out=", "--report=")):
            kept.append(word)
    return shlex.join(["brainbench", *kept])


def _text(record: ResultRecord) -> str:
    from brainbench.metrics.inference.equivalence import turing_test

    score, animals = record.score, record.animal_to_animal
    known = score.subjects or (animals.subjects if animals else ())
    source = score.provenance.recordings["source"]
    parts = [f"{score.name}  ·  {len(score.stimuli)} stimuli  ·  {len(known)} animals  ·  {source}"]
    if record.synthetic:
        parts[0] += "\nSynthetic recordings: ranks on them say nothing about brains."
    ceiling = score.ceiling
    limits = f"noise ceiling {_number(ceiling.lower)} to {_number(ceiling.upper)}" if ceiling else "no noise ceiling"
    scale = f"chance {_number(score.chance)}, attainable {_number(score.attainable)}"
    rows = [
        ["score", _scaled_value(score), "0 = chance, 1 = explains all that is reliable"],
        ["status", score.status, "; ".join(score.reasons)],
        ["value", _with_span(score.value, score.interval), f"{score.metric}; {scale}"],
        ["raw r", _number(score.r), limits],
        ["reliability", _number(score.reliability), "of the animals' RDMs: split halves, Spearman-Brown, mean"],
        ["permutation p", _number(score.p), f"{score.p_method}; smallest possible {_number(score.p_smallest)}"],
        ["layer", str(score.layer), score.layer_rule],
        ["best layer", _number(score.best_layer_value), f"{score.best_layer}: optimistic maximum, not a result"],
        ["estimator", score.estimator, ""],
    ]
    parts += [table("", ["", "", ""], rows), *_details(score.provenance.statistics)]
    if animals is not None and score.estimator == "default" and score.subjects:
        alike = turing_test(score, animals).summary()
        parts.append(f"As much like the animals as they are like one another? {alike}")
    if walk := score.provenance.statistics.get("estimator_walk"):
        parts.append(_walk(walk))
    others = {"animal to animal": animals, **record.baselines}
    rows = [
        [name, _scaled_value(item), _number(item.p), item.status] for name, item in others.items() if item is not None
    ]
    if rows:
        parts.append(table("Baselines, same metric and animals", ["", "score", "p", "status"], rows))
    return "\n\n".join(parts)


def _walk(steps: list[dict[str, Any]]) -> str:
    """Lay out the walk from the published estimator to the default one."""
    columns = {
        ">value": lambda step: "–" if step["value"] is None else f"{step['value']:.3f}",
        "step": "{0[change]}",
        "status": "{0[status]}",
        "": "{0[detail]}",
    }
    return f"From the published estimator to the default, one fault at a time\n{table_of('', steps, columns)}"


def _details(statistics: Mapping[str, Any]) -> list[str]:
    """Lay out what single metrics and options add: accuracies by property, shares of variance, times."""
    parts = []
    if course := statistics.get("time_course"):
        parts.append(_over_time(course))
    if accuracies := statistics.get("decoding"):
        columns = {
            "property": "{0[property]}",
            ">accuracy": "{0[accuracy]:.2f}",
            ">without information": "{0[expected]:.2f}",
            ">1 / classes": "{0[chance]:.2f}",
            ">p": "{0[p]:.2g}",
        }
        parts.append(table_of("Decoding of stimuli left out", accuracies, columns))
    if shares := statistics.get("variance_partition"):
        parts.append(
            f"Variance of the animals' RDMs: {shares['total']:.2f} explained; by the model alone "
            f"{shares['unique_model']:.2f} (by luck {shares['chance']:.2f}), by {', '.join(shares['nuisances'])} alone "
            f"{shares['unique_nuisance']:.2f}, by either {shares['shared']:.2f}"
        )
    return parts


def _over_time(course: Mapping[str, Any]) -> str:
    """Lay out the best time and the latency of each layer that matches at some lag."""
    known = [(_scaled(point), point["time"]) for point in course["points"] if _is_known(point)]
    clear = sum(point["p"] is not None and point["p"] <= 0.05 for point in course["points"])
    text = f"Over time, {len(course['points'])} bins of {course['bin']:g} s: "
    if known:
        best, when = max(known)
        text += f"{clear} differ from chance (p of the best {course['p']:.2g}, corrected for all times); the best "
        text += f"score, {best:.2f} between chance (0) and all that is reliable (1), is at {when:.3g} s"
    else:
        text += "no animal is reliable in any bin"
    columns = {
        "layer": "{0[layer]}",
        ">latency": lambda row: "–" if row["latency"] is None else f"{1000 * row['latency']:.0f} ms",
        "interval": lambda row: (
            f"[{1000 * row['interval']['low']:.0f}, {1000 * row['interval']['high']:.0f}]" if row["interval"] else ""
        ),
        ">p": lambda row: "–" if row["p"] is None else f"{row['p']:.2g}",
        "": "{0[reason]}",
    }
    rows = table_of("Neurons follow the model by", course["latencies"], columns)
    return "\n".join([text, *course["reasons"], "", rows])


def _is_known(point: Mapping[str, Any]) -> bool:
    return point["value"] is not None and point["chance"] is not None and point["chance"] < 1


def _scaled(point: Mapping[str, Any]) -> float:
    """Return the score at one time between chance (0) and all that is reliable (1)."""
    return (point["value"] - point["chance"]) / (1 - point["chance"])


def _number(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "–"


def _scaled_value(score: Score) -> str:
    """Return the score on the scale that all metrics share; its value where there is none."""
    value = (score.value, score.interval) if math.isnan(score.scaled) else (score.scaled, score.scaled_interval)
    return _with_span(*value)


def _with_span(value: float, span: Interval | None) -> str:
    return f"{_number(value)} {f'[{_number(span.low)}, {_number(span.high)}]' if span else ''}"
