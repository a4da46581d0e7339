"""Condition labels: which columns of which table make them, and their fixed order."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import DOUBTFUL_WORDS, as_labels, natural_key, near_labels
from brainbench.core.errors import DataError, UsageError, brief, check_once, listing, repeats
from brainbench.datasets.sessions import SessionTable


@dataclass(frozen=True)
class Conditions:
    """Columns of an interval table whose values, joined with "-", label each trial."""

    table: str
    columns: tuple[str, ...]

    @classmethod
    def parse(cls, source: str) -> Conditions:
        """Read ``TABLE:COLUMN[,COLUMN…]``.

        >>> Conditions.parse("trials:stimulus,servo_position").columns
        ('stimulus', 'servo_position')
        """
        table, colon, rest = source.rpartition(":")
        columns = tuple(item.strip() for item in rest.split(","))
        if not colon or not table.strip() or not all(columns):
            raise UsageError(
                f"The conditions {brief(source)} cannot be read; write TABLE:COLUMN or TABLE:COLUMN,COLUMN, such as "
                f"'trials:stimulus'. `brainbench recordings inspect FILE` proposes some."
            )
        check_once(f"The text {brief(source)} for the conditions", columns)
        return cls(table.strip(), columns)

    def __str__(self) -> str:
        return f"{self.table}:{','.join(self.columns)}"

    def values(self, table: SessionTable) -> NDArray[np.str_]:
        """Return the condition values of every row as text [rows, columns]; "" where missing."""
        return np.stack([as_labels(table.column(name)) for name in self.columns], axis=1)

    def forms(self, table: SessionTable) -> dict[tuple[str, str], set[str]]:
        """Return how the file writes each value: (column, its label) → the forms, of which most values have one."""
        forms: dict[tuple[str, str], set[str]] = {}
        for name in self.columns:
            values = np.unique(table.column(name))
            for value, label in zip(values.tolist(), as_labels(values).tolist(), strict=True):
                written = ascii(value) if isinstance(value, str) else repr(value)
                if isinstance(value, (int, float)) and abs(value) < 2**53:
                    written = repr(float(value))
                forms.setdefault((name, label), set()).add(written)
        return forms


def label_doubts(forms: Mapping[tuple[str, str], Collection[str]], vocabulary: Iterable[str]) -> Iterator[str]:
    """Say which labels were merged, which differ by little, and which may be missing values.

    Args:
        forms: (column, label) → how files write it, joined over all files.
        vocabulary: all labels that have trials.
    """
    merged = [(name, label, sorted(written)) for (name, label), written in forms.items() if label and len(written) > 1]
    if merged:
        texts = (f"{label} of {name} ({', '.join(written[:3])})" for name, label, written in merged)
        yield f"values that are written differently count as one label: {listing(texts, limit=3, quoted=False)}"
    for twins in near_labels(vocabulary):
        yield f"labels that differ only in case, blanks or digits count as different stimuli: {listing(twins)}"
    words = sorted({part for label in vocabulary for part in label.split("-") if part.lower() in DOUBTFUL_WORDS})
    if words:
        yield f"the label {listing(words)} may mean a missing value, and counts as a stimulus"


def joined_labels(values: NDArray[np.str_]) -> list[str]:
    """Return the label of each row of condition values [rows, columns]; "" where any value is missing."""
    return ["-".join(row) if all(row) else "" for row in values.tolist()]


def natural_vocabulary(values: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    """Order the labels of condition values: column by column, numbers numerically, text naturally."""
    # Sorted, not in order of appearance: that depends on the session that comes first, and RDMs would not share axes.
    ordered = sorted(set(values), key=lambda row: [natural_key(item) for item in row])
    labels = ["-".join(row) for row in ordered]
    if twice := repeats(labels):
        raise DataError(f"Two combinations of condition values both read {twice[0]!r}; choose fewer columns.")
    return tuple(labels)
