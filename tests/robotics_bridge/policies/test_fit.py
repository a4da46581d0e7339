"""A stored policy is held against the environment that it is to act in."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import pytest

from brainbench.core.errors import DataError, UsageError
from robotics_bridge.policies.fit import check_fit
from robotics_bridge.tasks.contact_model import CONTACTS
from robotics_bridge.tasks.task import TASK_VERSION


def _env(contacts: str = "published") -> Any:
    hand = SimpleNamespace(name="xhand1", path=None)
    return SimpleNamespace(hand=hand, task=SimpleNamespace(contacts=CONTACTS[contacts]))


def test_another_version_of_the_tasks_or_another_hand_is_refused() -> None:
    with pytest.raises(DataError, match=r"'old'.*version 99.*brainbench 0\.0\.7"):
        check_fit({"task_version": 99, "provenance": {"version": "0.0.7"}}, _env(), "old")
    for described in ({"hand": "sharpa"}, {"distill": {"hand": "sharpa"}}):
        with pytest.raises(UsageError, match="'sharpa'; received 'xhand1'"):
            check_fit(described, _env(), "other")


def test_other_contacts_are_told(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        check_fit({"task_version": TASK_VERSION, "hand": "xhand1"}, _env(), "mine")
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        check_fit({"hand": "xhand1"}, _env("firm"), "mine")
    assert "published" in caplog.text
    assert "firm" in caplog.text
