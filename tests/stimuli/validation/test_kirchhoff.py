"""The static Kirchhoff rod against closed forms and the plane elastica."""

import math
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engine_scenes import H
from tests.factories.kirchhoff import KirchhoffRod, load_rod, press_rod


def test_a_quarter_circle_yields_to_a_force_across_its_plane_by_bending_and_twist():
    radius, bending, torsion, force = 0.01, 1e-9, 0.7e-9, 1e-10
    rod = KirchhoffRod(radius * math.pi / 2, lambda s: 1 / radius, lambda s: bending, lambda s: torsion)
    found = load_rod(rod, rod.length, (0.0, 0.0, force))
    # Castigliano: M = F R sin φ and T = F R (1 − cos φ) at the angle φ from the tip.
    expected = force * radius**3 * (math.pi / 4 / bending + (3 * math.pi / 4 - 2) / torsion)
    assert found.point[2] == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(found.moment, force * radius * np.array([1, -1, 0]), atol=1e-6 * force * radius)


@pytest.mark.slow
def test_a_straight_rod_on_a_peg_is_the_elastica():
    at, travel, radius = 0.012, 0.003, 2.5e-4
    found = press_rod(KirchhoffRod.of(H), at, (0, 0, 1), (0, 1, 0), travel, radius)
    centre = (at, travel - radius - float(H.radius(at)))
    expected = references.elastica(H, *centre, radius)
    np.testing.assert_allclose(found.wrench, expected.wrench, rtol=1e-6, atol=1e-12)
    assert found.arc == pytest.approx(expected.arc, rel=1e-6)


@pytest.mark.slow
def test_the_moment_on_the_base_is_that_of_the_force():
    whisker = WhiskerArray.rat()["D4"].whisker
    found = load_rod(KirchhoffRod.of(whisker), 0.6 * whisker.arc_length, (1e-6, 2e-6, 1e-5))
    np.testing.assert_allclose(found.moment, np.cross(found.point, found.force), atol=1e-6 * np.abs(found.moment).max())


def test_a_rod_without_force_keeps_its_shape():
    whisker = replace(H, curvature=20.0)
    found = load_rod(KirchhoffRod.of(whisker), 0.02, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(found.point, [*whisker.centre_line(0.02), 0.0], atol=1e-9)


@pytest.mark.slow
def test_a_rod_that_slips_off_is_told():
    with pytest.raises(DataError, match=r"slips off|equilibrium"):
        press_rod(KirchhoffRod.of(H), 0.019, (0, 0, 1), (0, 1, 0), 0.015, 2.5e-4)
