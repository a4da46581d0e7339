"""Layout of Yu 2016 (DANDI 000005): thalamus and layer 4 while a mouse finds a pole with its whiskers.

Extracellular files have a units table. Touches are 0/1 signals, one container per whisker under
``acquisition``: ``principal_whisker_c2``, ``whisker_c1``. They become contact tables here.
"""

from __future__ import annotations

import re

from brainbench.datasets.layouts.hires import ONSET, SELECTION, with_contacts
from brainbench.datasets.layouts.layout import RecordingLayout
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.conditions import Conditions
from brainbench.datasets.trials.selection import Selection
from brainbench.datasets.trials.windows import Window

_WHISKER = re.compile(rf"^(?P<prefix>acquisition/(?:principal_)?whisker_(?P<name>\w+)/){ONSET}$")


def adapt(session: Session) -> Session:
    """Add ``contacts_by_whisker_*`` for every whisker whose touches are stored."""
    for path in session.series:
        if match := _WHISKER.match(path):
            session = with_contacts(session, match["prefix"], match["name"].capitalize())
    return session


LAYOUT = RecordingLayout(
    name="yu",
    title="pole localisation with a few whiskers, units of thalamus (VPM) and layer 4 (DANDI 000005)",
    citation="Yu J., Gutnisky D. A. et al., Nature Neuroscience 19:1647 (2016), doi:10.1038/nn.4412",
    conditions=Conditions("trials", ("type",)),
    orders={"type": ("Go", "Nogo")},
    selection=Selection(name="yu", trials=SELECTION),
    window=Window("pole_in_time", stop="pole_out_time"),
    columns=(
        "type",
        "response",
        "stim_present",
        "pole_position",
        "pole_in_time",
        "pole_out_time",
        "first_touch_time",
        "photo_stim_mode",
    ),
    adapt=adapt,
    touch="first_touch_time",
    dandiset="000005",
    remarks=(
        "contacts: from the 0/1 signals touch_onset and touch_offset of every whisker; files of whole-cell recordings "
        "have no units and are refused",
        "conditions: Go and Nogo are the two ranges of pole positions; trials:pole_position labels single positions",
    ),
)
