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


def test_misuse_is_told_in_a_sentence(run):
    result = run("tradeoff", "whisker", "--links", "few")
    assert result.status == 2
    assert "--links takes whole numbers joined by commas; received 'few'." in result.err
