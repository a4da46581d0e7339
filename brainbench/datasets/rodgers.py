"""Recipe for Rodgers 2022 (DANDI 000231): mice telling convex from concave shapes with their whiskers.

The parts stand here as constants; ``get_recipe("rodgers").describe()`` prints every rule.
"""

from __future__ import annotations

from brainbench.datasets.conditions import Conditions
from brainbench.datasets.selection import Rule, Selection
from brainbench.datasets.window import FIRST_CONTACT, Window

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

WINDOW = Window(
    anchor=FIRST_CONTACT,
    stop="choice",
    fallback=Window(anchor="choice", offset=-1.0, length=1.0),
)
"""First contact to choice, as in the published analysis; the last second before the choice where a
session has no contact tables."""

LAYOUT = ("stimulus", "servo_position", "outcome", "choice_time")

REMARKS = (
    "trials: a contact must last longer than zero to be the first; no contact before the choice removes the trial",
    "trials: the window must lie inside the recorded span (obs_intervals, else the session's first to last spike)",
    "clock: times are used as stored; the voltage series' starting_time is never subtracted",
)
