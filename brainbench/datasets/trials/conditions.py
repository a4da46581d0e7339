"""Condition labels: which columns of which table make them, and their fixed order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, brief, check_once, repeats
from brainbench.datasets.sessions import SessionTable, as_labels, natural_key


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
