"""``brainbench score``: the main job."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import (
    SCORE,
    SCORE_FLAGS,
    out_folder_option,
    report_file,
    score_command,
    typed_options,
    with_options,
)
from brainbench.cli.output import Output, progress_bar, table, table_of
from brainbench.core.errors import UsageError
from brainbench.core.files import to_plain
from brainbench.core.identity import plan_note
from brainbench.core.plugins import require_optional
from brainbench.core.records import ResultRecord, Score, spanned
from brainbench.core.statistics import compare_scores
from leaderboards.ranking import CHANCE_LEVEL, lacking
from leaderboards.store import write_record
from leaderboards.text import group_rows, unique_sentence

if TYPE_CHECKING:
    from brainbench.scoring.options import ScoreOptions

RAW_INPUT = "raw input"


def score_text(record: ResultRecord) -> str:
    """Lay out a result record."""
    score = record.score
    parts = ["\n".join(_headline(record)), table("", ["", "", ""], list(_rows(score)))]
    parts += _details(score.provenance.statistics)
    # A file of a record keeps its baselines in another order than they were scored in.
    others = {"animal to animal": record.animal_to_animal, **dict(sorted(record.baselines.items(), reverse=True))}
    if notes := list(_notes(record, others)):
        parts.append("\n".join(f"Note: {note}." for note in notes))
    if walk := score.provenance.statistics.get("estimator_walk"):
        parts.append(walk_text(walk))
    rows = [[name, _scaled_text(item), _p(item.p), item.status] for name, item in others.items() if item is not None]
    if rows:
        parts.append(table("Baselines, same metric and animals", ["", "score", "p", "status"], rows))
    return "\n\n".join(parts)


def _headline(record: ResultRecord) -> Iterator[str]:
    """Yield what was scored, its unique part, whether it is told apart from raw input, the score, and its limits."""
    from brainbench.models.activations import ReadReport

    score, animals = record.score, record.animal_to_animal
    subjects = score.subjects or (animals.subjects if animals else ())
    name = ": ".join(filter(None, (score.provenance.benchmark_name, score.provenance.recordings_name)))
    count = f"{len(subjects)} animal{'s' * (len(subjects) != 1)}"
    yield f"{score.name}{_weights(record)}  ·  {len(score.stimuli)} stimuli  ·  {count}  ·  {name}"
    yield from filter(None, (unique_sentence(score),))
    yield _against_raw_input(record)
    if score.status == "undefined":
        yield "No score: it is undefined."
    else:
        apart = f"{'not ' * (score.p > CHANCE_LEVEL)}told apart from chance, p = {_p(score.p)}"
        chance = "" if math.isnan(score.p) else f"; {apart}"
        scale = " (0 = chance, 1 = all that is reliable)" if math.isfinite(score.scaled) else " (no common scale)"
        yield f"Score {_scaled_text(score)}{scale}{chance}"
    if record.synthetic:
        yield "Synthetic recordings: ranks on them say nothing about brains."
    yield from left_out(score.provenance.recordings)
    if plan := plan_note(record):
        yield f"Plan: {plan}."
    if reading := score.provenance.get("reading"):
        yield f"Network: {ReadReport.of(reading)}."


def _weights(record: ResultRecord) -> str:
    """Return what the weights of a network are; empty for features computed elsewhere."""
    card = record.card
    if card is None or (card.objective is None and card.family != "user module"):
        return ""
    seed = f", seed {card.seed}" if card.seed is not None else ""
    if card.family == "user module":
        return f" (your code{seed})"
    return f" (random weights{seed})" if card.objective == "untrained" else f" (trained: {card.objective})"


def _against_raw_input(record: ResultRecord) -> str:
    """Say whether a score is told apart from that of the raw input, by the test that boards use."""
    score, raw = record.score, record.baselines.get(RAW_INPUT)
    if raw is None:
        return "Not compared with raw input: these features came without the input that they were computed from."
    for scored in (score, raw):
        if scored.status != "ok":
            reasons = "; ".join(scored.reasons)
            return f"Not compared with raw input: the score of {scored.name} is {scored.status} ({reasons})."
    comparison = compare_scores(score, raw)
    if not comparison.verdict:
        lacks = lacking(sum(item.status == "ok" for item in score.subjects), len(score.stimuli))
        return f"Not compared with raw input: this needs {lacks or 'values of single animals and stimuli'}."
    difference = spanned(comparison.difference, comparison.interval)
    return f"{comparison.verdict} raw input: difference {difference}, p = {_p(comparison.p)}"


def _rows(score: Score) -> Iterator[list[str]]:
    """Yield name, number and explanation of each statistic that exists."""
    yield ["status", score.status, "; ".join(score.reasons)]
    if math.isfinite(score.value):
        limits = f"chance {spanned(score.chance)}, attainable {spanned(score.attainable)}"
        yield ["value", spanned(score.value, score.interval), f"{score.metric}; {limits}"]
    if math.isfinite(score.r):
        ceiling = score.ceiling
        ceiling_text = (
            f"noise ceiling {spanned(ceiling.lower)} to {spanned(ceiling.upper)}" if ceiling else "no noise ceiling"
        )
        yield ["raw r", spanned(score.r), ceiling_text]
    if math.isfinite(score.reliability):
        reliability = spanned(score.reliability, score.reliability_interval, most=1.0)
        yield ["reliability", reliability, "of the animals' RDMs, from halves of their trials, mean"]
    if effective := score.provenance.statistics.get("effective"):
        units = f"{effective['units']:.3g} units in an animal (median)" if "units" in effective else ""
        animals = f"{effective['animals']:.2g} of {effective['of_animals']} animals" if "animals" in effective else ""
        yield ["effective number", "", ", ".join(filter(None, (units, animals)))]
    if math.isfinite(score.p):
        yield ["permutation p", _p(score.p), f"{score.p_method}; smallest possible {_p(score.p_smallest)}"]
    if score.layer is not None:
        yield ["layer", score.layer, score.layer_rule]
    if score.best_layer is not None:
        yield ["best layer", spanned(score.best_layer_value), f"{score.best_layer}: optimistic maximum, not a result"]
    yield ["estimator", score.estimator, "" if math.isfinite(score.value) else score.metric]


def _notes(record: ResultRecord, others: Mapping[str, Score | None]) -> Iterator[str]:
    """Yield notes on intervals that run past what can exist."""
    score, span = record.score, record.score.reliability_interval
    if span is not None and span.high > 1:
        yield "the interval of the reliability is cut at 1, the largest that can exist"
    spans = {name: item.scaled_interval for name, item in {"the score": score, **others}.items() if item is not None}
    beyond = [name for name, found in spans.items() if found is not None and found.high > 1]
    if beyond:
        yield (
            f"an interval above 1 ({', '.join(beyond)}) runs past all that is reliable, because the reliability that "
            "scores are divided by is itself an estimate"
        )


def left_out(recordings: Mapping[str, Any]) -> Iterator[str]:
    """Yield what was not used of recordings in one line, by the balance in their provenance."""
    from brainbench.datasets.ledger import balance_line

    if line := balance_line(recordings.get("ledger") or {}):
        yield f"Left out: {line}."


def walk_text(steps: list[dict[str, Any]]) -> str:
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
    if board := group_rows(statistics):
        parts.append(_groups(board))
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


def _groups(board: Mapping[str, Any]) -> str:
    """Lay out the scores of groups of units, and which is told apart."""
    columns = {
        "group": "{0[group]}",
        ">score": lambda row: spanned(row["scaled"], row["interval"]),
        ">p": lambda row: _p(row["p"]),
        "rank": "{0[rank]}",
        ">units": "{0[units]:,}",
        ">animals": "{0[animals]}",
        "layer": lambda row: row["layer"] or "–",
        "": lambda row: row["status"] if row["status"] == "ok" else "; ".join([row["status"], *row["reasons"][:1]]),
    }
    reason = board["reason"]
    text = table_of(f"By {board['by']}; p and ranks are corrected for the number of groups", board["rows"], columns)
    return f"{text}\n{reason[:1].upper()}{reason[1:]}."


def _over_time(course: Mapping[str, Any]) -> str:
    """Lay out the best time and the latency of each layer that matches at some lag."""
    times = []
    for point in course["points"]:
        value, chance = point["value"], point["chance"]
        if value is not None and chance is not None and chance < 1:
            times.append(((value - chance) / (1 - chance), point["time"]))
    clear = sum(point["p"] is not None and point["p"] <= 0.05 for point in course["points"])
    text = f"Over time, {len(course['points'])} bins of {course['bin']:g} s: "
    if times:
        best, when = max(times)
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


def _p(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "–"


def _scaled_text(score: Score) -> str:
    """Return the score on the scale that all metrics share; its value where there is none."""
    placed = math.isfinite(score.scaled)
    return spanned(*((score.scaled, score.scaled_interval) if placed else (score.value, score.interval)))


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
    out: Annotated[Path, out_folder_option("Folder of record and report.")] = Path("brainbench-results"),
    report: Annotated[
        Path | None,
        typer.Option(
            "--report",
            callback=report_file,
            help="Also write a report for a paper: FILE.md, FILE.html or FILE.pdf.",
        ),
    ] = None,
) -> Output:
    """Score a model against neural recordings and write a result record and an HTML report."""
    from brainbench.scoring.kept_records import keep, read_kept, record_path
    from leaderboards.site.build import write_report

    if options.explain and Path(model).suffix == ".npz":
        from brainbench.scoring.scores import PARTS

        if options != replace(type(options)(), explain=True) or report is not None:
            raise UsageError("A file of stored splits is explained by itself; leave out all options but --json.")
        steps = to_plain(require_optional(PARTS, "explain_file", "part of a score")(model))
        return Output({"estimator_walk": steps}, walk_text(steps))
    command = score_command(model, options)
    cached = record_path(model, options, command)
    record, note = read_kept(cached), "  (as scored before: nothing has changed since)"
    if record is None:
        from brainbench.scoring.scores import score_record

        # Beside a benchmark a default that was typed is a choice too.
        typed = {name: getattr(options, name) for name in typed_options(sys.argv) if options.benchmark is not None}
        with progress_bar() as progress:
            record, note = score_record(model, options, command=command, progress=progress, **typed), ""
        keep(record, cached)
    path = write_record(record, out)
    page = write_report(record, path.with_suffix(".html"))
    data: dict[str, Any] = {"record": record, "record_path": path, "report_path": page}
    if (raw := record.baselines.get(RAW_INPUT)) and record.score.status == raw.status == "ok":
        data["against_raw_input"] = compare_scores(record.score, raw)
    text = f"{score_text(record)}\n\nrecord  {path}{note}\nreport  {page}"
    if report is not None:
        from leaderboards.report.paper import write_paper

        data["paper_paths"] = write_paper([record], report, title=f"{record.score.name}: brainbench score")
        text += f"\npaper   {', '.join(map(str, data['paper_paths'][:2]))}"
    return Output(data, text)
