"""Layouts of Rodgers 2022 (DANDI 000231): mice that recognise shapes with their whiskers.

Two tasks share one layout. *Discrimination*: convex or concave, one side each. *Detection*: a shape of
either kind on one side, ``nothing`` on the other. ``rodgers`` reads both as the published analysis
pooled them, ``rodgers-discrimination`` and ``rodgers-detection`` read one; the last keeps ``nothing``
as a seventh stimulus. ``get_layout("rodgers").describe()`` prints every rule.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brainbench.core.contracts import as_labels
from brainbench.core.errors import listing
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.selection import Conditions, Rule, Selection, joined_labels
from brainbench.datasets.trials.windows import CONTACTS, FIRST_CONTACT, Window

TITLE = "object recognition by whiskers, barrel cortex units (DANDI 000231)"
CITATION = "Rodgers C. C., Scientific Data 9:620 (2022), doi:10.1038/s41597-022-01728-1"

CONDITIONS = Conditions("trials", ("stimulus", "servo_position"))
ORDERS = {"stimulus": ("convex", "concave"), "servo_position": ("close", "medium", "far")}
"""Fixed order of the vocabulary: convex-close, convex-medium, convex-far, concave-close, …"""

SELECTION = Selection(
    name="rodgers",
    trials=(
        Rule("stimulus", refuse=("nothing",)),
        Rule("outcome", refuse=("spoil",)),
        Rule("direct_delivery", refuse=("true",), required=False),
        Rule("stim_is_random", refuse=("false",), required=False),
        Rule("optogenetic", refuse=("true",), required=False),
        Rule("ignore_trial", refuse=("true",), required=False),
    ),
)
"""The trials that the data descriptor (its table 6) says to ignore, and the detection task's
``nothing``. ``ignore_trial`` stands last, so that it counts only trials ruined in some other way."""

WINDOW = Window(anchor=FIRST_CONTACT, stop="choice", fallback=Window(anchor="choice", offset=-1.0, length=1.0))
"""First contact to choice, as in the published analysis; the last second before the choice where a
session has no contact tables."""

COLUMNS = ("stimulus", "servo_position", "outcome", "choice_time")

REMARKS = (
    "trials: a contact must last longer than zero to be the first; no contact before the choice removes the trial",
    "trials: the window must lie inside the recorded span (obs_intervals, else the session's first to last spike)",
    "clock: times are used as stored; the voltage series' starting_time is never subtracted",
)

NOTHING = "nothing"
TRACKED = ("C0", "C1", "C2", "C3")
"""Whiskers whose contacts were tracked; a session may lack the table of one that was lost."""
LABELS = tuple(f"{shape}-{place}" for shape in ORDERS["stimulus"] for place in ORDERS["servo_position"])


def task(session: Session) -> str:
    """Return ``"detection"`` if any trial of the session was without a shape, else ``"discrimination"``."""
    stimuli = as_labels(session.table(CONDITIONS.table).column("stimulus"))
    return "detection" if NOTHING in stimuli.tolist() else "discrimination"


def adapt(session: Session) -> Session:
    """Add two columns to the trials: ``task``, and ``object`` (shape and position, or ``nothing``).

    Where a shape would have been has no meaning on a trial without one, so all of those are alike. A
    tracked whisker without contacts is named in the notes.
    """
    table = session.tables.get(CONDITIONS.table)
    if table is None or any(name not in table for name in CONDITIONS.columns) or "task" in table:
        return session
    values = CONDITIONS.values(table)
    objects = (
        np.where(values[:, 0] == NOTHING, NOTHING, joined_labels(values)) if len(table) else np.zeros(0, dtype="U1")
    )
    trials = table.with_columns(task=np.full(len(table), task(session)), object=objects)
    have = {match["whisker"] for match in map(CONTACTS.match, session.tables) if match}
    lost = [name for name in TRACKED if name not in have]
    note = f"{session.source}: no contact table of {listing(lost)}; the first contact is that of the other whiskers"
    return session.with_table(trials, *([note] if have and lost else []))


LAYOUT = RecordingLayout(
    name="rodgers",
    title=TITLE,
    citation=CITATION,
    conditions=CONDITIONS,
    orders=ORDERS,
    selection=SELECTION,
    window=WINDOW,
    columns=COLUMNS,
    remarks=REMARKS,
    adapt=adapt,
    dandiset="000231",
    assets="*ecephys*",
    stimuli="rodgers",
)
DISCRIMINATION = replace(
    LAYOUT,
    columns=(),
    name="rodgers-discrimination",
    title=f"{TITLE}, sessions of the discrimination task",
    selection=replace(
        SELECTION, name="rodgers-discrimination", trials=(Rule("task", allow=("discrimination",)), *SELECTION.trials)
    ),
)
DETECTION = replace(
    LAYOUT,
    columns=(),
    name="rodgers-detection",
    title=f"{TITLE}, sessions of the detection task, with 'nothing' as a stimulus",
    conditions=Conditions("trials", ("object",)),
    orders={**ORDERS, "object": (*LABELS, NOTHING)},
    selection=replace(
        SELECTION,
        name="rodgers-detection",
        trials=(Rule("task", allow=("detection",)), *(rule for rule in SELECTION.trials if rule.column != "stimulus")),
    ),
    window=Window(anchor="choice", offset=-1.0, length=1.0),
    remarks=(
        "window: up to the choice for every trial, because trials without a shape have no first contact",
        *REMARKS[1:],
    ),
)
