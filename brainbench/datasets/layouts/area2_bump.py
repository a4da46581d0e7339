"""Layout of Area2_Bump (DANDI 000127): macaque somatosensory area 2 during reaches and bumps of the arm.

The manipulandum pushes the hand in one of the directions of the reaches (passive trials), or the
monkey reaches there (active ones). ``trials`` names both by ``cond_dir`` (degrees) and tells them
apart by ``ctr_hold_bump``; the layout joins the two to one label, such as ``passive-90``.
"""

from __future__ import annotations

import numpy as np

from brainbench.core.contracts import as_labels
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.conditions import Conditions
from brainbench.datasets.trials.selection import Rule, Selection
from brainbench.datasets.trials.windows import Window

DIRECTIONS = tuple(str(angle) for angle in range(0, 360, 45))
PASSIVE = "passive"


def adapt(session: Session) -> Session:
    """Add the columns ``movement`` (``active`` or ``passive``) and ``direction`` (degrees, 0 to 359)."""
    table = session.tables.get("trials")
    needed = ("ctr_hold_bump", "cond_dir")
    if table is None or "movement" in table or any(name not in table for name in needed):
        return session
    bump = np.isin(np.char.lower(as_labels(table.column("ctr_hold_bump"))), ("true", "1"))
    # Angles that differ by whole turns are one direction and must get one label.
    angle = table.times("cond_dir") % 360
    movement = np.where(bump, PASSIVE, "active")
    return session.with_table(table.with_columns(movement=movement, direction=as_labels(angle)))


LAYOUT = RecordingLayout(
    name="area2-bump",
    title="reaches and bumps of the arm, units of macaque area 2 (DANDI 000127)",
    citation="Chowdhury R. H., Glaser J. I., Miller L. E., eLife 9:e48198 (2020), doi:10.7554/eLife.48198",
    conditions=Conditions("trials", ("movement", "direction")),
    orders={"movement": ("active", PASSIVE), "direction": DIRECTIONS},
    selection=Selection(name="area2-bump", trials=(Rule("result", allow=("R",), required=False),)),
    window=Window("move_onset_time", offset=-0.1, length=0.6),
    columns=("cond_dir", "ctr_hold_bump", "bump_time", "move_onset_time", "split"),
    adapt=adapt,
    touch="bump_time",
    dandiset="000127",
    remarks=(
        "window: 100 ms before to 500 ms after move_onset_time, as in the Neural Latents Benchmark; needs that time",
        "coverage: the training file holds several segments of the session, told by obs_intervals",
        "the file of test trials has neither directions nor results and is refused",
    ),
)
