"""Layouts of data sets that store spikes, touches or labels in their own way.

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
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.sessions import OBSERVED, SPIKES, Series, Session, SessionTable, ragged
from brainbench.datasets.trials.selection import Conditions, Rule, Selection
from brainbench.datasets.trials.windows import Window

TRAIN = "acquisition/SpikeTrain"
ONSET, OFFSET = "touch_onset", "touch_offset"
_WHISKER = re.compile(rf"^(?P<prefix>acquisition/(?:principal_)?whisker_(?P<name>\w+)/){ONSET}$")
WHISKER = "C2"
"""The files do not name the whisker; the paper recorded around the C2 column with one whisker left."""

SELECTION = (Rule("type", refuse=("N/A",)), Rule("stim_present", refuse=("true",), required=False))
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
    selection=Selection(name="hires", trials=SELECTION),
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
    selection=Selection(name="yu", trials=SELECTION),
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
