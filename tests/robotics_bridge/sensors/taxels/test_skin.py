"""Loads on a thin bonded layer of taxels against closed forms (Johnson 1985, 5.8)."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics import Geometry
from robotics_bridge.sensors import KinematicTaxel, Probes, SensorSuite
from robotics_bridge.sensors.taxels.skin import Skin
from tests.factories.touch_scenes import pad_scene, poses_at, state_of

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
