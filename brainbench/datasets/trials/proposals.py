"""Columns that could label trials: what each holds, and which to try first."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError
from brainbench.datasets.layouts.registry import RecordingLayout, detect_recipe
from brainbench.datasets.sessions import Session, SessionTable, as_labels, natural_order
from brainbench.datasets.trials.conditions import natural_vocabulary

EXAMPLES = 6
"""Number of values shown of a column."""
_MOST_VALUES = 60
_STIMULUS = re.compile(r"stim|cond|object|image|texture|shape|categ|orient|freq|odou?r|position", re.IGNORECASE)
_BEHAVIOUR = re.compile(r"resp|choice|accuracy|correct|outcome|confid|reward|react|lick|key|tags", re.IGNORECASE)


@dataclass(frozen=True)
class ColumnSummary:
    """One column of an interval table."""

    name: str
    kind: str
    """``text``, ``integer``, ``number``, ``boolean``, ``list`` (ragged) or ``other``."""
    distinct: int
    """Number of distinct values; 0 where they are not single values."""
    examples: tuple[str, ...] = ()
    fewest: int = 0
    """Trials of the rarest value."""


@dataclass(frozen=True)
class Proposal:
    """A ``--conditions`` value worth trying."""

    conditions: str
    labels: tuple[str, ...]
    fewest: int
    """Trials of the rarest label."""


def propose(sessions: Iterable[Session]) -> list[Proposal]:
    """Rank the columns that could label trials: 2–60 values (more if named like a stimulus), twice each or more.

    Stimulus-like names come before others and before behavioural ones; then text before integers
    before the rest, the table ``trials`` before others, and balanced columns before unbalanced.
    """
    ranked: list[tuple[tuple[float, ...], Proposal]] = []
    for session in sessions:
        recipe = detect_recipe(session)
        for name, table in session.tables.items():
            for column in summarise_columns(table):
                # A column named like a stimulus may have thousands of values; others would be mere numbers.
                most = np.inf if _STIMULUS.search(column.name) else _MOST_VALUES
                if not (2 <= column.distinct <= most and column.fewest >= 2) or _is_time(column):
                    continue
                ranked.append((_rank(name, column, len(table)), _proposal(session, name, column.name)))
        if recipe is not None:
            table = session.table(recipe.conditions.table)
            if all(name in table for name in recipe.conditions.columns):
                ranked.append(((-1.0,), _of_recipe(recipe, table)))
    return [proposal for _, proposal in sorted(ranked, key=lambda item: item[0])]


def _of_recipe(recipe: RecordingLayout, table: SessionTable) -> Proposal:
    values = [tuple(row) for row in recipe.conditions.values(table).tolist() if all(row)]
    declared = recipe.vocabulary(recipe.conditions) or natural_vocabulary(values)
    counts = Counter("-".join(row) for row in values)
    return Proposal(str(recipe.conditions), declared, min((counts[label] for label in declared), default=0))


def _rank(table: str, column: ColumnSummary, rows: int) -> tuple[float, ...]:
    topic = 0 if _STIMULUS.search(column.name) else 2 if _BEHAVIOUR.search(column.name) else 1
    kind = {"text": 0, "integer": 1}.get(column.kind, 2)
    imbalance = 1 - column.fewest * column.distinct / max(rows, 1)
    return (topic, kind, table != "trials", imbalance)


def _proposal(session: Session, table: str, column: str) -> Proposal:
    counts = Counter(item for item in as_labels(session.table(table).column(column)).tolist() if item)
    labels = list(counts)
    return Proposal(f"{table}:{column}", tuple(labels[index] for index in natural_order(labels)), min(counts.values()))


def _is_time(column: ColumnSummary) -> bool:
    return column.name in ("start_time", "stop_time") or column.name.endswith(("_time", "_times"))


def summarise_columns(table: SessionTable) -> Iterator[ColumnSummary]:
    """Describe every column of an interval table."""
    for name in table.columns:
        if f"{name}_index" in table:
            yield ColumnSummary(name, "list", 0)
            continue
        try:
            values = table.column(name)
        except DataError:
            yield ColumnSummary(name, "other", 0)
            continue
        unique, number = np.unique(values, return_counts=True)
        present = np.char.strip(unique) != "" if values.dtype.kind == "U" else np.isfinite(unique)
        unique, number, kind = unique[present], number[present], _kind(values)
        shown = unique[natural_order(unique)] if kind == "text" else unique
        labels = as_labels(shown[:EXAMPLES]).tolist()
        examples = tuple(f"{float(item):.6g}" for item in labels) if kind == "number" else tuple(labels)
        yield ColumnSummary(name, kind, len(unique), examples, int(min(number, default=0)))


def _kind(values: NDArray[Any]) -> str:
    if values.dtype.kind == "f" and len(values) and np.all(np.isfinite(values) & (values == np.round(values))):
        return "integer"
    return {"U": "text", "b": "boolean", "i": "integer", "u": "integer"}.get(values.dtype.kind, "number")
