"""The table and the records that a site offers for download."""

from __future__ import annotations

import csv
import io
import math
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from brainbench.core.files import atomic_path
from brainbench.core.records import Score
from leaderboards.ranking import Board

_COLUMNS = (
    "recordings", "recordings_hash", "stimuli_hash", "time", "estimator", "metric", "synthetic",
    "row", "rank_first", "rank_last", "name", "value", "low", "high", "level", "status", "reasons",
    "p", "p_smallest", "r", "reliability", "ceiling_lower", "ceiling_upper",
    "layer", "best_layer", "best_layer_value", "animals",
    "family", "encoder", "attender", "objective", "augmentation", "parameters", "multiply_adds", "top1", "top5", "seed",
    "weights", "identity",
)  # fmt: skip


def boards_table(boards: Iterable[Board]) -> list[dict[str, Any]]:
    """Return every row of every board, baselines included; absent values are None."""
    rows = []
    for board in boards:
        common = {
            "recordings": board.recordings,
            "recordings_hash": board.recordings_hash,
            "stimuli_hash": board.stimuli_hash,
            "time": board.time,
            "estimator": board.estimator,
            "metric": board.metric,
            "synthetic": board.synthetic,
        }
        for row in board.rows:
            card = row.record.card
            described = {name: getattr(card, name) for name in _COLUMNS if card and hasattr(card, name)}
            values = common | described | _score_values(row.record.score, row.record.score.name)
            values |= {"row": "model", "rank_first": row.first, "rank_last": row.last, "identity": row.record.identity}
            rows.append(values)
        rows += [common | _score_values(item.score, item.name) | {"row": "baseline"} for item in board.baselines]
    return [{name: _known(row.get(name)) for name in _COLUMNS} for row in rows]


def table_csv(table: list[dict[str, Any]]) -> str:
    """Return :func:`boards_table` as CSV with one header line."""
    stream = io.StringIO()
    writer: csv.DictWriter[str] = csv.DictWriter(stream, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in table)
    return stream.getvalue()


def table_parquet(table: list[dict[str, Any]], path: Path) -> bool:
    """Write :func:`boards_table` as Parquet; return False where ``pyarrow`` is not installed."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        return False
    whole = ("rank_first", "rank_last", "animals", "parameters", "multiply_adds", "seed")
    numbers = ("value", "low", "high", "level", "p", "p_smallest", "r", "reliability", "ceiling_lower", "ceiling_upper",
               "best_layer_value", "top1", "top5")  # fmt: skip
    kinds = {name: pa.int64() for name in whole} | {name: pa.float64() for name in numbers} | {"synthetic": pa.bool_()}
    columns = pa.schema([(name, kinds.get(name, pa.string())) for name in _COLUMNS])
    with atomic_path(path) as temporary:
        parquet.write_table(pa.Table.from_pylist(table, schema=columns), temporary)
    return True


def records_zip(boards: Iterable[Board]) -> bytes:
    """Return the record files under their content-hash names: unpacking into a folder merges them.

    Equal records give equal bytes, so a rebuilt page shows no difference.
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for row in sorted((row for board in boards for row in board.rows), key=lambda row: row.record.file_name):
            entry = zipfile.ZipInfo(row.record.file_name)  # its fixed date of 1980 keeps the bytes equal
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, row.record.to_json() + "\n")
    return stream.getvalue()


def _score_values(score: Score, name: str) -> dict[str, Any]:
    plain = ("value", "status", "p", "p_smallest", "r", "reliability", "layer", "best_layer", "best_layer_value")
    values = {key: getattr(score, key) for key in plain}
    values |= {"name": name, "reasons": "; ".join(score.reasons), "animals": len(score.subjects)}
    if score.interval:
        values |= {"low": score.interval.low, "high": score.interval.high, "level": score.interval.level}
    if score.ceiling:
        values |= {"ceiling_lower": score.ceiling.lower, "ceiling_upper": score.ceiling.upper}
    return values


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    # A spreadsheet would run text that starts like a formula.
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return f"'{value}"
    return value
