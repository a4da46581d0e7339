"""Raw input and contacts as controls of a score."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xarray as xr

from brainbench.core.contracts import Trials
from brainbench.metrics import get_metric
from brainbench.scoring.scores import score_record
from brainbench.scoring.unique import contact_kinematics, unique_of


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


def test_a_doubted_score_has_a_doubted_unique_part():
    rng = np.random.default_rng(0)
    hidden, metric = rng.normal(size=(12, 5)), get_metric("rsa")
    animals = []
    for animal in range(3):
        labels = np.repeat(np.arange(12), 8)
        responses = (hidden @ rng.normal(size=(5, 40)))[labels] + rng.normal(size=(96, 40))
        animals.append(
            metric.animal(f"m{animal}", [Trials(responses, labels, [f"{animal}/{i}" for i in range(96)])], 12)
        )
    names = [f"s{place}" for place in range(12)]
    score = metric.score({"layer": hidden}, animals, name="net", stimuli=names)
    sides = {"layer": hidden}, {"raw input": rng.normal(size=(12, 5))}
    assert score.status == "ok"
    part = unique_of(score, metric, animals, *sides)
    assert part.status == "ok"
    assert part.unique > 0.8
    doubted = unique_of(replace(score, status="unreliable"), metric, animals, *sides)
    assert (doubted.status, doubted.unique) == ("unreliable", part.unique)
    assert unique_of(replace(score, status="undefined"), metric, animals, *sides).status == "undefined"
    assert unique_of(score, metric, animals, sides[0], {}) is None
