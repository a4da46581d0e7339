"""The elastomer fitted to two real marker fields (FOTS' GelSight): what it reaches and what anything could."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.gelsight_fit import MODELS, STARTS, by_sensor, fit, floor, load, relative, smooth_bound

pytestmark = [pytest.mark.shared, pytest.mark.slow]


def test_fields_are_fitted_with_eight_numbers(reference: Path) -> None:
    x, dilate, sheared = load(reference / "gelsight" / "marker_calib" / "data")
    fitted = {}
    for name, real in {"dilate": dilate, "shear": sheared}.items():
        p = fit(MODELS[name], x, real, STARTS[name])
        assert len(p) <= 8
        fitted[name] = (p, MODELS[name](p, x))
    # Published .174; the floor of rounding to pixels is .118.
    assert relative(fitted["shear"][1], sheared) <= 0.174
    # Published .329, which no smooth field of eight numbers reaches: kriging foresees left-out markers to .518.
    assert relative(fitted["dilate"][1], dilate) <= 0.49
    assert smooth_bound(x, dilate) > 0.5
    assert 0.25 < floor(dilate) < 0.27
    assert 0.11 < floor(sheared) < 0.12
    assert by_sensor(x, fitted)["dilate"] < 0.01
    assert np.isfinite(fitted["dilate"][0]).all()
