"""``brainbench leaderboard verify``: is a record what it says it is?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table


def verify(
    records: Annotated[list[Path], typer.Argument(help="Record files or folders of them.")],
    recordings: Annotated[
        str | None, typer.Option("--recordings", "-r", help="Where the recordings are, if not 'demo'.")
    ] = None,
    score: Annotated[
        bool, typer.Option("--score/--no-score", help="Score the model again and compare; else only read the files.")
    ] = True,
    tolerance: Annotated[float, typer.Option(help="Numbers that differ by no more are equal.")] = 1e-3,
    as_json: JsonOption = False,
) -> None:
    """Check records: the file against its hash, the records against one another, the numbers against a repetition.

    Exit status 1 if a file was edited or a repetition gives something else; what differs is printed.
    """
    from leaderboards.audit import remarks
    from leaderboards.store import read_records

    stored = read_records(records)
    doubts = remarks(stored)
    results: list[dict[str, Any]] = []
    with progress_bar() as progress:
        for index, item in enumerate(stored):
            progress(index, len(stored), "records verified")
            result: dict[str, Any] = {"record": item.path.name, "verdict": "refused", "problem": item.problem}
            if item.record is not None:
                result |= {"verdict": "intact", "doubts": doubts.get(item.record.identity, ())}
                if score:
                    result |= _repeat(item.record, recordings, tolerance)
            results.append(result)
    emit(results, "\n".join(_text(result) for result in results), as_json=as_json)
    if any(result["verdict"] in ("refused", "differs", "not repeated") for result in results):
        raise typer.Exit(1)


def _repeat(record: Any, recordings: str | None, tolerance: float) -> dict[str, Any]:
    from brainbench.cli.leaderboard.scoring import score_again
    from brainbench.core.errors import BrainbenchError
    from leaderboards.changes import differences

    try:
        again = score_again(record, recordings=recordings)
    except BrainbenchError as error:
        return {"verdict": "not repeated", "problem": str(error)}
    found = differences(record, again, tolerance=tolerance)
    return {"verdict": "differs" if found else "confirmed", "differences": found, "value": again.score.value}


def _text(result: dict[str, Any]) -> str:
    words = {
        "confirmed": "confirmed: scored again with the same result",
        "intact": "intact: the file fits its hash (not scored again)",
        "differs": "differs: scored again with another result",
        "not repeated": f"not repeated: {result['problem']}",
        "refused": f"refused: {result['problem']}",
    }
    lines = [f"{result['record']}\n  {words[result['verdict']]}"]
    lines += [f"  {doubt}" for doubt in result.get("doubts", ())]
    if found := result.get("differences"):
        rows = [[item.what, _short(item.before), _short(item.after)] for item in found[:12]]
        lines.append(table("", ["what", "record", "now"], rows))
        lines += [f"  and {len(found) - 12} more"] if len(found) > 12 else []
    return "\n".join(lines)


def _short(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
