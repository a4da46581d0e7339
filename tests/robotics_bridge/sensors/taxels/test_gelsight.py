"""The elastomer fitted to two real marker fields (FOTS' GelSight): what it reaches and what anything could."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.factories.benchmark_programs import benchmark_program

pytestmark = [pytest.mark.shared, pytest.mark.slow]
PUBLISHED = {"dilate": 0.329, "shear": 0.174}


@pytest.fixture(scope="module")
def gel() -> ModuleType:
    """The benchmark that fits the elastomer."""
    return benchmark_program("tactile.gelsight_fit")


def test_fields_tracked_in_the_pictures_are_met_with_eight_numbers(reference: Path, gel: ModuleType) -> None:
    x, *fields = gel.load_tracked(reference / "gelsight" / "marker_calib" / "data")
    assert len(x) == 90
    for (name, bound), real in zip(PUBLISHED.items(), fields, strict=True):
        p = gel.fit(gel.MODELS[name], x, real, gel.STARTS[name])
        assert len(p) <= 8
        assert gel.relative(gel.MODELS[name](p, x), real) <= bound
        assert gel.folds(gel.MODELS[name], x, real, p) < 1.5 * bound
        if name == "dilate":
            assert gel.by_sensor(x, p) < 0.01


def test_whole_pixels_leave_a_dilation_that_no_smooth_field_foresees(reference: Path, gel: ModuleType) -> None:
    x, dilate, sheared = gel.load(reference / "gelsight" / "marker_calib" / "data")
    assert gel.smooth_bound(x, dilate) > 0.5
    assert 0.25 < gel.floor(dilate) < 0.27
    assert 0.11 < gel.floor(sheared) < 0.12
    for (name, bound), real in zip({"dilate": 0.48, "shear": 0.174}.items(), (dilate, sheared), strict=True):
        model = gel.MODELS[name]
        assert gel.relative(model(gel.fit(model, x, real, gel.STARTS[name]), x), real) <= bound


def test_spots_are_found_to_a_twentieth_of_a_pixel(gel: ModuleType) -> None:
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid(np.arange(20, 140, 28.0), np.arange(20, 100, 28.0)), -1).reshape(-1, 2)
    places += rng.uniform(-3, 3, places.shape)
    y, x = np.mgrid[:120, :160]
    picture = np.full((120, 160), 0.8) + 0.001 * x
    for place in places:
        picture -= 0.5 / (1 + np.exp(2 * (np.hypot(x - place[0], y - place[1]) - 5)))
    found = gel.track(np.repeat(picture[..., None], 3, axis=2), np.round(places + rng.uniform(-1.5, 1.5, places.shape)))
    assert np.abs(found - places).max() < 0.05
