"""Layouts of published data sets. Rodgers 2022 (DANDI 000231): mice recognise shapes with their whiskers.

Two tasks share one layout. *Discrimination*: convex or concave, one side each. *Detection*: a shape of
either kind on one side, ``nothing`` on the other. ``rodgers`` reads both as the published analysis
pooled them, ``rodgers-discrimination`` and ``rodgers-detection`` read one; the last keeps ``nothing``
as a seventh stimulus. ``get_layout("rodgers").describe()`` prints every rule.

Hires 2015 (DANDI 000013) and Yu 2016 (DANDI 000005): a mouse finds a pole with its whiskers. Hires has one cell per
file and no units table: spikes are a 0/1 signal ``acquisition/SpikeTrain`` with time stamps, touches likewise under
``acquisition/behavior``. Yu has a units table; touches are 0/1 signals, one container per whisker under ``acquisition``
(``principal_whisker_c2``, ``whisker_c1``). They become units and contact tables here.

Area2_Bump (DANDI 000127): macaque area 2 during reaches and bumps of the arm in one of their directions. ``trials``
names both by ``cond_dir`` (degrees) and tells them apart by ``ctr_hold_bump``, joined to one label, ``passive-90``.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import as_labels
from brainbench.core.errors import listing
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.sessions import OBSERVED, SPIKES, Series, Session, SessionTable, ragged
from brainbench.datasets.trials.selection import (
    CONTACTS,
    FIRST_CONTACT,
    Conditions,
    Rule,
    Selection,
    Window,
    joined_labels,
)

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


TRAIN = "acquisition/SpikeTrain"
ONSET, OFFSET = "touch_onset", "touch_offset"
_WHISKER = re.compile(rf"^(?P<prefix>acquisition/(?:principal_)?whisker_(?P<name>\w+)/){ONSET}$")
WHISKER = "C2"  # the files do not name the whisker; the paper recorded around the C2 column with one whisker left

POLE_RULES = (Rule("type", refuse=("N/A",)), Rule("stim_present", refuse=("true",), required=False))
"""Photostimulated trials are not the neuron's own answer to touch."""


def adapt_hires(session: Session) -> Session:
    """Turn the spike train into a unit and the touches into ``contacts_by_whisker_C2``."""
    sorted_session = session
    if session.units is None and TRAIN in session.series:
        sorted_session = replace(sorted_session, units=_unit(session.series[TRAIN], session.source), intracellular={})
        note = f"{session.source}: the unit was made from the 0/1 signal {TRAIN}"
        sorted_session = replace(sorted_session, notes=(*sorted_session.notes, note))
    return with_contacts(sorted_session, "acquisition/behavior/", WHISKER)


def adapt_yu(session: Session) -> Session:
    """Add ``contacts_by_whisker_*`` for every whisker whose touches are stored."""
    for path in session.series:
        if match := _WHISKER.match(path):
            session = with_contacts(session, match["prefix"], match["name"].capitalize())
    return session


def with_contacts(session: Session, prefix: str, whisker: str) -> Session:
    """Add the contact table of a whisker from its 0/1 signals of touch onsets and offsets."""
    name = f"contacts_by_whisker_{whisker}"
    onset, offset = (session.series.get(f"{prefix}{part}") for part in (ONSET, OFFSET))
    if name in session.tables or onset is None or offset is None:
        return session
    begin, end = onset.active_times(), offset.active_times()
    if not len(begin):
        return session
    # A touch ends at the next offset; one that is cut off by the end of the recording ends at once.
    after = np.searchsorted(end, begin, side="left")
    stop = np.append(end, np.nan)[after]
    data = {"start_time": begin, "stop_time": np.where(np.isnan(stop), begin, stop)}
    return session.with_table(SessionTable(name, data, session.source))


