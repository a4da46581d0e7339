"""One whisker's geometry against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from brainbench.core.errors import UsageError
from brainbench.core.files import content_hash, to_plain
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.validation.references import natural_frequencies
from brainbench.stimuli.whiskers.whisker import FollicleSprings, Whisker, build_chain
from tests.factories.engine_scenes import C2, NEEDLE, H


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
    stiffness = whisker.torsion_ratio * whisker.bending_stiffness(0.01)
    assert stiffness == pytest.approx(shear * math.pi * 50e-6**4 / 2, rel=1e-12)


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


@pytest.mark.parametrize("links", [3, 10, 25])
def test_mass_and_moment_of_inertia_about_the_base_are_those_of_the_rod(links):
    chain = build_chain(C2, links)
    assert chain.masses.sum() == pytest.approx(C2.mass, rel=1e-12)
    centres = chain.nodes[:-1] + chain.centres
    inertia = np.sum(chain.masses * centres**2 + chain.inertias[:, 1])
    rod = quad(lambda s: C2.linear_density(s) * (s**2 + C2.radius(s) ** 2 / 4), 0, C2.arc_length, epsabs=0)[0]
    assert inertia == pytest.approx(rod, rel=1e-10)


def test_a_link_of_a_cylinder_has_the_inertia_of_a_cylinder():
    chain = build_chain(replace(C2, tip_radius=48.365e-6, density=1260.0), 4)
    mass, length, radius = chain.masses[0], chain.lengths[0], 48.365e-6
    assert chain.inertias[0, 0] == pytest.approx(mass * radius**2 / 2, rel=1e-12)
    assert chain.inertias[0, 1] == pytest.approx(mass * (3 * radius**2 + length**2) / 12, rel=1e-12)


def test_uniform_joints_stand_for_their_cells_with_gregory_end_weights():
    chain = build_chain(replace(C2, tip_radius=48.365e-6), 12)
    cells = float(C2.bending_stiffness(0.0)) / chain.stiffness / (C2.arc_length / 12)
    np.testing.assert_allclose(cells[:3], [3 / 8, 7 / 6, 23 / 24], rtol=1e-12)
    np.testing.assert_allclose(cells[3:-1], 1.0, rtol=1e-12)


@pytest.mark.parametrize(("links", "tolerance"), [(10, 0.002), (20, 0.0002)])
def test_static_compliance_under_a_tip_load_is_that_of_the_rod(links, tolerance):
    chain = build_chain(C2, links)
    lever = C2.arc_length - chain.nodes[:-1]
    exact = quad(lambda s: (C2.arc_length - s) ** 2 / C2.bending_stiffness(s), 0, C2.arc_length, epsabs=0)[0]
    assert np.sum(lever**2 / chain.stiffness) == pytest.approx(exact, rel=tolerance)


@pytest.mark.parametrize(("links", "tolerance"), [(10, (0.0015, 0.003, 0.005)), (20, (1e-4, 3e-4, 3e-4))])
def test_natural_frequencies_are_those_of_the_rod(links, tolerance):
    found = build_chain(C2, links).frequencies(3) / (2 * np.pi)
    assert np.all(np.abs(found / natural_frequencies(C2) - 1) < tolerance)


@given(
    links=st.integers(2, 40),
    tip=st.floats(1.5e-6, 9e-5),
    length=st.floats(0.004, 0.06),
    curvature=st.floats(-40, 40),
)
@settings(max_examples=60)
def test_every_joint_is_elastic_and_every_link_has_mass_whatever_the_taper(links, tip, length, curvature):
    whisker = Whisker(length, 9e-5, tip, young_modulus=4e9, density=1300.0, damping_ratio=0.2, curvature=curvature)
    chain = build_chain(whisker, links)
    assert (chain.stiffness > 0).all()
    assert (chain.masses > 0).all()
    assert (chain.inertias > 0).all()
    assert ((chain.centres > 0) & (chain.centres < chain.lengths)).all()


def test_a_needle_with_a_steep_tip_still_has_its_first_frequency_and_its_compliance():
    chain = build_chain(NEEDLE, 10)
    assert chain.frequencies()[0] / (2 * np.pi) == pytest.approx(natural_frequencies(NEEDLE, 1)[0], rel=0.005)
    at = 0.7 * NEEDLE.arc_length
    exact = quad(lambda s: (at - s) ** 2 / NEEDLE.bending_stiffness(s), 0, at, epsabs=0)[0]
    lever = np.maximum(at - chain.nodes[:-1], 0)
    assert np.sum(lever**2 / chain.stiffness) == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize("links", [2, 5, 20])
def test_joints_lie_on_the_rest_curve_for_any_number_of_links(links):
    chain = build_chain(replace(C2, curvature=25.0), links)
    np.testing.assert_allclose(chain.points[:, 1], 25.0 * chain.points[:, 0] ** 2, rtol=1e-9, atol=1e-15)
    headings = np.cumsum(chain.rest_angles)
    steps = chain.lengths[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    np.testing.assert_allclose(np.cumsum(steps, axis=0), chain.points[1:, :2], atol=1e-15)


def test_damping_gives_the_first_mode_its_ratio_once_the_step_is_counted():
    chain = build_chain(C2, 10)
    omega = chain.frequencies()[0]
    beta = chain.damping(1e-4) / chain.stiffness
    np.testing.assert_allclose((beta + 1e-4) * omega / 2, 0.32, rtol=1e-9)
    assert chain.achieved_damping_ratio(1e-4) == pytest.approx(0.32)


def test_a_step_too_long_to_damp_so_little_is_told():
    chain = build_chain(C2, 10)
    assert (chain.damping(2e-3) == 0).all()
    assert chain.achieved_damping_ratio(2e-3) == pytest.approx(chain.frequencies()[0] * 1e-3)


def test_one_link_cannot_bend():
    with pytest.raises(UsageError, match=r"links .*at least 2"):
        build_chain(C2, 1)


@pytest.mark.parametrize("links", [4, 11, 20])
def test_every_second_joint_takes_over_the_twist_of_its_neighbours(links):
    chain = build_chain(replace(H, poisson_ratio=0.25), links)
    assert np.array_equal(chain.torsion > 0, np.arange(links) % 2 == 1)
    # GJ = EI/(1 + ν); of an odd number of links half the last cell, next to the free tip, is left out.
    whole = np.sum(1 / chain.stiffness) - (links % 2) / 2 / chain.stiffness[-1]
    assert np.sum(1 / chain.torsion[1::2]) == pytest.approx(1.25 * whole, rel=1e-12)


def test_a_chain_of_a_table_that_is_the_cone_is_the_chain_of_the_cone():
    arcs = np.array([0.0, 0.37, 1.0]) * C2.arc_length
    table = replace(C2, radii=np.stack([arcs, C2.radius(arcs)], axis=1).tolist())
    for name in ("masses", "centres", "inertias", "stiffness", "radii"):
        np.testing.assert_allclose(
            getattr(build_chain(table, 11), name), getattr(build_chain(C2, 11), name), rtol=1e-12
        )


def _stepped():
    """A beam of two cylinders, thick up to .4 of its length, and its deflection at the tip over the load there."""
    length, thick, thin, joint = C2.arc_length, 5e-5, 3e-5, 0.4 * C2.arc_length
    rows = [[0, thick], [joint, thick], [joint + 1e-9, thin], [length, thin]]
    first, second = (C2.young_modulus * np.pi * radius**4 / 4 for radius in (thick, thin))
    rest = length - joint
    return replace(C2, curvature=0.0, radii=rows), (length**3 - rest**3) / (3 * first) + rest**3 / (3 * second)


def test_a_stepped_beam_bends_as_its_closed_form_says_with_an_error_that_falls_with_the_square_of_the_links():
    whisker, exact = _stepped()
    errors = []
    for links in (10, 20, 40):
        chain = build_chain(whisker, links)
        errors.append(abs(np.sum((whisker.arc_length - chain.nodes[:-1]) ** 2 / chain.stiffness) / exact - 1))
    assert errors[0] < 0.006
    assert errors[1] < errors[0] / 3
    assert errors[2] < errors[1] / 3


@pytest.mark.parametrize("backend", ["rod", "mujoco"])
def test_engines_bend_a_stepped_beam_of_two_materials(backend):
    whisker, _ = _stepped()
    softer = [[0, C2.young_modulus], [0.6 * whisker.arc_length, C2.young_modulus / 2], [whisker.arc_length, 1e9]]
    whisker = replace(whisker, moduli=softer, damping_ratio=0.5)
    length = whisker.arc_length
    breaks = [0.4 * length, 0.6 * length]
    compliance = quad(lambda s: (length - s) ** 2 / whisker.bending_stiffness(s), 0, length, points=breaks, epsabs=0)[0]
    force = 1e-3 * length / compliance
    job = Job(whisker, StillFollicle(), (), np.array([0.2]), loads=(Load(length, (0.0, force, 0.0)),))
    (trace,) = get_engine(backend).run([job], Fidelity(links=20), record_shape=True)
    assert trace.link_positions is not None
    assert trace.link_positions[0, -1, 1] == pytest.approx(1e-3 * length, rel=5e-3)
    assert trace.wrench[0, 5] == pytest.approx(force * length, rel=1e-3)
