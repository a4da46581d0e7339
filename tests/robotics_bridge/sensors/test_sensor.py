"""Presets and the automatic choice follow the measured table."""

from __future__ import annotations

import pytest

from brainbench.core.errors import UsageError
from brainbench.core.files import read_json
from robotics_bridge.sensors import ContactProbe, ElastomerTaxel, Probes, ProximityTaxel
from robotics_bridge.sensors.sensor import PRESETS, TABLE, SensorFidelity

PROBES = Probes([[0, 0, 0]], [[0, 0, 1.0]], 0.01)


def test_the_automatic_choice_keeps_its_promise_and_is_no_dearer_than_needed() -> None:
    rows = read_json(TABLE)["points"]
    for error in (0.2, 0.05, 0.02):
        chosen = SensorFidelity.auto(error=error)
        meshes = [r for r in rows if r["part"] == "mesh" and r["query"] == chosen.query]
        mesh = next(r for r in meshes if r["resolution"] in (chosen.resolution, None))
        points = next(r for r in rows if r["part"] == "points" and r["points"] == chosen.points)
        assert max(mesh["error"], points["error"]) <= error
        cheaper = [r for r in rows if r["part"] == "points" and r["cost"] < points["cost"]]
        assert all(r["error"] > error for r in cheaper)
    with pytest.raises(UsageError, match=r"1e-12; .*cost"):
        SensorFidelity.auto(error=1e-12)


def test_the_table_says_that_more_effort_errs_less() -> None:
    rows = read_json(TABLE)["points"]
    sampled = [r for r in rows if r["part"] == "mesh" and r["query"] == "sdf"]
    fields = [r["error"] for r in sorted(sampled, key=lambda r: r["resolution"])]
    assert fields == sorted(fields, reverse=True)
    assert next(r["error"] for r in rows if r["part"] == "mesh" and r["query"] == "raycast") < 1e-3
    assert next(r["error"] for r in rows if r["part"] == "primitive") < 1e-4


def test_fidelity_replaces_what_a_sensor_has_and_nothing_else() -> None:
    sensors = {
        "bit": ContactProbe(link="a", probes=PROBES, threshold=1e-3),
        "near": ProximityTaxel(link="a", probes=PROBES, points=7),
        "gel": ElastomerTaxel(link="a", probes=PROBES, points=0),
    }
    changed = SensorFidelity("raycast", 32, 99).apply(sensors)
    assert changed["bit"] == ContactProbe(link="a", probes=PROBES, threshold=1e-3, query="raycast")
    assert changed["near"].points == 99  # type: ignore[attr-defined]
    assert changed["gel"].points == 0  # type: ignore[attr-defined]


def test_presets_are_named_and_others_refused() -> None:
    assert {SensorFidelity.preset(name).points for name in PRESETS} == {500, 2000, 16_000}
    with pytest.raises(UsageError, match="'balanced'"):
        SensorFidelity.preset("balance")
    with pytest.raises(UsageError, match=r"resolution .*at most 512"):
        SensorFidelity(resolution=2)
