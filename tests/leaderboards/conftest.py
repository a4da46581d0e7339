"""Factories of records as fixtures."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from brainbench.core.records import ResultRecord, Score
from tests.factories import records


@pytest.fixture(name="make_score")
def _make_score() -> Callable[..., Score]:
    return records.make_score


@pytest.fixture(name="make_record")
def _make_record() -> Callable[..., ResultRecord]:
    return records.make_record
