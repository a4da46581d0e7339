import json

import pytest


@pytest.mark.slow
def test_bench_times_every_sensor_class(run):
    found = json.loads(run("tactile", "bench", "--envs", "4", "--repeats", "2", "--resolution", "low", "--json").out)
    assert {item["sensor"] for item in found["results"]} >= {"KinematicTaxel", "ElastomerTaxel", "TemperatureGrid"}
    assert all(item["seconds"] > 0 and item["state_bytes"] > 0 for item in found["results"])


@pytest.mark.slow
def test_demo_writes_four_pictures_of_a_hand_that_feels_something(run, tmp_path):
    found = run("tactile", "demo", "--out", str(tmp_path), "--resolution", "low", "--json")
    assert found.status == 0, found.err
    made = json.loads(found.out)
    assert made["forces"]["in contact"] > 3
    assert made["temperature"]["aluminium (°C)"] > made["temperature"]["wood (°C)"] > 22
    for name in ("forces", "markers", "temperature", "sound"):
        assert (tmp_path / f"tactile-{name}.png").stat().st_size > 10_000
