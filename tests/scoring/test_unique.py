"""Raw input and contacts as controls of a score."""

from __future__ import annotations

import numpy as np
import xarray as xr

from brainbench.scoring.scores import score_record
from brainbench.scoring.unique import contact_kinematics


def test_contacts_are_their_beginning_duration_and_place():
    contact = np.zeros((2, 4, 2), dtype=bool)
    contact[0, 1:3, 0] = True
    arc = np.where(contact, 0.01, np.nan)
    first = np.array([[0.1, np.nan], [np.nan, np.nan]])
    over_time = ("stimulus", "time", "whisker")
    dataset = xr.Dataset(
        {"contact": (over_time, contact), "contact_arc": (over_time, arc), "first_contact": (over_time[::2], first)},
        coords={"time": [0.0, 0.1, 0.2, 0.3]},
    )
    kinematics = contact_kinematics(dataset)
    np.testing.assert_allclose(kinematics["first contact"], [[0.1, 0.3], [0.3, 0.3]])
    np.testing.assert_allclose(kinematics["contact duration"], [[0.5, 0], [0, 0]])
    np.testing.assert_allclose(kinematics["contact arc"], [[0.01, 0], [0, 0]])
    assert contact_kinematics(dataset.drop_vars("contact")) == contact_kinematics(None) == {}


def test_a_record_states_the_part_or_why_there_is_none(files):
    options = {"recordings": files["recordings"], "stimuli": files["arrays"], "conditions": "trials:texture"}
    part = score_record(files["model"], **options).score.provenance.unique
    assert part.status == "undefined"
    assert "stimuli are too few" in part.reason
    assert score_record(files["model"], baselines=False, **options).score.provenance.unique is None
    assert score_record(files["model"], metric="cka", **options).score.provenance.unique is None
