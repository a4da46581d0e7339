"""Bench tests: the real backend against mechanics that needs no simulation."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.motion.jobs import Trace
from brainbench.stimuli.validation import bench_tests, references
from brainbench.stimuli.validation.bench_tests import PointLoad
from tests.factories.whiskers import C2, GATE_WHISKERS, RAT

POINTS = [(0.3, 0.05), (0.5, 0.1), (0.5, 0.2), (0.7, 0.2)]


@pytest.mark.parametrize(("preset", "promise"), [("fast", 0.15), ("balanced", 0.05)])
@pytest.mark.parametrize(("at", "offset"), POINTS)
def test_a_peg_reproduces_the_elastica(preset, promise, at, offset):
    result = bench_tests.peg(C2, at * C2.arc_length, offset * C2.arc_length, fidelity=preset)
    assert result.moment_error < promise
    assert result.force_error < promise


@pytest.mark.slow
def test_a_bare_rod_loses_the_whisker_sideways_before_the_depth_of_the_plane_and_a_pulley_does_not(monkeypatch):
    # The planar equilibrium is unstable once the contact slope passes 90°; in MuJoCo round-off is disturbance enough.
    a4 = GATE_WHISKERS["A4"]
    at = 0.3 * a4.arc_length
    held = bench_tests.slip_off(a4, at, fidelity="accurate")
    monkeypatch.setattr(bench_tests, "_pulley", bench_tests._peg_obstacle)
    bare = bench_tests.slip_off(a4, at, backend="mujoco", fidelity="accurate")
    assert np.abs(held.trace.link_positions[..., 2]).max() < 0.01 * a4.arc_length
    assert np.abs(bare.trace.link_positions[..., 2]).max() > 0.1 * a4.arc_length
    assert bare.error < -0.02 < held.error


def _gated(whisker, at, offset):
    """Whether the equilibrium is well conditioned: slope at most 60°, depth at most .9 of slip-off."""
    if offset > 0.9 * references.slip_off_offset(whisker, at):
        return False
    return references.elastica(whisker, at, offset).slope <= np.radians(60)


PROMISES = {"fast": (0.15, 0.15), "balanced": (0.05, 0.05), "accurate": (0.01, 0.02)}


@pytest.mark.slow
@pytest.mark.parametrize("name", GATE_WHISKERS)
def test_every_preset_reproduces_the_elastica_over_the_whole_range(name):
    whisker = GATE_WHISKERS[name]
    for share in (0.3, 0.45, 0.6, 0.8):
        at = share * whisker.arc_length
        for depth in (0.02, 0.07, 0.15, 0.3):
            offset = depth * whisker.arc_length
            if not _gated(whisker, at, offset):
                continue
            for preset, (moment, force) in PROMISES.items():
                result = bench_tests.peg(whisker, at, offset, fidelity=preset)
                assert result.moment_error < moment, (share, depth, preset)
                assert result.force_error < force, (share, depth, preset)


@pytest.mark.slow
@pytest.mark.parametrize("name", GATE_WHISKERS)
@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
@pytest.mark.parametrize(("preset", "promise"), [("fast", 0.15), ("balanced", 0.05), ("accurate", 0.03)])
def test_the_whisker_slips_off_at_the_depth_of_the_elastica(name, share, preset, promise):
    whisker = GATE_WHISKERS[name]
    result = bench_tests.slip_off(whisker, share * whisker.arc_length, fidelity=preset)
    assert result.error == pytest.approx(0, abs=promise)


@pytest.mark.parametrize(
    ("at", "offset", "radius"),
    [
        pytest.param(0.3, 0.02, 5e-5, marks=pytest.mark.slow),
        (0.3, 0.02, 1e-4),
        (0.3, 0.02, 2.5e-4),
        (0.5, 0.2, 1.5e-3),
    ],
)
def test_a_peg_of_any_radius_at_a_joint_of_the_chain_meets_a_smooth_taper(at, offset, radius):
    # A staircase of capsules turned this force by up to 15 %.
    result = bench_tests.peg(C2, at * C2.arc_length, offset * C2.arc_length, peg_radius=radius, fidelity="accurate")
    assert result.moment_error < 0.01
    assert result.force_error < 0.005


def test_a_peg_pushing_up_pushes_the_base_up_and_turns_it_left():
    result = bench_tests.peg(C2, 0.5 * C2.arc_length, 0.1 * C2.arc_length)
    assert result.wrench[1] > 0
    assert result.wrench[5] > 0
    np.testing.assert_allclose(result.wrench[[2, 3, 4]], 0, atol=1e-12)


def test_a_peg_from_the_other_side_mirrors_the_wrench():
    up = bench_tests.peg(C2, 0.5 * C2.arc_length, 0.1 * C2.arc_length)
    down = bench_tests.peg(C2, 0.5 * C2.arc_length, -0.1 * C2.arc_length)
    np.testing.assert_allclose(down.wrench[[0, 1, 5]], up.wrench[[0, 1, 5]] * [1, -1, -1], rtol=1e-6)


def test_a_long_rat_whisker_bends_as_the_elastica_too():
    result = bench_tests.peg(RAT, 0.5 * RAT.arc_length, 0.1 * RAT.arc_length)
    assert result.moment_error < 0.02
    assert result.force_error < 0.02


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bench_tests.peg(replace(C2, curvature=5.0), 0.007, 1e-3), "takes a straight whisker"),
        (lambda: bench_tests.peg(C2, 0.007, 0.0), "an offset other than zero"),
        (lambda: bench_tests.peg(C2, 0.007, 1e-3, peg_radius=0.0), r"peg_radius .*received 0"),
        pytest.param(lambda: bench_tests.peg(C2, 0.0107, 0.0107), "slips off", marks=pytest.mark.slow),
        (lambda: bench_tests.point_load(C2, 0.0, 0.01), "other than zero"),
        (lambda: bench_tests.point_load(C2, 1e-6, 0.1), r"at \(m\).*received 0\.1"),
        (lambda: bench_tests.slip_off(replace(C2, curvature=5.0), 0.007), "takes a straight whisker"),
        (lambda: bench_tests.slip_off(C2, 0.1), r"at \(m\).*received 0\.1"),
        (lambda: bench_tests.peg(C2, 0.007, 1e-3, backend="mujocco"), "did you mean 'mujoco'"),
    ],
)
def test_impossible_bench_tests_are_refused(call, message):
    with pytest.raises(UsageError, match=message):
        call()


def test_a_result_prints_its_figures_and_not_the_trace():
    trace = Trace(np.zeros((500, 6)), np.zeros(500, dtype=bool), np.zeros(500))
    text = repr(PointLoad(np.ones(6), np.ones(6), 0.01, trace, 1e-3, 1e-3))
    assert "deflection=0.001" in text
    assert "trace" not in text
