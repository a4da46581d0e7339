"""One whisker's geometry against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.core.files import content_hash, to_plain
from brainbench.stimuli.whiskers.whisker import FollicleSprings, Whisker
from tests.factories.whiskers import C2


def _make_whisker(**changes):
    values = {
        "arc_length": 0.02,
        "base_radius": 50e-6,
        "tip_radius": 5e-6,
        "young_modulus": 3e9,
        "density": 1300.0,
        "damping_ratio": 0.2,
    }
    return Whisker(**{**values, **changes})


def test_a_cylinder_has_the_mass_and_stiffness_of_a_cylinder():
    whisker = _make_whisker(tip_radius=50e-6)
    assert whisker.mass == pytest.approx(1300 * math.pi * 50e-6**2 * 0.02, rel=1e-12)
    assert whisker.bending_stiffness(0.01) == pytest.approx(3e9 * math.pi * 50e-6**4 / 4, rel=1e-12)


def test_the_mass_of_a_cone_frustum_is_exact():
    volume = math.pi * 0.02 / 3 * (50e-6**2 + 50e-6 * 5e-6 + 5e-6**2)
    assert _make_whisker().mass == pytest.approx(1300 * volume, rel=1e-12)


def test_mass_with_a_density_gradient_is_the_integral_of_the_linear_density():
    whisker = _make_whisker(density=(1260.0, 1690.0))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    s = (nodes + 1) / 2 * whisker.arc_length
    assert whisker.mass == pytest.approx(np.dot(weights, whisker.linear_density(s)) * whisker.arc_length / 2, rel=1e-12)


@given(curvature=st.floats(-80, 80), arc_length=st.floats(0.004, 0.06))
def test_the_centre_line_is_the_parabola_measured_along_its_arc(curvature, arc_length):
    whisker = _make_whisker(curvature=curvature, arc_length=arc_length)
    x, y = whisker.centre_line(arc_length)
    assert y == pytest.approx(curvature * x**2, abs=1e-15)
    u = 2 * curvature * x
    along = x if abs(u) < 1e-6 else (u * math.sqrt(1 + u * u) + math.asinh(u)) / (4 * curvature)
    assert along == pytest.approx(arc_length, rel=1e-9)
    assert math.tan(whisker.tangent_angle(arc_length)) == pytest.approx(u, rel=1e-9, abs=1e-12)


def test_a_curvature_of_the_other_sign_mirrors_the_shape():
    s = np.linspace(0, 0.02, 11)
    up, down = _make_whisker(curvature=15.0).centre_line(s), _make_whisker(curvature=-15.0).centre_line(s)
    np.testing.assert_allclose(down, up * [1, -1], atol=1e-18)


def test_the_torsional_stiffness_of_a_cylinder_is_its_shear_modulus_times_polar_moment():
    whisker = _make_whisker(tip_radius=50e-6, poisson_ratio=0.3)
    shear = 3e9 / (2 * 1.3)
    assert whisker.torsional_stiffness(0.01) == pytest.approx(shear * math.pi * 50e-6**4 / 2, rel=1e-12)


def test_poissons_ratio_is_in_hashes_only_where_it_is_not_the_default():
    assert content_hash(_make_whisker()) == content_hash(_make_whisker(poisson_ratio=0.4))
    assert "poisson_ratio" not in to_plain(_make_whisker())
    assert content_hash(_make_whisker()) != content_hash(_make_whisker(poisson_ratio=0.3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"density": 1.3}, r"density .*kg.*received 1.3"),
        ({"density": (1.0, 2.0, 3.0)}, "density .*holds 2 numbers"),
        ({"density": (1260.0, -1.0)}, r"density .*received -1"),
        ({"base_radius": 0.05}, "no slender rod"),
    ],
)
def test_impossible_values_are_refused_by_name(changes, message):
    with pytest.raises(UsageError, match=message):
        _make_whisker(**changes)


@pytest.mark.parametrize(
    ("name", "rows", "words"),
    [
        ("radii", [[0, 1e-5], [0.002, 2e-5]], "ascend from 0 to that of the whisker, 0.01"),
        ("radii", [[0, 2e-5], [0.006, 2e-5], [0.005, 1e-5], [0.01, 1e-5]], "radii of a whisker are rows"),
        ("radii", [[0, 2e-5], [0.01, 0.0]], "Every radius in the radii of a whisker is above 0"),
        ("moduli", [[0.001, 3e9], [0.01, 3e9]], "ascend from 0"),
        ("moduli", [[0, 3.3], [0.01, 2.9]], "Every Young's modulus in the moduli of a whisker is above 1000"),
    ],
)
def test_tables_that_cannot_be_are_refused(name, rows, words):
    with pytest.raises(UsageError, match=words):
        replace(C2, arc_length=0.01, **{name: rows})


def test_a_table_of_the_cone_is_the_cone_and_stands_for_both_its_radii():
    arcs = np.array([0.0, 0.3, 0.7, 1.0]) * C2.arc_length
    table = np.stack([arcs, C2.radius(arcs)], axis=1).tolist()
    whisker = replace(C2, base_radius=1e-6, tip_radius=1e-6, radii=table, moduli=[[0, 2e9], [C2.arc_length, 4e9]])
    s = np.linspace(0, C2.arc_length, 31)
    np.testing.assert_allclose(whisker.radius(s), C2.radius(s), rtol=1e-14)
    assert (whisker.base_radius, whisker.tip_radius) == (C2.base_radius, C2.tip_radius)
    assert whisker.mass == pytest.approx(C2.mass, rel=1e-13)
    np.testing.assert_allclose(
        whisker.bending_stiffness(s) / C2.bending_stiffness(s), np.linspace(2e9, 4e9, 31) / C2.young_modulus, rtol=1e-13
    )
    assert hash(whisker) != hash(C2)


@pytest.mark.parametrize(
    ("springs", "words"),
    [
        ({"about_z": (0.0, 1e-9)}, "about_z of a follicle must be"),
        ({"about_z": (math.inf, 1e-9)}, "about_z of a follicle must be"),
        ({"along_y": (0.1, 0.0)}, "along_y of a follicle must be"),
        ({"about_w": (1e-6, 1e-9)}, "'about_w'.*about_z"),
        ({}, "has one spring at least"),
    ],
)
def test_follicles_without_sense_are_refused(springs, words):
    with pytest.raises(UsageError, match=words):
        replace(C2, follicle=springs)


def test_follicle_of_a_file_is_that_of_python():
    whisker = replace(C2, follicle={"about_z": [2e-6, 2e-9]})
    assert whisker.follicle == FollicleSprings(about_z=(2e-6, 2e-9))
    assert whisker.follicle.constants[5].tolist() == [2e-6, 2e-9]
    assert content_hash(whisker) != content_hash(C2)
    assert hash(whisker) != hash(C2)
