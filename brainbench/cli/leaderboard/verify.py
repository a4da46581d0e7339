"""``brainbench leaderboard verify``: check records, and score their models again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import SCORE, SCORE_FLAGS, option_fields, with_options
from brainbench.cli.output import Output, table_of, tracked
from brainbench.core.errors import BrainbenchError, DataError, UsageError, brief, visible

if TYPE_CHECKING:
    from brainbench.core.records import ResultRecord
    from leaderboards.held_out import Commitment
    from leaderboards.store import StoredRecord


@dataclass(frozen=True)
class Repetition:
    """How records are scored again."""

    recordings: str | None = None
    """Where the recordings are, if not 'demo'."""
    stimuli: str | None = None
    """Stimuli, if not a recipe of the package."""
    benchmark: str | None = None
    """Benchmark (.zip, .toml or name) that the records are of, in place of recordings and stimuli."""
    score: bool = True
    """Score the model again and compare; else only read the files."""
    tolerance: float = 1e-3
    """Numbers that differ by no more are equal."""
    trust_code: bool = False
    """Also run code and weights that do not come with this package."""
    held_out: str | None = None
    """Published commitment; also score on what it holds back."""
    secret: Path = Path("held-out-secret")
    """Folder of the held-out recordings."""

    def commitment(self) -> Commitment | None:
        """Return the commitment, if there is one; one that is not usable, or a secret, is told before any score."""
        from leaderboards.held_out import Commitment

        # An empty text too is none: workflows pass on a variable that a board may lack.
        if not self.held_out:
            return None
        commitment = Commitment.read(Path(self.held_out))
        commitment.open(self.secret)
        return commitment


REPETITION = "brainbench.cli.leaderboard.verify:Repetition"


@with_options(REPETITION, parameter="how", flags=SCORE_FLAGS)
def verify(
    records: Annotated[list[Path], typer.Argument(help="Record files or folders of them.")],
    how: Repetition,
) -> Output:
    """Check records: the file against its hash, the records against one another, the numbers against a repetition.

    Only models of the registry, weights and stimuli that come with the package are repeated: code that a record names
    could do anything, and could read the answer, and a path in it could be that of any file. Exit status 1 if a file
    was edited, a repetition gives something else or cannot be made; what differs is printed.
    """
    from leaderboards.store import read_records

    commitment = how.commitment()
    return verdicts(read_records(records), how, commitment)


def verdicts(stored: Sequence[StoredRecord], how: Repetition, commitment: Commitment | None = None) -> Output:
    """Return what is found about records, with exit status 1 where one is refused, differs or is not repeated."""
    from brainbench.cli.leaderboard.held_out import score_held_out
    from leaderboards.audit import differences, remarks

    doubts = remarks(stored)
    results: list[dict[str, Any]] = []
    for entry in tracked(stored, "records verified"):
        result: dict[str, Any] = {"record": entry.path.name, "verdict": "refused", "problem": entry.problem}
        if entry.record is not None:
            result |= {"verdict": "intact", "doubts": doubts.get(entry.record.identity, ())}
            try:
                if how.score:
                    again = score_again(entry.record, how)
                    changes = differences(entry.record, again, tolerance=how.tolerance)
                    result |= {"verdict": "differs" if changes else "confirmed", "differences": changes}
                    result |= {"value": again.score.value}
                if commitment is not None and result["verdict"] in ("intact", "confirmed"):
                    refuse_foreign_code(entry.record, trusted=how.trust_code)
                    result |= score_held_out(entry.record, commitment, how.secret)
            except BrainbenchError as error:
                result |= {"verdict": "not repeated", "problem": str(error)}
        results.append(result)
    failed = any(result["verdict"] in ("refused", "differs", "not repeated") for result in results)
    text = "\n".join(_verdict(result) for result in results)
    return Output(results, text, failure=typer.Exit(1) if failed else None)


def score_again(record: ResultRecord, how: Repetition) -> ResultRecord:
    """Repeat a record's computation from its provenance, of which only names that this package knows are taken.

    Only demo recordings are found without ``how.recordings``, since records keep no folders.
    """
    from brainbench.scoring.demo import DEMOS
    from brainbench.scoring.options import ScoreOptions
    from brainbench.scoring.scores import score_record

    origin = record.score.provenance
    model, source = origin.settings.get("model"), origin.recordings.get("source")
    _check_kinds(record, model, source)
    if not isinstance(model, str):
        raise DataError(
            f"The record of {record.score.name!r} does not name a model that can be loaded (a module in memory or a "
            "record of an earlier layout); score the model again."
        )
    refuse_foreign_code(record, trusted=how.trust_code, stimuli=how.stimuli or how.benchmark)
    if how.benchmark is not None:
        return score_record(model, ScoreOptions.stated_in(origin.settings, benchmark=how.benchmark))
    if how.recordings is None and (not isinstance(source, str) or source not in DEMOS):
        name = origin.benchmark_name
        advice = f", or the benchmark {brief(name)} with --benchmark FILE" if name else ""
        raise UsageError(
            f"The record was made with recordings {str(source)[:80]!r}; give them with --recordings PATH{advice}."
        )
    others = {"recordings": how.recordings or source, "match": origin.pairs or None}
    options = ScoreOptions.stated_in(origin.settings, **others, **({"stimuli": how.stimuli} if how.stimuli else {}))
    return score_record(model, options)


def _check_kinds(record: ResultRecord, model: Any, source: Any) -> None:
    """Raise DataError for settings of other kinds than the options of a score: anyone may have written the record."""
    from brainbench.core.reading.values import typed_values

    origin = record.score.provenance
    stated: dict[str, tuple[Any, Any]] = {
        "model": (model, str),
        "source": (source, str | list[str]),
        "pairs": (origin.pairs, dict[str, str | None]),
        # Presets are texts, other fidelities their fields.
        "fidelity": (origin.settings.get("fidelity"), str | dict[str, Any]),
    }
    for name, option in option_fields(SCORE).items():
        kind = list[str] if option.several else str if option.kind is Path else option.kind
        stated.setdefault(name, (origin.settings.get(name), kind))
    for name, (value, kind) in stated.items():
        typed_values(kind | None, value, f"the setting {name!r} of {record.score.name[:80]!r}")


def refuse_foreign_code(record: ResultRecord, *, trusted: bool, stimuli: str | None = None) -> None:
    """Refuse to run or open what a record names unless it is in the registry or comes with the package.

    ``stimuli`` given by whoever asks stand in place of the record's.
    """
    from brainbench.metrics import list_metrics
    from brainbench.models.registry import list_models
    from brainbench.models.training.checkpoints import shipped
    from brainbench.stimuli.scenes.recipes import is_packaged

    settings = record.score.provenance.settings
    if not (trusted or stimuli or settings.get("stimuli") is None or is_packaged(settings["stimuli"])):
        raise UsageError(
            f"The stimuli {brief(settings['stimuli'])} of the record do not come with this package, and what a record "
            "names is not opened; give yours with --stimuli, or trust the record with --trust-code."
        )
    ours = {"model": [*list_models(), *shipped()], "metric": list_metrics()}
    for what, names in ours.items():
        if not trusted and settings.get(what) not in names:
            raise UsageError(
                f"The {what} {str(settings.get(what))[:80]!r} of the record is not in the registry and does not come "
                "with this package; read its code, then run it with --trust-code."
            )


def _verdict(result: dict[str, Any]) -> str:
    from leaderboards.audit import in_short

    words = {
        "confirmed": "confirmed: scored again with the same result",
        "intact": "intact: the file fits its hash (not scored again)",
        "differs": "differs: scored again with another result",
        "not repeated": f"not repeated: {result['problem']}",
        "refused": f"refused: {result['problem']}",
    }
    lines = [visible(result["record"]), f"  {visible(words[result['verdict']])}"]
    lines += [f"  {visible(doubt)}" for doubt in result.get("doubts", ())]
    if held := result.get("held_out"):
        columns = {name: f"{{0[{name}]}}" for name in ("on", "score", "low", "high", "standing")}
        rows = [{"on": "public part", **result["on_public"]}, {"on": f"held-out {held}", **result["on_held_out"]}]
        lines.append(table_of("", rows, columns))
    if changes := result.get("differences"):
        cells = [(change.what, in_short(change.before), in_short(change.after)) for change in changes[:12]]
        lines.append(table_of("", cells, {"what": "{0[0]}", "record": "{0[1]}", "now": "{0[2]}"}))
        lines += [f"  and {len(changes) - 12} more"] if len(changes) > 12 else []
    return "\n".join(lines)
