import json
from pathlib import Path

import pytest

from brainbench.core.files import read_json


@pytest.mark.slow
def test_the_cost_of_tactile_queries_is_measured_against_their_error(
    run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from brainbench.tradeoffs import sensors

    # From 16 cells on; fewer cannot resolve the torus, and its triangles are asked instead.
    for name, values in {"RESOLUTIONS": (16, 32), "POINTS": (50, 500), "TAXELS": (4, 20)}.items():
        monkeypatch.setattr(sensors, name, values)
    out = tmp_path / "table.json"
    found = run("tradeoff", "tactile", "--out", str(out), "--json")
    assert found.status == 0, found.err
    points = json.loads(found.out)["points"]
    assert points == read_json(out)["points"]
    errors = {
        part: [p["error"] for p in points if p["part"] == part] for part in ("mesh", "points", "taxels", "primitive")
    }
    assert errors["mesh"][0] > errors["mesh"][1] > errors["mesh"][2]
    assert errors["points"][0] > errors["points"][1]
    assert errors["taxels"][0] > errors["taxels"][1]
    assert errors["primitive"][0] < 1e-5


@pytest.mark.slow
def test_the_error_of_a_score_is_measured_against_its_time(run):
    result = run("tradeoff", "score", "--animals", "2", "--units", "10", "--trials", "12", "--repeats", "2", "--json")
    assert result.status == 0, result.err
    points = json.loads(result.out)["points"]
    assert {point["quantity"] for point in points} == {"splits", "permutations"}


def test_misuse_is_told_in_a_sentence(run):
    result = run("tradeoff", "score", "--repeats", "1")
    assert result.status == 2
    assert "--repeats must be a whole number, at least 2; received 1." in result.err
