from __future__ import annotations

import json
from pathlib import Path

import pytest

PARTS = ("--conditions", "trials:texture")


@pytest.fixture
def scored(run, files) -> tuple[Path, str]:
    """A record of a user's module on two animals, and where the recordings are."""
    where = files["recordings"]
    result = run(
        "score",
        files["model"],
        "--stimuli",
        files["arrays"],
        "--recordings",
        where,
        *PARTS,
        "--out",
        files["out"],
        "--json",
    )
    assert result.status == 0, result.err
    return Path(json.loads(result.out)["record_path"]), where
