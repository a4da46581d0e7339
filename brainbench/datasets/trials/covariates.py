"""Covariates of trials: contacts, licks and the choice, the nuisances that responses may follow.

They are read where a file has them and become coordinates of the trials: ``contacts``, the number of
contacts of all tracked whiskers that begin inside the window; ``licks``, the number of licks inside it;
``choice``, 0 or 1 for the two sides in the order of their names, NaN where none was chosen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainbench.datasets.sessions import Session, SessionTable, as_labels
from brainbench.datasets.trials.windows import CONTACTS

COVARIATES = ("contacts", "licks", "choice")
LICKS = "licks"
"""Name of the event series, and of the table that a copy keeps it in."""
_NO_CHOICE = ("", "nogo", "none", "miss", "nan")


def trial_covariates(
    session: Session, table: SessionTable, rows: NDArray[np.int64], edges: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return what the session tells of the trials ``rows`` [R] with windows ``edges`` [R, 2] (s): name → [R]."""
    found = {}
    contacts = [item for name, item in session.tables.items() if CONTACTS.match(name)]
    if contacts:
        begin = np.concatenate([item.times("start_time") for item in contacts])
        end = np.concatenate([item.times("stop_time") for item in contacts])
        # Rows of zero duration are empty intervals.
        found["contacts"] = _inside(begin[end > begin], edges)
    if (licks := lick_times(session)) is not None:
        found["licks"] = _inside(licks, edges)
    if "choice" in table:
        chosen = as_labels(table.column("choice"))
        sides = sorted({side for side in chosen.tolist() if side.lower() not in _NO_CHOICE})
        if len(sides) == 2:
            # Coded in the order of the names, so that 0 and 1 mean the same sides in every session.
            values = np.select([chosen == side for side in sides], [0.0, 1.0], default=np.nan)
            found["choice"] = values[rows]
    return found


def lick_times(session: Session) -> NDArray[np.float64] | None:
    """Return the times (s, ascending) of the session's licks, or None if it has none."""
    if LICKS in session.tables:
        return np.sort(session.tables[LICKS].times("start_time"))
    for name, series in session.series.items():
        if name.rpartition("/")[2] == LICKS and series.timestamps is not None:
            return np.sort(np.asarray(series.timestamps[...], dtype=np.float64))
    return None


def _inside(times: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Count the times inside each window, [begin, end)."""
    times = np.sort(times[np.isfinite(times)])
    return np.diff(np.searchsorted(times, edges, side="left"), axis=1)[:, 0].astype(np.float64)
