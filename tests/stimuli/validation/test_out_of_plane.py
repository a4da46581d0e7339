"""Engines against the Kirchhoff rod: curved whiskers loaded across their plane."""

from dataclasses import replace

import pytest

from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.out_of_plane import load_aside, push_aside

MOUSE, RAT = WhiskerArray.mouse()["C5"].whisker, WhiskerArray.rat()["D4"].whisker


def _force(whisker, at, share):
    """Force (N) that would bend the straight whisker by a share of its length."""
    straight = replace(whisker, curvature=0.0)
    return share * whisker.arc_length / references.point_load_deflection(straight, 1.0, at)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("whisker", "backend"), [(MOUSE, "rod"), (RAT, "rod"), (RAT, "mujoco")], ids=["mouse-rod", "rat-rod", "rat-mujoco"]
)
def test_a_whisker_yields_to_a_force_across_its_plane_as_the_rod_does(whisker, backend):
    at = 0.8 * whisker.arc_length
    test = load_aside(whisker, at, _force(whisker, at, 0.1), backend=backend, fidelity="accurate")
    assert test.deflection == pytest.approx(test.reference_deflection, rel=0.003)
    assert test.moment_error < 0.005


@pytest.mark.slow
def test_without_twist_it_is_too_stiff():
    at = 0.8 * RAT.arc_length
    test = load_aside(RAT, at, _force(RAT, at, 0.1), fidelity="accurate,twist=false")
    assert test.deflection < (1 - 0.015) * test.reference_deflection


def test_a_peg_that_pushes_it_aside_is_felt_as_by_the_rod():
    test = push_aside(RAT, 0.5 * RAT.arc_length, 0.1 * RAT.arc_length, fidelity="accurate")
    assert test.force_error < 0.005
    assert test.moment_error < 0.005


@pytest.mark.slow
def test_poissons_ratio_softens_twist():
    at = 0.8 * RAT.arc_length
    force = _force(RAT, at, 0.05)
    soft, hard = (
        load_aside(replace(RAT, poisson_ratio=ratio), at, force, fidelity="accurate") for ratio in (0.5, -0.5)
    )
    assert soft.deflection > 1.01 * hard.deflection
    for test in (soft, hard):
        assert test.deflection == pytest.approx(test.reference_deflection, rel=0.003)
