"""Checks of a machine agree with their closed forms, and notice readings that do not."""

from __future__ import annotations

import numpy as np
import pytest

from robotics_bridge.sensors import checks


@pytest.mark.parametrize(
    "name", ["distance to a ball (m)", "hysteresis, published sequence (m)", "probes of table 4.11"]
)
def test_a_check_finds_its_truth_on_the_processor(name: str) -> None:
    found, truth, tolerance = checks.CHECKS[name]("cpu")
    assert found == pytest.approx(truth, rel=tolerance)


def test_a_sequence_that_is_off_by_a_thousandth_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    check = checks.CHECKS["hysteresis, published sequence (m)"]
    for factor, agrees in ((1.0, True), (1.001, False)):
        last = np.full((1, 1, 1, 1), 0.036740 * factor)
        monkeypatch.setattr(checks, "simulate", lambda *_, last=last, **__: last)
        found, truth, tolerance = check("cpu")
        assert (found == pytest.approx(truth, rel=tolerance)) is agrees


def test_a_layout_with_other_counts_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks.layouts, "active_count", lambda layout: 1)
    found, truth, tolerance = checks.CHECKS["probes of table 4.11"]("cpu")
    assert (found, tolerance) == (6, 0)
    assert truth == 2041
