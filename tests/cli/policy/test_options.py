from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from brainbench.cli import app
from brainbench.core.errors import DataError, UsageError
from tests.factories.policies import teacher_in


def _run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["policy", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_a_policy_plays_in_the_contacts_that_it_was_trained_in_unless_told_otherwise(tmp_path: Path) -> None:
    other = str(teacher_in("published", tmp_path / "other"))

    def contacts(agent: str, *more: str) -> str:
        words = ("--agent", agent, "--seconds", "0.05", *more)
        return json.loads(_run("play", "in_palm_rotate", *words, "--json"))["contacts"]

    firm = ("--change", "contacts=firm")
    assert contacts("random") == contacts("in_palm_rotate.teacher") == contacts(other, *firm) == "firm"
    assert contacts(other) == contacts("in_palm_rotate.teacher", "--change", "contacts=published") == "published"
    with pytest.raises(UsageError, match="counted from"):
        contacts("in_palm_rotate.teacher", "--config", "published")
    with pytest.raises(UsageError, match="different contacts"):
        _run("evaluate", "in_palm_rotate", other, "in_palm_rotate.teacher")


def test_wrong_requests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'random'"):
        _run("play", "in_palm_rotate", "--agent", "randm", "--seconds", "0.1")
    with pytest.raises(UsageError, match="--seconds must be"):
        _run("play", "in_palm_rotate", "--seconds", "0")
    with pytest.raises(DataError, match=r"none\.py"):
        _run("play", "in_palm_rotate", "--task-file", str(tmp_path / "none.py"))
    broken = tmp_path / "broken.py"
    broken.write_text("1 / 0")
    with pytest.raises(DataError, match="ZeroDivisionError"):
        _run("play", "in_palm_rotate", "--task-file", str(broken))
