"""``brainbench tactile calibrate`` as a user runs it."""

import csv
import json

import numpy as np
import pytest

from robotics_bridge.hands.layouts import read_probes, write_probes
from robotics_bridge.sensors import Noise
from tests.factories.pressed_devices import plant


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


def test_calibrate_fits_a_device_that_a_ball_pressed(run, tmp_path):
    presses = plant(0, shape=(2, 2), touches=8).presses
    log, probes, out = (tmp_path / name for name in ("log.csv", "pad.json", "device.json"))
    header = ["time", "x", "y", "z", *(f"{n}:{axis}" for n in range(4) for axis in "xyz")]
    table = np.column_stack([presses.log.time, presses.ball, presses.log.readings])
    np.savetxt(log, table, delimiter=",", header=",".join(header), comments="")
    write_probes(probes, {"pad": presses.probes})
    result = run("tactile", "calibrate", str(log), "--probes", str(probes), "--out", str(out), "--draws", "2", "--json")
    assert result.status == 0, result.err
    data = json.loads(result.out)
    assert [row["taxel"] for row in data["taxels"]] == ["0", "1", "2", "3"]
    assert data["estimates"]["friction"]["low"] < data["law"]["friction"] < data["estimates"]["friction"]["high"]
    assert Noise.load(out).white == data["noise"]["white"]
    assert len(read_probes(tmp_path / "device-001-probes.json")["pad"]) == 4
    result = run("tactile", "calibrate", str(log))
    assert result.status == 2
    assert "needs --probes" in result.err
