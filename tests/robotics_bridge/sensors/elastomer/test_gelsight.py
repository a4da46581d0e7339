"""The elastomer fitted to two real marker fields (FOTS' GelSight): what it reaches and what anything could."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.tactile.gelsight_fit import (
    MODELS,
    STARTS,
    by_sensor,
    fit,
    floor,
    folds,
    load,
    load_tracked,
    relative,
    smooth_bound,
    track,
)

pytestmark = [pytest.mark.shared, pytest.mark.slow]
PUBLISHED = {"dilate": 0.329, "shear": 0.174}


def test_fields_tracked_in_the_pictures_are_met_with_eight_numbers(reference: Path) -> None:
    x, *fields = load_tracked(reference / "gelsight" / "marker_calib" / "data")
    assert len(x) == 90
    for (name, bound), real in zip(PUBLISHED.items(), fields, strict=True):
        p = fit(MODELS[name], x, real, STARTS[name])
        assert len(p) <= 8
        assert relative(MODELS[name](p, x), real) <= bound
        assert folds(MODELS[name], x, real, p) < 1.5 * bound
        if name == "dilate":
            assert by_sensor(x, p) < 0.01


def test_whole_pixels_leave_a_dilation_that_no_smooth_field_foresees(reference: Path) -> None:
    x, dilate, sheared = load(reference / "gelsight" / "marker_calib" / "data")
    assert smooth_bound(x, dilate) > 0.5
    assert 0.25 < floor(dilate) < 0.27
    assert 0.11 < floor(sheared) < 0.12
    assert relative(MODELS["dilate"](fit(MODELS["dilate"], x, dilate, STARTS["dilate"]), x), dilate) < 0.48
    assert relative(MODELS["shear"](fit(MODELS["shear"], x, sheared, STARTS["shear"]), x), sheared) <= 0.174


def test_spots_are_found_to_a_twentieth_of_a_pixel() -> None:
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid(np.arange(20, 140, 28.0), np.arange(20, 100, 28.0)), -1).reshape(-1, 2)
    places += rng.uniform(-3, 3, places.shape)
    y, x = np.mgrid[:120, :160]
    picture = np.full((120, 160), 0.8) + 0.001 * x
    for place in places:
        picture -= 0.5 / (1 + np.exp(2 * (np.hypot(x - place[0], y - place[1]) - 5)))
    found = track(np.repeat(picture[..., None], 3, axis=2), np.round(places + rng.uniform(-1.5, 1.5, places.shape)))
    assert np.abs(found - places).max() < 0.05
