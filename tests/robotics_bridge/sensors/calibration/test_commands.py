"""``brainbench tactile calibrate`` as a user runs it."""

import csv
import json

import numpy as np
import pytest

from robotics_bridge.sensors import Noise


def test_calibrate_prints_intervals_and_writes_a_preset(run, tmp_path):
    rng = np.random.default_rng(0)
    log, preset = tmp_path / "log.csv", tmp_path / "preset.json"
    with log.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", "a", "b"])
        writer.writerows([[k * 0.01, *(0.3 + 0.05 * rng.normal(size=2))] for k in range(400)])
    found = run("tactile", "calibrate", str(log), "--out", str(preset))
    assert found.status == 0, found.err
    assert "95 % interval" in found.out
    assert "Without a column 'reference'" in found.out
    noise = Noise.load(preset)
    assert noise.white == pytest.approx(0.05, rel=0.1)
    assert noise.bias == pytest.approx(0.3, abs=0.01)
    data = json.loads(run("tactile", "calibrate", str(log), "--json").out)
    assert data["estimates"]["white"]["low"] < 0.05 < data["estimates"]["white"]["high"]
    assert run("tactile", "calibrate", str(tmp_path / "none.csv")).status == 2
