from pathlib import Path

import numpy as np
import pytest

from brainbench.stimuli import load_stimuli, sources
from brainbench.stimuli.kept_sets import index_path, read_index, write_index


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))


def test_a_simulated_recipe_is_found_again_without_its_scenes(monkeypatch: pytest.MonkeyPatch):
    asked = {"whiskers": "C1", "fidelity": "fast"}
    first = load_stimuli("rodgers", **asked)
    monkeypatch.setattr(sources, "_recipe", lambda *given: pytest.fail("the scenes were built again"))
    again = load_stimuli("rodgers", **asked)
    assert (again.content_hash, again.config_hash, again.description) == (
        first.content_hash, first.config_hash, first.description,
    )  # fmt: skip
    np.testing.assert_array_equal(again.input, first.input)


def test_an_index_without_its_entry_or_damaged_leads_nowhere(tmp_path: Path):
    index, entry = index_path("rodgers", "C1"), tmp_path / "stimuli" / "a.h5"
    assert read_index(index) is None
    write_index(index, entry, "words")
    assert read_index(index) is None
    entry.touch()
    assert read_index(index) == (entry, "words")
    index.write_text("{")
    assert read_index(index) is None