def _unit(train: Series, source: str) -> SessionTable:
    times = train.active_times()
    columns: dict[str, NDArray[np.generic]] = {"id": np.arange(1), **ragged(SPIKES, [times])}
    if train.timestamps is not None and len(train.timestamps):
        stamps = np.asarray(train.timestamps[...], dtype=np.float64)
        columns |= ragged(OBSERVED, [recorded_runs(np.sort(stamps))])
    return SessionTable("units", columns, source)


def recorded_runs(stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spans [n, 2] (s) of unbroken sampling, the last sample's own step included.

    Pauses longer than ten sampling steps are no recording.
    """
    steps = np.diff(stamps)
    # Nearly all steps lie inside a run, so the median is the sampling step even where pauses are long.
    step = float(np.median(steps)) if len(steps) else 0.0
    breaks = np.flatnonzero(steps > 10 * step)
    return np.stack([stamps[np.append(0, breaks + 1)], stamps[np.append(breaks, len(stamps) - 1)] + step], axis=1)


_POLE = ("type", "response", "stim_present", "pole_position", "pole_in_time", "pole_out_time")
_TYPES = "conditions: Go and Nogo are the two ranges of pole positions; trials:pole_position labels single positions"

HIRES = RecordingLayout(
    name="hires",
    title="pole localisation with one whisker, single neurons of layer 4 (DANDI 000013)",
    citation="Hires S. A., Gutnisky D. A. et al., eLife 4:e06619 (2015), doi:10.7554/eLife.06619",
    conditions=Conditions("trials", ("type",)),
    orders={},
    selection=Selection(name="hires", trials=POLE_RULES),
    window=Window("pole_in_time", stop="pole_out_time"),
    columns=_POLE,
    adapt=adapt_hires,
    dandiset="000013",
    remarks=(
        "units: one per file, from the 0/1 signal acquisition/SpikeTrain",
        "contacts: from the 0/1 signals touch_onset and touch_offset of acquisition/behavior",
        _TYPES,
    ),
)
YU = replace(
    HIRES,
    name="yu",
    title="pole localisation with a few whiskers, units of thalamus (VPM) and layer 4 (DANDI 000005)",
    citation="Yu J., Gutnisky D. A. et al., Nature Neuroscience 19:1647 (2016), doi:10.1038/nn.4412",
    orders={"type": ("Go", "Nogo")},
    selection=Selection(name="yu", trials=POLE_RULES),
    columns=(*_POLE, "first_touch_time", "photo_stim_mode"),
    adapt=adapt_yu,
    touch="first_touch_time",
    dandiset="000005",
    remarks=(
        "contacts: from the 0/1 signals touch_onset and touch_offset of every whisker; files of whole-cell recordings "
        "have no units and are refused",
        _TYPES,
    ),
)


DIRECTIONS = tuple(str(angle) for angle in range(0, 360, 45))
PASSIVE = "passive"


def adapt_bumps(session: Session) -> Session:
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


AREA2_BUMP = RecordingLayout(
    name="area2-bump",
    title="reaches and bumps of the arm, units of macaque area 2 (DANDI 000127)",
    citation="Chowdhury R. H., Glaser J. I., Miller L. E., eLife 9:e48198 (2020), doi:10.7554/eLife.48198",
    conditions=Conditions("trials", ("movement", "direction")),
    orders={"movement": ("active", PASSIVE), "direction": DIRECTIONS},
    selection=Selection(name="area2-bump", trials=(Rule("result", allow=("R",), required=False),)),
    window=Window("move_onset_time", offset=-0.1, length=0.6),
    columns=("cond_dir", "ctr_hold_bump", "bump_time", "move_onset_time", "split"),
    adapt=adapt_bumps,
    touch="bump_time",
    dandiset="000127",
    remarks=(
        "window: 100 ms before to 500 ms after move_onset_time, as in the Neural Latents Benchmark; needs that time",
        "coverage: the training file holds several segments of the session, told by obs_intervals",
        "the file of test trials has neither directions nor results and is refused",
    ),
)
