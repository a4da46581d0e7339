"""What the documentation shows, works."""

import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


def _blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_recordings_page_writes_a_file_that_can_be_scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from brainbench.datasets import open_recordings

    monkeypatch.chdir(tmp_path)
    for block in _blocks("docs/recordings.md", "python"):
        exec(compile(block, "docs/recordings.md", "exec"), {})
    dataset = open_recordings("mouse-1.h5", conditions="trials:stimulus")
    assert dataset.attrs["vocabulary"] == ["a", "b", "c", "d", "e"]
    assert dataset.sizes["unit"] == 20


def test_the_scene_file_of_the_stimuli_page_is_valid(tmp_path: Path):
    from brainbench.stimuli import load_scene

    (block,) = _blocks("docs/stimuli.md", "toml")
    path = tmp_path / "pole.toml"
    path.write_text(block)
    recipe = load_scene(path)
    assert [scene.label for scene in recipe.scenes] == ["near", "far"]


def test_the_data_set_of_the_datasets_page_can_be_made_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from brainbench.datasets import WhiskingDataset

    monkeypatch.chdir(tmp_path)
    made: dict[str, Any] = {}
    exec(compile(_blocks("docs/datasets.md", "python")[0], "docs/datasets.md", "exec"), made)
    assert made["manifest"]["sweeps"] == WhiskingDataset("mine", split="all").sweeps == 6


@pytest.mark.parametrize(
    "page", ["README.md", "CONTRIBUTING.md", "docs/recordings.md", "docs/stimuli.md", "docs/datasets.md"]
)
def test_links_between_pages_lead_somewhere(page: str):
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert ((ROOT / page).parent / target).exists(), f"{page} links to {target}, which does not exist"


def test_the_readme_names_only_commands_that_exist(run_help):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(r"(?:`|&& |^)brainbench ([a-z]+)(?: ([a-z]+))?", text, flags=re.MULTILINE))
    assert ("score", "zhuang") in named
    for command, sub in named:
        assert command in run_help(), f"README names brainbench {command}"
        if sub and command in ("models", "recordings", "stimuli", "leaderboard"):
            assert sub in run_help(command), f"README names brainbench {command} {sub}"


@pytest.fixture
def run_help():
    from typer.testing import CliRunner

    from brainbench.cli import app

    return lambda *words: CliRunner().invoke(app, [*words, "--help"]).output


def test_the_metric_of_the_statistics_page_scores(tmp_path: Path):
    import numpy as np

    from brainbench.metrics import TrialBlock, find_metric

    (block,) = _blocks("docs/statistics.md", "python")
    path = tmp_path / "mine.py"
    path.write_text(block, encoding="utf-8")
    metric = find_metric(f"{path}:NearestNeighbour")
    rng = np.random.default_rng(0)
    latent, labels = rng.normal(size=(6, 3)), np.repeat(np.arange(6), 6)
    trials = [
        TrialBlock((latent @ rng.normal(size=(3, 20)))[labels] + rng.normal(size=(36, 20)), labels) for _ in "abc"
    ]
    animals = [metric.animal(str(i), [block], 6) for i, block in enumerate(trials)]
    score = metric.score({"same": latent}, animals, name="x", stimuli=list("abcdef"))
    assert score.value > 0.5
