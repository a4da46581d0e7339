"""Pictures of gels: what a table from one press shows of another, synthetic and real."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from robotics_bridge.sensors.taxels.camera import GelCamera

LAMPS = np.array([[0.25, 0.02, -0.2], [0.03, 0.2, -0.1]])
"""Change of red, green and blue by slope along y and x: a gel under soft coloured lamps."""
PIXEL, BALL = 5e-5, 3e-3


def _picture(surface: np.ndarray) -> np.ndarray:
    """Return what a camera sees of a surface (m), brighter on the left."""
    slopes = np.stack(np.gradient(surface, PIXEL), axis=-1)
    rest = np.linspace(0.6, 0.4, surface.shape[1])[None, :, None] * np.ones(3)
    return np.round(255 * (rest + slopes @ LAMPS).clip(0, 1)).astype(np.uint8)


def _pressed(center: tuple[float, float], contact: float, shape=(120, 160), pixel: float = PIXEL) -> np.ndarray:
    """Return Sneddon's surface (m) under a ball of 3 mm; the contact in pixels."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    r, a = np.hypot(x - center[0], y - center[1]).clip(1e-6) * pixel, contact * pixel
    angles = np.linspace(0, 1, 201)[:, None, None] * np.arcsin(np.minimum(a / r, 1))
    t = r * np.sin(angles)
    return 2 / np.pi * np.trapezoid(a * np.arctanh(a / BALL) - t * np.arctanh(t / BALL), angles, axis=0)


@pytest.fixture(scope="module")
def camera() -> GelCamera:
    place = {"center": (80, 60), "contact": 40, "ball": BALL, "pixel": PIXEL}
    return GelCamera.calibrate(_picture(_pressed((80, 60), 40)), background=_picture(np.zeros((120, 160))), **place)


def _off(left: np.ndarray, right: np.ndarray) -> float:
    """Return the root mean square difference of two pictures, as a part of full scale."""
    return float(np.sqrt(np.mean((left.astype(float) - right) ** 2)) / 255)


def test_another_shape_is_shown_as_the_lamps_show_it(camera) -> None:
    y, x = np.mgrid[:120, :160] * PIXEL
    ridge = 3e-4 * np.exp(-(((x - 3e-3) * 0.8 + (y - 3e-3) * 0.6) ** 2) / (2 * (8e-4) ** 2))
    flat = np.zeros_like(ridge)
    shown = camera.render(np.stack([ridge, flat]))
    scale = _off(_picture(ridge), _picture(flat))
    assert _off(shown[0], _picture(ridge)) < 0.2 * scale
    assert _off(shown[1], _picture(flat)) < 0.01
    # Turned lamps are not mistaken for these.
    assert _off(shown[0][..., ::-1], _picture(ridge)) > scale


def test_the_press_that_calibrates_is_shown_as_it_was_seen(camera) -> None:
    surface = _pressed((80, 60), 40)
    scale = _off(_picture(surface), _picture(0 * surface))
    assert _off(camera.render(surface[None])[0], _picture(surface)) < 0.1 * scale
    # Inside the contact the surface is the ball's.
    y, x = np.mgrid[:120, :160] - np.array([60, 80]).reshape(2, 1, 1)
    inside = np.hypot(x, y) < 39
    ball = np.sqrt((BALL**2 - PIXEL**2 * (x**2 + y**2)).clip(0))
    np.testing.assert_allclose((surface - ball)[inside], (surface - ball)[60, 80], atol=1e-7)


def test_markers_apart_stand_for_the_pixels_between(camera) -> None:
    surface = _pressed((79.5, 59.5), 30)
    every = camera.render(surface[None])[0]
    rows, columns = np.arange(0.5, 120, 4), np.arange(0.5, 160, 4)
    coarse = surface.reshape(30, 4, 40, 4).mean(axis=(1, 3))
    assert (len(rows), len(columns)) == coarse.shape
    assert _off(camera.render(coarse[None], (4 * PIXEL, 4 * PIXEL))[0], every) < 0.02
    assert not camera.render(np.full((1, 30, 40), np.nan), (2e-4, 2e-4)).any()


def test_a_camera_is_kept_and_what_does_not_fit_is_refused(camera, tmp_path: Path) -> None:
    again = GelCamera.load(camera.save(tmp_path / "gel.npz"))
    np.testing.assert_array_equal(again.table, camera.table)
    assert again.pixel == PIXEL
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(DataError, match="no gel camera"):
        GelCamera.load(tmp_path / "other.npz")
    with pytest.raises(UsageError, match="120 × 160"):
        camera.render(np.zeros((1, 5, 5)))
    picture, place = _picture(_pressed((80, 60), 40)), {"center": (80.0, 60.0), "pixel": PIXEL}
    for change, sentence in (
        ({"picture": picture / 255}, "bytes"),
        ({"contact": 70.0}, "contact"),
        ({"ball": 3.0, "contact": 200.0}, "free of the ball"),
        ({"background": picture[:10]}, "background"),
    ):
        options = {"picture": picture, "contact": 40.0, "ball": BALL, **place, **change}
        with pytest.raises(UsageError, match=sentence):
            GelCamera.calibrate(**options)


@pytest.mark.shared
def test_a_real_press_foretells_the_picture_of_a_sheared_one(reference: Path) -> None:
    from PIL import Image

    folder = reference / "gelsight" / "marker_calib" / "data"
    straight, sheared = (np.asarray(Image.open(folder / f"{number}.png").convert("RGB")) for number in (0, 1))
    scale = {"contact": 45.0, "ball": 3e-3, "pixel": 5.32e-5}
    camera = GelCamera.calibrate(straight, center=(137, 123), **scale)
    y, x = np.mgrid[:240, :320]
    moved = GelCamera.calibrate(sheared, center=(137, 133), **scale)
    surface = _pressed((137, 133), 45, (240, 320), 5.32e-5)
    shown = GelCamera(moved.background, camera.table, camera.pixel).render(surface[None])[0]
    rested = GelCamera(moved.background, 0 * camera.table, camera.pixel).render(surface[None])[0]
    clear = (np.hypot(x - 137, y - 133) < 60) & (sheared.min(axis=-1) > 110)
    assert _off(shown[clear], sheared[clear]) < 0.45 * _off(rested[clear], sheared[clear])
