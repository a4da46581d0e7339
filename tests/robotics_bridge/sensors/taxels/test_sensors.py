"""Elastomers: dilation in all three ways, anchored shear, and the terms of a real layer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics import Geometry
from robotics_bridge.sensors import ElastomerTaxel, KinematicTaxel, Noise, Probes, SensorSuite
from robotics_bridge.sensors.taxels.sensors import Layer, Skin
from tests.factories.touch_scenes import pad_scene, poses_at, state_of

BALL = Geometry(name="ball", link="ball", kind="sphere", size=(0.006,))
GRID = Probes.grid(9, 11, size=(0.012, 0.015), center=(0.001, 0, 0.005), along=(1.0, 0.3, 0), radius=0.001)


def _suite(sensors: dict[str, ElastomerTaxel], envs: int = 1) -> SensorSuite:
    return SensorSuite(pad_scene(BALL), sensors, num_envs=envs)


def _press(suite: SensorSuite, *places: tuple[float, float, float]) -> None:
    """Move the ball's lowest point, given above the pad's surface, from place to place."""
    for x, y, z in places:
        suite.update(state_of(suite.scene, poses_at(3, {2: (x, y, z + 0.011)}, suite.num_envs)))


def _taxel(**options: Any) -> ElastomerTaxel:
    return ElastomerTaxel(link="hand", **{"probes": GRID, "points": 800, **options})


def _dilation(center: tuple[float, float], depth: float) -> np.ndarray:
    """Equation 4.19 in double precision [N, 3]."""
    x = np.array(GRID.position)
    h = np.maximum(0.006 - np.linalg.norm(x - [*center, 0.011 - depth], axis=1), 0)
    away = x[:, None] - x[None]
    w = np.exp(-8000 * (away[..., :2] ** 2).sum(-1)) * 100
    u = (w[..., None] * away * h[None, :, None]).sum(1)
    u[:, 2] = (w * h**1.2).sum(1)
    return u


def test_dilation_is_the_published_sum_in_all_three_ways() -> None:
    suite = _suite({way: _taxel(dilation=way, points=0) for way in ("direct", "separable", "fft")})
    _press(suite, (0.002, -0.001, -0.001))
    expected = _dilation((0.002, -0.001), 0.001)
    for way in suite.sensors:
        read = suite.read(way)[0].flatten(0, 1).numpy()
        np.testing.assert_allclose(read, expected, atol=2e-6 * np.abs(expected).max() + 1e-9)


def test_nothing_shears_before_anything_moves_and_shear_stays_in_the_plane() -> None:
    suite = _suite({"all": _taxel(), "press": _taxel(points=0)})
    _press(suite, (0, 0, -0.001))
    np.testing.assert_allclose(suite.read("all"), suite.read("press"), atol=1e-9)
    _press(suite, (0.001, 0.0005, -0.001))
    shear = (suite.read("all") - suite.read("press"))[0]
    assert float(shear[..., :2].abs().max()) > 1e-6
    assert float(shear[..., 2].abs().max()) < 1e-9
    mean = shear.mean((0, 1)).numpy()
    assert mean[0] > 0
    assert mean[1] == pytest.approx(0.5 * mean[0], rel=0.1)


def test_shear_is_the_published_sum_over_anchored_points() -> None:
    suite = _suite({"all": _taxel(), "press": _taxel(points=0)})
    _press(suite, (0, 0, -0.001), (0.0006, 0, -0.001))
    runtime = suite.runtimes[0]
    points = runtime.points.point.numpy()  # type: ignore[attr-defined]
    points = points[~np.isnan(points[:, 0])].astype(float)
    before, now = points + np.array([0, 0, 0.01]), points + np.array([0.0006, 0, 0.01])
    anchored = before[:, 2] < 0.005 - 1e-5
    assert 5 < anchored.sum() < 200
    h = np.maximum(0.005 - now[:, 2], 0)
    slip = np.where(anchored[:, None], now - before, 0)
    away = np.array(GRID.position)[:, None] - now[None]
    w = 100 * h * np.exp(-2000 * (away[..., :2] ** 2).sum(-1))
    expected = (w[..., None] * slip[None]).sum(1)
    expected[:, 2] = 0
    shear = (suite.read("all") - suite.read("press"))[0].flatten(0, 1).numpy()
    np.testing.assert_allclose(shear, expected, atol=1e-3 * np.abs(expected).max())


def test_lifting_off_forgets_the_anchors() -> None:
    suite = _suite({"all": _taxel(), "press": _taxel(points=0)})
    _press(suite, (0, 0, -0.001), (0.001, 0, -0.001), (0.001, 0, 0.002), (0.001, 0, -0.001))
    np.testing.assert_allclose(suite.read("all"), suite.read("press"), atol=1e-9)


def test_a_reset_forgets_the_anchors_of_its_environment_only() -> None:
    suite = _suite({"all": _taxel()}, envs=2)
    _press(suite, (0, 0, -0.001))
    suite.reset([0])
    _press(suite, (0.001, 0, -0.001))
    _press(suite, (0.001, 0, -0.001))
    read = suite.read("all")
    assert float((read[0] - read[1]).abs().max()) > 1e-6


def test_curved_pads_and_single_markers_are_summed_directly() -> None:
    angle = np.linspace(-0.5, 0.5, 7)
    place = np.stack([0.02 * np.sin(angle), 0 * angle, 0.02 * np.cos(angle) - 0.0151], axis=1)
    curved = Probes(place, np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1), 0.001)
    single = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    suite = _suite({"curved": _taxel(probes=curved), "single": _taxel(probes=single)})
    assert [sensor.way for sensor in suite.sensors.values()] == ["direct", "direct"]  # type: ignore[attr-defined]
    _press(suite, (0, 0, -0.001))
    read = suite.read("curved")[0].numpy()
    np.testing.assert_allclose(read[:, 0], -read[::-1, 0], atol=1e-9)
    bulge = (read * np.array(curved.normal)).sum(1)
    assert bulge.argmax() == 3
    assert float(suite.read("single")[0, 0, 2]) == pytest.approx(100 * 0.001**1.2, rel=1e-3)


def test_a_thin_bonded_layer_and_a_compressible_one_shear_less_far() -> None:
    layers = {
        "half-space": Layer(poisson=0.5, softening=1e-3),
        "bonded": Layer(poisson=0.5, softening=1e-3, thickness=2e-3),
        "compressible": Layer(poisson=0.0, softening=1e-3),
    }
    sensors = {name: _taxel(layer=layer, shear_scale=1.0) for name, layer in layers.items()}
    suite = _suite({**sensors, "press": _taxel(points=0)})
    _press(suite, (0, 0, -0.001), (0.0004, 0, -0.001))
    shear = {name: (suite.read(name) - suite.read("press"))[0, :, :, 0].numpy() for name in layers}
    reach = {name: field[4, 0] / field.max() for name, field in shear.items()}
    assert reach["bonded"] < 0.6 * reach["half-space"]
    # Along the drag an incompressible half-space moves (1 − ν + ν) / r, across it (1 − ν) / r.
    assert shear["half-space"][4, 0] > 1.3 * shear["half-space"][0, 5]
    np.testing.assert_allclose(shear["compressible"][4, 10], shear["compressible"][4, 0], rtol=0.35)


def test_a_clamped_frame_stops_the_widening_where_a_free_edge_moves_most() -> None:
    free, clamped = Layer(expansion=5.0), Layer(expansion=5.0, frame=(0.0075, 0.006))
    base = Probes.grid(9, 11, size=(0.012, 0.015), center=(0, 0, 0.005), radius=0.001)
    sensors = {
        name: _taxel(probes=base, points=0, layer=layer) for name, layer in (("free", free), ("clamped", clamped))
    }
    sensors["none"] = _taxel(probes=base, points=0)
    suite = _suite(sensors)
    _press(suite, (0, 0, -0.001))
    extra = {name: (suite.read(name) - suite.read("none"))[0].numpy() for name in ("free", "clamped")}
    assert extra["free"][4, :, 0].argmax() == 10
    assert abs(extra["clamped"][4, 10, 0]) < 1e-3 * extra["clamped"][4, :, 0].max()
    assert np.abs(extra["free"][4, 5]).max() < 1e-9


def test_shear_does_not_depend_on_the_order_of_threads_that_a_gpu_has() -> None:
    suites = [_suite({"a": _taxel(), "b": _taxel(enter=2e-5)}, envs=3) for _ in range(2)]
    suites[1].runtimes[0].side_by_side = True  # type: ignore[attr-defined]
    for suite in suites:
        _press(suite, (0, 0, -0.001), (0.0003, 0, -0.001))
        suite.reset([1])
        _press(suite, (0.0006, 0.0002, -0.0009), (0.0006, 0.0002, 0.001), (0.0001, 0, -0.0005), (0.0002, 0, -0.0005))
    for name in ("a", "b"):
        assert float(suites[0].read(name)[..., 0].abs().max()) > 1e-6
        np.testing.assert_array_equal(suites[0].read(name), suites[1].read(name))


def test_shear_by_rows_and_columns_is_that_of_every_marker_by_itself() -> None:
    wide = Probes.grid(3, 6, size=(0.2, 0.1), center=(0, 0, 0.005), along=(0.2, 1.0, 0), radius=0.001)
    line = Probes.grid(1, 40, size=(0.01, 0.02), center=(0, 0, 0.005))
    row = Probes(line.position, line.normal, line.radius, pitch=line.pitch)
    sensors = {
        "grid": _taxel(points=20_000),
        "narrow": _taxel(points=20_000, shear_spread=2e5),
        "wide": _taxel(points=20_000, probes=wide, shear_spread=0.0),
        "line": _taxel(points=20_000, probes=Probes.grid(1, 5, size=(0.01, 0.01), center=(0, 0, 0.005))),
        "row": _taxel(points=20_000, probes=row),
        "layer": _taxel(points=20_000, layer=Layer(thickness=2e-3)),
        "fft": _taxel(points=20_000, dilation="fft"),
    }
    assert sensors["row"].way == "direct"
    suites = [_suite({**sensors, "press": _taxel(points=0)}, envs=3) for _ in range(2)]
    for runtime in suites[1].runtimes:
        runtime.apart = False  # type: ignore[attr-defined]
    for suite in suites:
        _press(suite, (0, 0, -0.001), (0.0005, -0.0002, -0.0012))
        suite.reset([1])
        _press(suite, (0.0008, 0.0003, -0.0012))
    moved = suites[0].runtimes[0].pads.moved.numpy()  # type: ignore[attr-defined]
    # More than are kept at once, and environments that differ.
    assert (moved % 64).sum(axis=0)[0] > 4 * 32
    assert not moved[:, 1].any()
    for name in sensors:
        found, expected = (suite.read(name).flatten(1, 2).numpy() for suite in suites)
        drag = np.abs(expected[0] - expected[1]).max()
        assert drag > 1e-5
        np.testing.assert_allclose(found, expected, atol=1e-6 * drag, err_msg=name)


def test_a_layer_with_recoil_pushes_less_by_twice_its_share_however_it_is_summed() -> None:
    fine = Probes.grid(41, 41, size=(0.04, 0.04), center=(0, 0, 0.005), radius=0.0005)
    layers = {"published": Layer(), "half": Layer(recoil=0.25), "none": Layer(recoil=0.5)}
    sensors = {name: _taxel(probes=fine, points=0, layer=layer, dilate_spread=3e5) for name, layer in layers.items()}
    sensors["direct"] = _taxel(probes=fine, points=0, layer=layers["half"], dilate_spread=3e5, dilation="direct")
    suite = _suite(sensors)
    assert sensors["half"].way == "fft"
    _press(suite, (0, 0, -0.001))
    # Σ x · u is the displaced area: ∫ r² (1 − κ λ r²) e^(−λ r²) r dr is 1 − 2κ of the published one.
    place = np.array(fine.position)[:, :2]
    area = {name: float((place * suite.read(name)[0].flatten(0, 1).numpy()[:, :2]).sum()) for name in sensors}
    assert area["half"] == pytest.approx(0.5 * area["published"], rel=2e-3)
    assert abs(area["none"]) < 2e-3 * area["published"]
    np.testing.assert_allclose(suite.read("direct"), suite.read("half"), atol=2e-6 * float(suite.read("half").max()))


def test_noise_and_radius_error_act_on_the_measured_branch_only() -> None:
    noise = Noise(radius=3e-4, gain=(0.5, 0.5), hysteresis=0.5)
    suite = _suite({"clean": _taxel(), "noisy": _taxel(noise=noise)})
    _press(suite, (0, 0, -0.001), (0.0005, 0, -0.001))
    np.testing.assert_allclose(suite.read_ground_truth("noisy"), suite.read("clean"), atol=1e-9)
    assert float((suite.read("noisy") - suite.read("clean")).abs().max()) > 1e-6


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: _taxel(probes=Probes([[0, 0, 0]], [[0, 0, 1.0]], 0.01), dilation="fft"), "regular planar grid"),
        (lambda: _taxel(dilation="fast"), "separable"),
        (lambda: Layer(poisson=0.7), "poisson .*at most 0.5;"),
        (lambda: Layer(frame=(0.0, 1.0)), r"frame .*above 0; received 0\.0"),
        (lambda: Layer(recoil=-0.1), "recoil .*at least 0"),
        (lambda: _taxel(layer=Layer(recoil=0.5), dilation="separable"), "no separable dilation"),
    ],
)
def test_mistakes_are_named(make: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()


SKIN, PITCH = Skin(thickness=5e-4, modulus=2e5, poisson=0.4), 2e-4
CONSTRAINED = 2e5 * 0.6 / (1.4 * 0.2)


def _load(shape: Geometry, height: float, depth: float) -> np.ndarray:
    base = Probes.grid(
        91, 91, size=(90 * PITCH, 90 * PITCH), center=(0, 0, 0.005 - SKIN.thickness), radius=SKIN.thickness
    )
    scene = pad_scene(shape)
    taxel = KinematicTaxel(link="hand", probes=base, friction=0.5, **SKIN.law(PITCH**2))
    suite = SensorSuite(scene, {"t": taxel}, num_envs=1)
    for x in (0.0, 1e-5):
        suite.update(state_of(scene, poses_at(3, {2: (x, 0, 0.005 + height - depth)})))
    return suite.read("t").sum((0, 1, 2)).numpy()


def test_a_flat_punch_presses_with_the_constrained_modulus_and_drags_with_the_shear_modulus() -> None:
    force = _load(Geometry(name="o", link="o", kind="box", size=(0.02, 0.02, 0.01)), 0.01, 5e-5)
    area = (91 * PITCH) ** 2
    assert -force[2] == pytest.approx(CONSTRAINED * area * 5e-5 / SKIN.thickness, rel=0.01)
    assert force[0] / -force[2] == pytest.approx(2e5 / 2.8 * 1e-5 / (CONSTRAINED * 5e-5), rel=0.02)


def test_a_ball_presses_a_thin_layer_with_the_square_of_its_depth() -> None:
    force = _load(Geometry(name="o", link="o", kind="sphere", size=(0.05,)), 0.05, 1e-4)
    assert -force[2] == pytest.approx(np.pi * CONSTRAINED * 0.05 * 1e-4**2 / SKIN.thickness, rel=0.03)


def test_a_skin_that_cannot_be_is_refused() -> None:
    for wrong in ({"thickness": 0.0}, {"modulus": -1.0}, {"poisson": 0.5}):
        with pytest.raises(UsageError, match=next(iter(wrong))):
            Skin(**{"thickness": 1e-3, "modulus": 1e5, **wrong})
    with pytest.raises(UsageError, match="area"):
        SKIN.law(0)
