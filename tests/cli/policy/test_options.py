from __future__ import annotations

import json
from pathlib import Path

import pytest

from brainbench.core.errors import DataError, UsageError
from tests.factories.policies import teacher_in
from tests.factories.policy_commands import run_policy


@pytest.mark.slow
def test_a_policy_plays_in_the_contacts_that_it_was_trained_in_unless_told_otherwise(tmp_path: Path) -> None:
    other = str(teacher_in("published", tmp_path / "other"))

    def contacts(agent: str, *more: str) -> str:
        words = ("--agent", agent, "--seconds", "0.05", *more)
        return json.loads(run_policy("play", "in_palm_rotate", *words, "--json"))["contacts"]

    firm = ("--change", "contacts=firm")
    assert contacts("random") == contacts("in_palm_rotate.teacher") == contacts(other, *firm) == "firm"
    assert contacts(other) == contacts("in_palm_rotate.teacher", "--change", "contacts=published") == "published"
    with pytest.raises(UsageError, match="counted from"):
        contacts("in_palm_rotate.teacher", "--config", "published")
    with pytest.raises(UsageError, match="different contacts"):
        run_policy("evaluate", "in_palm_rotate", other, "in_palm_rotate.teacher")


def test_wrong_requests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'random'"):
        run_policy("play", "in_palm_rotate", "--agent", "randm", "--seconds", "0.1")
    with pytest.raises(UsageError, match="--seconds must be"):
        run_policy("play", "in_palm_rotate", "--seconds", "0")
    with pytest.raises(DataError, match=r"none\.py"):
        run_policy("play", "in_palm_rotate", "--task-file", str(tmp_path / "none.py"))
    broken = tmp_path / "broken.py"
    broken.write_text("1 / 0")
    with pytest.raises(DataError, match="ZeroDivisionError"):
        run_policy("play", "in_palm_rotate", "--task-file", str(broken))
