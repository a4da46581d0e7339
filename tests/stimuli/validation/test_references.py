"""References against published and independently derived numbers (project notes, section 1)."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from brainbench.core.errors import UsageError
from brainbench.stimuli.validation import references
from tests.factories.engine_scenes import C2, H


@pytest.mark.parametrize(
    ("whisker", "at", "offset", "expected"),
    [
        (C2, 0.5, 0.1, {"fx": -0.0437011, "fy": 0.113124, "moment": 0.930131}),
        (C2, 0.5, 0.2, {"fx": -0.131664, "fy": 0.144803, "moment": 1.50718}),
        (H, 0.5, 0.1, {"moment": 0.450269}),
        (H, 0.7, 0.2, {"moment": 0.252969}),
    ],
)
def test_the_elastica_reproduces_the_published_table(whisker, at, offset, expected):
    contact = references.elastica(whisker, at * whisker.arc_length, offset * whisker.arc_length)
    found = {"fx": contact.force[0] * 1e3, "fy": contact.force[1] * 1e3, "moment": contact.moment * 1e6}
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=5e-6)


def test_the_elastica_meets_its_peg_with_a_normal_force():
    contact = references.elastica(C2, 0.6 * C2.arc_length, 0.15 * C2.arc_length)
    assert contact.point == pytest.approx((0.6 * C2.arc_length, 0.15 * C2.arc_length), rel=1e-9)
    tangent = (math.cos(contact.slope), math.sin(contact.slope))
    assert np.dot(contact.force, tangent) == pytest.approx(0, abs=1e-15)
    lever = contact.point[0] * contact.force[1] - contact.point[1] * contact.force[0]
    assert contact.moment == pytest.approx(lever, rel=1e-9)


def test_pushing_the_other_way_mirrors_the_elastica():
    up = references.elastica(C2, 0.5 * C2.arc_length, 0.1 * C2.arc_length)
    down = references.elastica(C2, 0.5 * C2.arc_length, -0.1 * C2.arc_length)
    np.testing.assert_allclose(down.wrench, up.wrench * [1, -1, 1, 1, 1, -1], rtol=1e-12)


def test_small_bending_of_the_elastica_is_the_tapered_cantilever():
    at, offset = 0.6 * C2.arc_length, 1e-5 * C2.arc_length
    contact = references.elastica(C2, at, offset)
    assert references.point_load_deflection(C2, contact.force[1], at) == pytest.approx(offset, rel=1e-6)


@pytest.mark.parametrize("whisker", [C2, H, replace(H, tip_radius=50e-6)])
@pytest.mark.parametrize("share", [0.2, 0.7, 1.0])
def test_the_point_load_formula_equals_quadrature_of_the_bending_energy(whisker, share):
    at = share * whisker.arc_length
    deflection = quad(lambda s: (at - s) ** 2 / whisker.bending_stiffness(s), 0, at, epsabs=0)[0]
    assert references.point_load_deflection(whisker, 1.0, at) == pytest.approx(deflection, rel=1e-9)


@pytest.mark.parametrize(
    ("ratio", "expected"),
    [
        (1.0, (3.516, 22.034, 61.697)),
        (0.5, (4.6252, 19.5476, 48.5789)),
        (0.2, (6.1964, 18.3855, 39.8336)),
        (0.1, (7.2049, 18.6802, 37.1238)),
        (0.05, (7.8941, 19.4478, 36.5096)),
    ],
)
def test_natural_frequencies_of_tapers_match_the_table(ratio, expected):
    whisker = replace(H, tip_radius=ratio * H.base_radius)
    scale = H.base_radius * math.sqrt(3e9 / 1300) / (4 * math.pi * H.arc_length**2)
    np.testing.assert_allclose(references.natural_frequencies(whisker) / scale, expected, rtol=5e-5)


def test_natural_frequencies_are_found_once_for_a_whisker():
    assert references.natural_frequencies(C2, 1) is references.natural_frequencies(replace(C2), 1)


def test_natural_frequencies_with_a_density_gradient_match_the_table():
    np.testing.assert_allclose(references.natural_frequencies(C2), (186.48, 546.15, 1175.4), rtol=4e-5)
    np.testing.assert_allclose(references.natural_frequencies(H), (108.87, 282.27, 560.97), rtol=4e-5)


def test_a_finite_peg_one_radius_sum_off_the_point_gives_the_same_contact():
    point = references.elastica(C2, 0.5 * C2.arc_length, 0.1 * C2.arc_length)
    centre = references.peg_centre(C2, point, 5e-5)
    finite = references.elastica(C2, *centre, 5e-5)
    np.testing.assert_allclose(finite.wrench, point.wrench, rtol=1e-8)
    assert finite.arc == pytest.approx(point.arc, rel=1e-9)


def test_ignoring_the_radius_of_a_peg_changes_the_moment_as_measured_before():
    at = 0.5 * C2.arc_length
    for depth, change in ((0.02, 0.26), (0.1, 0.046)):
        offset = depth * C2.arc_length
        ignored = references.elastica(C2, at, offset, 5e-5).moment
        assert ignored / references.elastica(C2, at, offset).moment - 1 == pytest.approx(change, abs=0.006)


def test_a_curved_whisker_touched_at_its_rest_shape_feels_nothing():
    curved = replace(C2, curvature=20.0)
    at = 0.5 * C2.arc_length
    assert references.elastica(curved, at, 20.0 * at**2).moment == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
def test_beyond_the_slip_off_offset_there_is_no_equilibrium():
    at = 0.7 * C2.arc_length
    limit = 0.005336
    assert references.elastica(C2, at, 0.99 * limit).arc <= C2.arc_length
    with pytest.raises(UsageError, match=r"offset of 0\.005336 m"):
        references.elastica(C2, at, 1.01 * limit)


@pytest.mark.slow
def test_near_the_base_a_whisker_turns_back_over_the_peg_before_it_slips_off():
    at = 0.3 * C2.arc_length
    limit = references.slip_off_offset(C2, at)
    last = references.elastica(C2, at, 0.999 * limit)
    assert math.pi / 2 < last.slope < math.pi
    lever = last.point[0] * last.force[1] - last.point[1] * last.force[0]
    assert last.moment == pytest.approx(lever, rel=1e-9)


@pytest.mark.slow
def test_the_slip_off_depth_of_a_round_peg_tends_to_that_of_a_point_on_a_thin_rod():
    thin = replace(C2, base_radius=4.8e-8, tip_radius=8.8e-9)
    at = 0.5 * thin.arc_length
    point = references.slip_off_offset(thin, at)
    assert references.slip_off_offset(thin, at, peg_radius=1e-8) == pytest.approx(point, rel=1e-4)


def test_a_peg_beyond_the_tip_is_refused():
    with pytest.raises(UsageError, match=r"\(m\).*0\.015265.*received 0\.02"):
        references.elastica(C2, 0.02, 1e-3)


def test_closed_forms_refuse_curved_whiskers():
    with pytest.raises(UsageError, match=r"curvature 10 .*elastica"):
        references.point_load_deflection(replace(C2, curvature=10.0), 1e-6, 0.01)
