"""Bench tests: the real backend against mechanics that needs no simulation."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.errors import UsageError
from brainbench.stimuli import validation
from brainbench.stimuli.fidelity import Fidelity
from brainbench.stimuli.whisker import Whisker

C2 = Whisker(0.015265, 48.365e-6, 8.78e-6, young_modulus=5e9, density=(1260.0, 1690.0), damping_ratio=0.32)
RAT = Whisker(0.040, 80e-6, 3e-6, young_modulus=3e9, density=1300.0, damping_ratio=0.15)
POINTS = [(0.3, 0.05), (0.5, 0.1), (0.5, 0.2), (0.7, 0.2)]


@pytest.mark.parametrize(("preset", "promise"), [("fast", 0.15), ("balanced", 0.05)])
@pytest.mark.parametrize(("at", "offset"), POINTS)
def test_a_peg_reproduces_the_elastica(preset, promise, at, offset):
    result = validation.peg(C2, at * C2.arc_length, offset * C2.arc_length, fidelity=preset)
    assert result.moment_error < promise
    assert result.force_error < promise


@pytest.mark.slow
@pytest.mark.parametrize(("at", "offset"), POINTS)
@pytest.mark.parametrize("radius", [5e-5, 2.5e-4, 5e-4])
def test_at_preset_accurate_the_moment_is_within_1_and_the_force_within_2_percent(at, offset, radius):
    result = validation.peg(C2, at * C2.arc_length, offset * C2.arc_length, peg_radius=radius, fidelity="accurate")
    assert result.moment_error < 0.01
    assert result.force_error < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("radius", [1e-3, 1.5e-3])
def test_a_thick_peg_at_the_step_between_two_links_tilts_the_force_no_more_than_stated(radius):
    result = validation.peg(C2, 0.5 * C2.arc_length, 0.2 * C2.arc_length, peg_radius=radius, fidelity="accurate")
    lip = (C2.base_radius - C2.tip_radius) / Fidelity.preset("accurate").links
    assert result.moment_error < 0.01
    assert result.force_error < np.sqrt(2 * lip / radius)


def test_a_peg_pushing_up_pushes_the_base_up_and_turns_it_left():
    result = validation.peg(C2, 0.5 * C2.arc_length, 0.1 * C2.arc_length)
    assert result.wrench[1] > 0
    assert result.wrench[5] > 0
    np.testing.assert_allclose(result.wrench[[2, 3, 4]], 0, atol=1e-12)


def test_a_peg_from_the_other_side_mirrors_the_wrench():
    up = validation.peg(C2, 0.5 * C2.arc_length, 0.1 * C2.arc_length)
    down = validation.peg(C2, 0.5 * C2.arc_length, -0.1 * C2.arc_length)
    np.testing.assert_allclose(down.wrench[[0, 1, 5]], up.wrench[[0, 1, 5]] * [1, -1, -1], rtol=1e-6)


def test_the_contact_arc_is_that_of_the_elastica():
    from brainbench.stimuli.references import elastica

    result = validation.peg(C2, 0.5 * C2.arc_length, 0.2 * C2.arc_length)
    expected = elastica(C2, 0.5 * C2.arc_length, 0.2 * C2.arc_length).arc
    assert result.contact_arc == pytest.approx(expected, rel=2e-3)


def test_a_long_rat_whisker_bends_as_the_elastica_too():
    result = validation.peg(RAT, 0.5 * RAT.arc_length, 0.1 * RAT.arc_length)
    assert result.moment_error < 0.02
    assert result.force_error < 0.02


@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
def test_a_point_load_bends_the_cantilever_by_the_closed_form(share):
    at = share * C2.arc_length
    weak = 1e-3 * at / validation.references.point_load_deflection(C2, 1.0, at)
    result = validation.point_load(C2, weak, at)
    assert result.wrench[1] == pytest.approx(weak, rel=1e-8)
    assert result.moment_error < 1e-5
    assert result.deflection == pytest.approx(result.reference_deflection, rel=0.01)


def test_a_ringdown_shows_the_first_frequency_and_the_damping_ratio():
    light = replace(C2, damping_ratio=0.15)
    result = validation.ringdown(light, fidelity=Fidelity(links=10, time_step=2e-5))
    assert result.frequency_error == pytest.approx(0, abs=0.005)
    assert result.damping_ratio == pytest.approx(0.15, rel=0.02)
    assert abs(result.wrench[-1, 5]) < 1e-4 * np.abs(result.wrench[:, 5]).max()


def test_halving_the_time_step_halves_the_error_of_the_ringdown():
    errors = [
        validation.ringdown(C2, fidelity=Fidelity(links=10, time_step=step)).frequency_error for step in (1e-4, 5e-5)
    ]
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: validation.peg(replace(C2, curvature=5.0), 0.007, 1e-3), "takes a straight whisker"),
        (lambda: validation.peg(C2, 0.007, 0.0), "an offset other than zero"),
        (lambda: validation.peg(C2, 0.007, 1e-3, peg_radius=0.0), "peg_radius must be positive"),
        (lambda: validation.peg(C2, 0.0107, 0.0107), "slips off"),
        (lambda: validation.point_load(C2, 0.0, 0.01), "other than zero"),
        (lambda: validation.point_load(C2, 1e-6, 0.1), "0 < at"),
        (lambda: validation.ringdown(replace(C2, damping_ratio=1.5)), "between 0 and 1"),
        (lambda: validation.peg(C2, 0.007, 1e-3, backend="mujocco"), "did you mean 'mujoco'"),
    ],
)
def test_impossible_bench_tests_are_refused(call, message):
    with pytest.raises(UsageError, match=message):
        call()
