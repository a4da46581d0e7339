"""What docs/leaderboards.md shows, works."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "leaderboards.md"


def test_the_records_of_the_page_become_a_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    made: dict[str, object] = {}
    exec(compile(block, PAGE.name, "exec"), made)
    assert (tmp_path / "site" / "index.html").is_file()
    assert [item.problem for item in made["stored"]] == [None, None]  # type: ignore[union-attr]
    assert len(list((tmp_path / "site" / "models").iterdir())) == 2


def test_the_batch_file_of_the_page_names_scores(tmp_path: Path):
    from brainbench.scoring.jobs import read_batch

    (block,) = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    (tmp_path / "batch.toml").write_text(block, encoding="utf-8")
    jobs = read_batch(tmp_path / "batch.toml")
    assert {"zhuang-small", "resnet18-small+gpt"} <= {job.model for job in jobs}
