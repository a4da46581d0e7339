"""Every force carries its error: estimates against the elastica and finer simulations, promises, damping."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from brainbench.stimuli import Fidelity, WhiskerArray
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.error_estimates import (
    CALM,
    SLOW,
    calm_error,
    changes,
    difference,
    halved_step,
    lateness,
    more_links,
    with_errors,
)
from brainbench.stimuli.engines.fidelity import list_presets
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle, Trace
from brainbench.stimuli.motion.trajectories import ArrayFollicle, Translation, Whisking
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle, Sphere
from brainbench.stimuli.objects.solid import PlacedObject, sphere
from tests.factories.contact_scenes import HARD_OBJECTS, contact_jobs
from tests.factories.engine_scenes import C2

RAT = replace(WhiskerArray.of("rat")["C2"].whisker, curvature=0.0, friction=0.0)
TIMES = np.arange(1, 101) * 1e-3
HELD = np.array([-2.26e-5, -8.59e-5])
"""Base force (N) of the elastica between :func:`_opposed_posts`, turned by .3 rad."""


def _opposed_posts():
    """Two frictionless posts, 2 mm apart on opposite sides of a straight whisker, that turn together by .3 rad."""
    middle, radius = RAT.arc_length / 2, 1e-4
    offset = float(RAT.radius(middle)) + 5e-5 + radius

    def post(side):
        def motion(times):
            share = np.clip(np.asarray(times, float) / 0.04, 0, 1)
            turn = 0.3 * share**3 * (10 - 15 * share + 6 * share**2)
            x, y = side * 1e-3, -side * offset
            place = middle + np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, 0 * turn
            return np.stack(place, axis=1), np.tile([1.0, 0, 0, 0], (len(turn), 1))

        motion.finest = 0.04
        return Obstacle((Capsule((0, 0, -4e-3), (0, 0, 4e-3), radius),), motion, 0.0)

    return Job(RAT, StillFollicle(), (post(-1), post(1)), TIMES)


def _trace(error=0.0, **values):
    wrench = np.full((len(TIMES), 6), 1e-4) * (1 + error)
    return Trace(wrench, np.ones(len(TIMES), bool), np.full(len(TIMES), 0.01), steps=1, **values)


def _difference(values, reference, contact, length):
    return difference(values[None], reference[None], contact[None], np.array([length]))[0]


@pytest.mark.parametrize("preset", ["fast", "balanced"])
def test_a_whisker_between_opposed_posts_carries_an_error_no_smaller_than_the_elastica_says(preset):
    (trace,) = get_engine("rod", errors=True).run(
        [_opposed_posts()], Fidelity.parse(f"{preset},contact_line=links"), workers=1
    )
    off = np.linalg.norm(trace.wrench[-1, :2] - HELD) / np.linalg.norm(HELD)
    assert off <= trace.error
    assert trace.status == "ok"
    assert f"an error of {trace.error:.0%}" in trace.remark
    assert "or auto=ERROR" in trace.remark
    assert np.isfinite(trace.wrench).all()


@pytest.mark.slow
def test_estimates_cover_the_error_of_contacts_of_all_kinds():
    kinds = (*HARD_OBJECTS, "post", "hollow")
    jobs = contact_jobs(3, each=1, objects=kinds)[::3]
    finest = Fidelity(links=40, time_step=1e-5, precision="double", contact_tolerance=1e-9)
    references = get_engine("rod").run(jobs, finest)
    traces = get_engine("rod", errors=True).run(jobs, Fidelity.of("balanced"))
    covered = []
    for job, trace, reference in zip(jobs, traces, references, strict=True):
        if trace.status == reference.status == "ok" and reference.contact.any():
            touching = trace.contact | reference.contact
            true = _difference(trace.wrench, reference.wrench, touching, job.whisker.arc_length).max()
            covered.append(true <= trace.error)
    assert len(covered) >= 20
    assert np.mean(covered) >= 0.85


def test_half_the_step_and_more_links_each_count_by_the_order_of_their_error():
    job = Job(C2, StillFollicle(), (), TIMES)
    fidelity = Fidelity(links=10, time_step=1e-4)

    def run(jobs, setting):
        error = 0.0 if setting == fidelity else 0.01 if setting.links == 10 else -0.02
        return [_trace(error) for _ in jobs]

    (trace,) = with_errors(run, [job], fidelity, run)
    assert trace.error == pytest.approx(np.hypot(2 * 0.01 / 1.01, 3 * 0.02 / 0.98))
    assert (trace.status, trace.remark) == ("ok", "")
    (trace,) = with_errors(run, [job], replace(fidelity, links=10, contact_tolerance=1e-4), run)
    assert trace.error != 0


def test_a_whisker_whose_finer_simulation_fails_has_a_remark_without_a_number():
    def run(jobs, setting):
        return [_trace(status="ok" if setting.links == 10 else "unstable") for _ in jobs]

    (trace,) = with_errors(run, [Job(C2, StillFollicle(), (), TIMES)], Fidelity(links=10), run)
    assert trace.error == np.inf
    assert "cannot be told" in trace.remark


def test_a_whisker_that_needed_no_step_has_no_error():
    still = Trace(np.zeros((100, 6)), np.zeros(100, bool), np.full(100, np.nan), steps=0)

    def run(jobs, setting):
        return [still]

    (trace,) = with_errors(run, [Job(C2, StillFollicle(), (), TIMES)], Fidelity(links=10), run)
    assert trace.error == 0


def test_half_the_step_is_half_where_a_blow_cuts_it_too():
    """A ball strikes a short whisker, and steps are cut to .25 mm of its way, whatever step was asked for."""
    whisker = WhiskerArray.of("mouse")["E5"].whisker
    velocity, radius = np.array([0.0, 1.5, 0.0]), 2e-3
    middle = np.append(whisker.centre_line(0.6 * whisker.arc_length), 0.0)
    start = middle - velocity * ((radius + whisker.base_radius) / 1.5 + 2.3e-3)
    ball = PlacedObject(sphere(radius), tuple(start), motion=Translation(tuple(velocity), 0), friction=0.0).obstacle()
    job = Job(whisker, StillFollicle(), (ball,), np.arange(1, 21) * 1e-3)
    fidelity = Fidelity(links=10, time_step=5e-4, contact_tolerance=1e-6, contact_line="links")
    half = halved_step(fidelity, whisker, job.spacing)
    asked = [fidelity, half, replace(half, contact_travel=fidelity.contact_travel), replace(half, time_step=1e-5)]
    engine = get_engine("rod", retry=1)
    trace, halved, uncut, finest = (engine.run([job], setting, workers=1)[0] for setting in asked)

    def change(finer):
        touching = trace.contact | finer.contact
        return _difference(trace.wrench, finer.wrench, touching, whisker.arc_length).max()

    assert 2 * change(halved) > change(finest) > 0.03
    assert 2 * change(uncut) < 0.01


def test_finer_simulations_begin_with_the_steps_that_counted():
    settings = []

    def run(jobs, setting):
        return [_trace(divisor=5) for _ in jobs]

    def once(jobs, setting):
        settings.append((setting.links, setting.time_step, setting.steps_per_period))
        return [_trace() for _ in jobs]

    job = Job(replace(C2, damping_ratio=0.5), StillFollicle(), (), TIMES)
    (trace,) = with_errors(run, [job], Fidelity(links=10, time_step=1e-4, steps_per_period=30), once)
    np.testing.assert_allclose(settings, [(10, 1e-5, 300), (15, 2e-5, 150)])
    assert trace.error == 0


def test_a_promise_makes_only_those_finer_that_need_it():
    jobs = [Job(C2, StillFollicle(), (), TIMES), Job(RAT, StillFollicle(), (), TIMES)]
    counts = []

    def run(some, setting):
        counts.extend((job.whisker == RAT, setting.links) for job in some)
        return [_trace(1 / setting.links if job.whisker == RAT else 0.0) for job in some]

    plain, refined = with_errors(run, jobs, Fidelity(links=10, error=0.05), run)
    assert plain.error == 0
    assert 0 < refined.error <= 0.05
    assert (refined.remark, max(links for rat, links in counts if not rat)) == ("", 15)
    assert max(links for rat, links in counts if rat) > 30


def test_the_finer_run_of_an_estimate_is_the_next_to_be_judged():
    runs = []

    def run(jobs, setting):
        runs.append(setting)
        return [_trace({10: 0.0, 15: 0.2, 23: 0.25}.get(setting.links, 0.26)) for _ in jobs]

    (trace,) = with_errors(run, [Job(C2, StillFollicle(), (), TIMES)], Fidelity(links=10, error=0.05), run)
    assert trace.error == pytest.approx(3 * 0.01 / 1.26)
    assert (trace.wrench == _trace(0.25).wrench).all()
    # None is made twice.
    assert [setting.links for setting in runs] == [10, 10, 15, 15, 23, 23, 35]


def test_where_no_run_is_good_enough_the_forces_are_those_of_the_best():
    def run(jobs, setting):
        # More links in the same steps make it worse.
        return [_trace({10: 0.0, 15: 0.1, 23: 0.6, 35: 1.2, 53: 2.4}.get(setting.links, 5.0)) for _ in jobs]

    (trace,) = with_errors(run, [Job(C2, StillFollicle(), (), TIMES)], Fidelity(links=10, error=0.05), run)
    # The worst changes it by more than its own estimate, 27 %.
    assert trace.error == pytest.approx(2.4 / 3.4)  # the last
    np.testing.assert_array_equal(trace.wrench, _trace().wrench)
    assert "an error of 71%" in trace.remark


def test_what_changes_where_contact_begins_or_ends_counts_by_the_root_of_the_step():
    contact = np.array([[False, False, True, True, True, True, False, False]])
    values = np.zeros((8, 1, 8, 6))
    values[:, 0, 2:6, 0] = 1e-3
    finer = values.copy()
    for reading in range(8):
        finer[reading, 0, reading, 0] += 1e-6
    told = [changes(values[k], finer[k], contact, np.array([0.01]))[0] for k in range(8)]
    # Readings without contact count by their share of all.
    plain = 1e-3 / np.sqrt(4) * np.ones(8)
    np.testing.assert_allclose(told, plain * [1, 1.7, 1.7, 1, 1, 1.7, 1.7, 1], rtol=1e-2)


def test_a_touch_may_come_half_a_step_earlier():
    """Half the step changes nothing here, as where neither shows the wave that runs through a whisker from a touch."""
    contact = np.arange(8)[None] >= 3
    values = np.zeros((1, 8, 6))
    values[0, :, 5] = np.where(contact[0], [0, 0, 0, 2e-6, 6e-6, 6e-6, 6e-6, 6e-6], 0)
    fidelity = Fidelity(links=10, time_step=5e-4)
    shifts = [lateness(replace(fidelity, time_step=step), C2, 1e-3) for step in (2e-3, 5e-4, 1e-4)]
    np.testing.assert_allclose(shifts, [0.5, 0.25, 0.05])
    told = [changes(values, values, contact, np.array([0.01]), shift)[0] for shift in (0.0, *shifts)]
    # Beside the touch are the last reading before, whose moment changes by 2e-6 to the next, and the first.
    plain = 1.7 * np.hypot(2e-6, 4e-6) / np.sqrt(2**2 + 4 * 6**2) / 1e-6
    np.testing.assert_allclose(told, plain * np.array([0, *shifts]), rtol=1e-6)


def test_differences_are_relative_above_a_nanonewton_and_of_force_or_moment():
    wrench = np.zeros((4, 6))
    wrench[:, 0], wrench[:, 5] = 1e-3, 1e-6
    ringing = wrench * np.array([1.1, 1, 1, 1, 1, 1.2])
    contact = np.ones(4, bool)
    np.testing.assert_allclose(_difference(ringing, wrench, contact, 0.01), [0.1, 0.2])
    np.testing.assert_allclose(_difference(1e-8 * ringing, 1e-8 * wrench, contact, 0.01), [1e-3, 2e-4], rtol=1e-6)
    # What rings after the contact counts too.
    ringing[2:, 0] = 2e-3
    assert _difference(ringing, wrench, np.array([True, True, False, False]), 0.01)[0] > 0.5


def test_a_whisker_in_air_that_follows_its_base_needs_no_further_simulation():
    mount = WhiskerArray.of("mouse")["C2"]
    slow, fast = Whisking(8.0, 0.2, 0.2), Whisking(SLOW * 200, 0.2, 0.2)
    whisking = Job(mount.whisker, ArrayFollicle(mount, slow, finest=slow.finest), (), TIMES)
    silent = Trace(np.zeros((100, 6)), np.zeros(100, bool), np.full(100, np.nan), steps=1)
    assert calm_error(whisking, silent, Fidelity(links=10)) == CALM / 100
    shaken = replace(whisking, follicle=ArrayFollicle(mount, fast, finest=fast.finest))
    # The law of the links was measured on the shapes of rats and mice.
    coil = replace(mount.whisker, curvature=0.0, bends=((0.0, 300.0, 0.0), (mount.whisker.arc_length, 300.0, 0.0)))
    others = {"loads": (Load(0.01, (0, 1e-6, 0)),)}, {"gravity": (0, 0, -9.8)}, {"whisker": coil}
    for job in (shaken, *(replace(whisking, **change) for change in others)):
        assert np.isnan(calm_error(job, silent, Fidelity(links=10)))


def test_finer_settings_halve_the_step_that_readings_leave_and_add_half_of_the_links():
    job = Job(replace(C2, damping_ratio=0.1), StillFollicle(), (), np.arange(1, 5) * 2e-5)
    fast = Fidelity.preset("fast")
    half = halved_step(fast, job.whisker, job.spacing)
    assert half.time_step == pytest.approx(1e-5)
    assert half.steps_per_period == pytest.approx(2 * np.pi / 0.1)
    assert more_links(fast, C2).link_count(C2.arc_length) == 12
    assert more_links(Fidelity(links=90), C2).links == 60


def test_a_still_touch_is_no_error_however_its_overlap_was_undone():
    middle = RAT.arc_length / 2
    place = (middle, 5e-6 - 1e-3 - float(RAT.radius(middle)), 0)
    job = Job(RAT, StillFollicle(), (Obstacle((Sphere(place, 1e-3),), None),), np.arange(1, 61) * 1e-3)
    (trace,) = get_engine("rod", errors=True).run([job], Fidelity.of("balanced"))
    assert trace.status == "ok"
    assert trace.contact.any()
    assert trace.error < 0.1
    assert not trace.remark


@pytest.mark.parametrize("preset", list_presets())
@pytest.mark.parametrize("species", ["mouse", "rat"])
def test_presets_keep_the_damping_that_was_measured_at_any_cadence(preset, species):
    for mount in list(WhiskerArray.of(species))[::4]:
        for ratio in (0.05, 0.11, 0.17):
            whisker = replace(mount.whisker, damping_ratio=ratio)
            for spacing in (1e-5, 2.5e-4, 1e-3):
                job = Job(whisker, StillFollicle(), (), np.arange(1, 9) * spacing)
                assert Fidelity.of(preset).damping_of(job) == pytest.approx(ratio, rel=0.02)


@pytest.mark.parametrize("spacing", [2.8e-4, 2e-5])
def test_a_short_whisker_rings_with_the_damping_that_it_was_given(spacing):
    whisker = replace(WhiskerArray.of("mouse")["A4"].whisker, curvature=0.0, damping_ratio=0.11)
    loads = (Load(whisker.arc_length, (0.0, 1e-7, 0.0), stop=0.01),)
    times = np.arange(0.01 + spacing, 0.016, spacing)
    (trace,) = get_engine("rod").run([Job(whisker, StillFollicle(), (), times, loads=loads)], Fidelity.of("fast"))
    size = np.abs(trace.wrench[:, 5])
    # A swing loses e^(−ζ ω t); the largest readings of two windows, ten milliseconds of which hold seven periods.
    first, second = (size[(times > start) & (times <= start + 1.41e-3)].max() for start in (0.0105, 0.01332))
    assert np.log(first / second) / (2 * np.pi * 710 * 2.82e-3) == pytest.approx(0.11, rel=0.15)


def test_steps_that_damp_too_much_are_warned_of_and_stored(caplog):
    job = Job(replace(C2, damping_ratio=0.1), StillFollicle(), (), TIMES, loads=(Load(0.01, (0, 1e-6, 0)),))
    with caplog.at_level(logging.WARNING, "brainbench.stimuli.engines.fidelity"):
        (held,) = get_engine("rod", errors=True).run([job], Fidelity.of("fast"))
        assert not caplog.records
        (lost,) = get_engine("rod", errors=True).run([job], Fidelity(links=8, time_step=1e-3))
    assert held.damping == pytest.approx(0.1, rel=0.02)
    assert lost.damping == pytest.approx(0.58, rel=0.05)
    assert "with ratio 0.5" in caplog.text
