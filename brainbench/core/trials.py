"""Trials of one recording session: what data sets hand to the metrics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Trials:
    """Trials of one session, whose units were recorded together. Letters: R trials, T time bins, U units."""

    responses: Any
    """[R, T, U] or [R, U] responses, such as firing rates in Hz; NaN where a unit was not recorded."""
    labels: Any
    """[R] stimulus of each trial: its place 0 … K−1 in the ordered vocabulary."""
    keys: Sequence[str] | None = None
    """[R] name of each trial, unique and independent of its place, from which random splits are drawn; without
    names they are drawn from the trials' content. Either way the order of trials, sessions and units is irrelevant."""
    covariates: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Further measurements of every trial, such as contacts or licks: name → [R], NaN where unknown."""

    def take(self, rows: Any) -> Trials:
        """Return the trials that an index or mask [R] names, in its order."""
        index = np.arange(len(self.labels))[rows]
        if np.array_equal(index, np.arange(len(self.labels))):
            # Long recordings in narrow bins are not copied for nothing.
            return self
        return Trials(
            np.asarray(self.responses)[index],
            np.asarray(self.labels)[index],
            None if self.keys is None else tuple(self.keys[int(row)] for row in index),
            {name: np.asarray(values)[index] for name, values in self.covariates.items()},
        )
