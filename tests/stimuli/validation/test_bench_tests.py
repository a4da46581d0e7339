"""Bench tests: the real backend against mechanics that needs no simulation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Trace
from brainbench.stimuli.validation import bench_tests, references
from brainbench.stimuli.validation.bench_tests import PointLoad, ringdown
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.factories.contact_scenes import HARD_OBJECTS, contact_jobs, difference
from tests.factories.engine_scenes import C2, RAT


def _gate_whiskers() -> dict[str, Whisker]:
    mouse, rat = WhiskerArray.mouse(), WhiskerArray.rat()
    published = [mouse["C2"], mouse["A4"], mouse["E5"], rat["C1"]]
    rods = [replace(mount.whisker, curvature=0.0) for mount in published]
    uniform = Whisker(0.015, 30e-6, 30e-6, young_modulus=5e9, density=1300.0, damping_ratio=0.32)
    steep = Whisker(0.020, 60e-6, 3e-6, young_modulus=3e9, density=1300.0, damping_ratio=0.32)
    return dict(zip(("C2", "A4", "E5", "rat C1", "uniform", "steep"), [*rods, uniform, steep], strict=True))


GATE_WHISKERS = _gate_whiskers()
"""Straight whiskers on which every preset has to keep its promise, by name."""


def _trace(wrench, status="ok"):
    contact = np.ones(len(wrench), dtype=bool)
    return Trace(np.asarray(wrench, dtype=float), contact, np.zeros(len(wrench)), status=status)


def test_a_seed_gives_the_same_scenes_and_another_one_others():
    first, again, other = contact_jobs(1, each=1), contact_jobs(1, each=1), contact_jobs(2, each=1)
    assert len(first) == 2 * 4 * 3 * 3
    where = [np.concatenate([job.obstacles[0].bounds.ravel() for job in jobs]) for jobs in (first, again, other)]
    np.testing.assert_array_equal(where[0], where[1])
    assert not np.isclose(where[0], where[2]).any()


def test_nearly_every_whisker_starts_free_and_then_touches():
    jobs = contact_jobs(3, each=1)
    traces = get_engine("rod").run(jobs, Fidelity.preset("fast"))
    assert np.mean([trace.status == "ok" for trace in traces]) >= 0.95
    assert np.mean([trace.contact.any() and not trace.contact[0] for trace in traces]) >= 0.95


@pytest.mark.parametrize("kind", HARD_OBJECTS)
def test_whiskers_slip_past_are_released_or_meet_both_sides(kind):
    jobs = contact_jobs(3, each=1, objects=[kind])[::2]
    traces = _fast(jobs)
    assert sum(trace.status == "ok" for trace in traces) >= len(jobs) - 1
    pairs = [(job, trace) for job, trace in zip(jobs, traces, strict=True) if trace.status == "ok"]
    assert all(trace.contact.any() for _, trace in pairs)
    if kind in ("slip-off", "release"):
        # Free again before the whisker begins to retract.
        free = []
        for job, trace in pairs:
            peak = np.argmax(job.times > 0.5 / job.follicle.whisking.frequency)
            free.append(not trace.contact[np.argmax(trace.contact) : peak].all())
        assert np.mean(free) >= 0.6
    else:
        # Without the parts behind the whisker its forces are others.
        ahead = [replace(job.obstacles[0], parts=job.obstacles[0].parts[::2]) for job, _ in pairs]
        alone = _fast([replace(job, obstacles=(obstacle,)) for (job, _), obstacle in zip(pairs, ahead, strict=True)])
        changes = [difference(trace, other) for (_, trace), other in zip(pairs, alone, strict=True)]
        assert np.mean(np.array(changes) > 0.05) >= 0.6


def _fast(jobs):
    return get_engine("rod").run(jobs, Fidelity.preset("fast"))


def test_the_difference_is_that_of_force_or_moment_whichever_is_larger():
    wrench = np.tile([3.0, 0, 4.0, 0.1, 0, 0], (5, 1))
    assert difference(_trace(wrench * [1.1, 1, 1.1, 1, 1, 1]), _trace(wrench)) == pytest.approx(0.1)
    assert difference(_trace(wrench * [1, 1, 1, 1.2, 1, 1]), _trace(wrench)) == pytest.approx(0.2)
    assert difference(_trace(wrench, "unstable"), _trace(wrench)) == math.inf


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


@pytest.mark.slow
@pytest.mark.parametrize("name", GATE_WHISKERS)
def test_every_preset_rings_as_the_rod_and_is_damped_as_asked(name):
    whisker = GATE_WHISKERS[name]
    for preset, promise in (("fast", 0.15), ("balanced", 0.03), ("accurate", 0.01)):
        result = ringdown(whisker, fidelity=preset)
        np.testing.assert_allclose(result.frequencies, result.reference_frequencies, rtol=promise)
        np.testing.assert_allclose(result.damping_ratios[0], whisker.damping_ratio, rtol=max(promise, 0.03))


def test_a_short_whisker_rings_as_it_should_at_preset_balanced():
    whisker = GATE_WHISKERS["E5"]
    ring = ringdown(whisker, modes=2, fidelity="balanced")
    np.testing.assert_allclose(ring.frequency_errors, 0, atol=0.05)
    assert ring.frequency_errors[0] == pytest.approx(0, abs=0.03)
    assert ring.damping_ratio == pytest.approx(whisker.damping_ratio, rel=0.03)


def test_modes_are_rung_one_by_one():
    ring = ringdown(C2, modes=2, fidelity=Fidelity(links=20, time_step=5e-5))
    np.testing.assert_allclose(ring.frequencies, ring.reference_frequencies, rtol=0.01)
    assert ring.damping_ratios[1] == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize("fidelity", [Fidelity.preset("balanced"), Fidelity(links=12, time_step=6e-5)])
def test_the_second_mode_at_a_presets_own_step_is_the_rods_as_a_backward_euler_step_shows_it(fidelity):
    ring = ringdown(C2, modes=2, own_step=True, fidelity=fidelity)
    step = fidelity.step(float(ring.reference_frequencies[0]))
    pole = np.log(1 + 2j * np.pi * ring.reference_frequencies[1] * step) / step
    assert ring.frequencies[1] == pytest.approx(abs(pole) / (2 * np.pi), rel=5e-3)
    assert ring.damping_ratios[1] == pytest.approx(max(pole.real / abs(pole), 0.05), rel=0.02)


def test_a_mode_that_a_presets_own_step_cannot_show_is_nan():
    ring = ringdown(C2, modes=3, own_step=True, fidelity="fast")
    assert np.isfinite(ring.frequencies[0])
    assert np.isnan(ring.frequencies[2])


def test_halving_the_time_step_halves_the_error_of_the_ringdown():
    errors = [ringdown(C2, fidelity=Fidelity(links=10, time_step=step)).frequency_error for step in (1e-4, 5e-5)]
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ringdown(replace(C2, damping_ratio=1.5)), r"damping_ratio .*below 1.*received 1\.5"),
        (lambda: ringdown(C2, modes=0), r"modes .*1 and at most 5; received 0"),
    ],
)
def test_impossible_ring_downs_are_refused(call, message):
    with pytest.raises(UsageError, match=message):
        call()
