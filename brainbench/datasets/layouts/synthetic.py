"""Layout of the files of ``brainbench.datasets.synthetic``: one stimulus, one contact and one choice in every trial."""

from __future__ import annotations

from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.trials.conditions import Conditions
from brainbench.datasets.trials.selection import DEFAULT
from brainbench.datasets.trials.windows import FIRST_CONTACT, Window

LAYOUT = RecordingLayout(
    name="synthetic",
    title="animals drawn by brainbench.datasets.synthetic; no animal was recorded",
    citation="brainbench, this version",
    conditions=Conditions("trials", ("stimulus",)),
    orders={},
    selection=DEFAULT,
    window=Window(FIRST_CONTACT, stop="choice"),
    columns=("stimulus", "choice_time"),
    synthetic=True,
    remarks=("truth: truth.json beside the files says what the neurons encode",),
)
