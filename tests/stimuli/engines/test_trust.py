"""What the engines share: how far things move in a step, and what then cannot be trusted."""

import math
import re
from collections import Counter
from itertools import cycle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.protocol import Job, StillFollicle
from brainbench.stimuli.engines.reach import reachable
from brainbench.stimuli.engines.trust import (
    AT_BASE,
    BENT,
    GOT_INSIDE,
    LOST,
    ONE_BY_ONE,
    STARTED_INSIDE,
    Verdict,
    check_jobs,
    force_change,
    halved,
    judge,
    passed_unseen,
    require_parts,
    residual,
    run_with_retries,
    step_travel,
    strongest_force,
)
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle, Sphere, TriangleMesh
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.factories.trust import facts

WHISKER = Whisker(0.02, 50e-6, 5e-6, young_modulus=4e9, density=1260.0, damping_ratio=0.3)
TIMES = np.linspace(0.0, 0.01, 11)
STILL = StillFollicle().pose(TIMES)
CORNERS = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]])
TETRAHEDRON = TriangleMesh(CORNERS, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32))


def _moving(place, turn=None):
    def motion(times):
        half = np.zeros(len(times)) if turn is None else turn * times / 2
        zero = np.zeros(len(times))
        return np.outer(times, place), np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)

    return motion


def test_the_travel_of_a_step_adds_that_of_the_whisker_and_that_of_the_object():
    position, euler = np.outer(TIMES, [0.1, 0, 0]), np.outer(TIMES, [2.0, 0, 0]) + STILL[1]
    ball = Obstacle((Sphere((5e-3, 0, 0), 1e-3),), _moving((0, 0.3, 0), turn=4.0))
    travel = step_travel(WHISKER, position, euler, ball, TIMES)
    # Per millisecond: base .1 mm, tip 2 rad/s × 20 mm, object .3 mm, its far side at most 4 rad/s × |(6, 1, 1)| mm.
    np.testing.assert_allclose(travel, 1e-3 * (0.1 + 2.0 * 0.02 + 0.3 + 4.0 * 6e-3 * math.sqrt(1 + 2 / 36)), rtol=1e-5)
    still = Obstacle((Sphere((5e-3, 0, 0), 1e-3),))
    np.testing.assert_allclose(step_travel(WHISKER, position, euler, still, TIMES), 1e-4 + 4e-5, rtol=1e-9)


@pytest.mark.parametrize(
    ("obstacle", "thickness"),
    [
        (Obstacle((Capsule((0.01, -0.02, -5e-3), (0.01, -0.02, 5e-3), 2e-4),), _moving((0, 4.0, 0))), 0.5),
        (Obstacle((), _moving((0.0, 4.0, 0)), surface=TETRAHEDRON.moved(np.eye(3), np.array([0.01, -0.02, 0]))), 1.1),
    ],
    ids=["part", "surface"],
)
def test_an_object_that_flies_farther_than_half_its_thickness_may_pass_unfelt(obstacle, thickness):
    job = Job(WHISKER, StillFollicle(), (obstacle,), TIMES[1:])
    reach = reachable(WHISKER, STILL[0], (obstacle,), TIMES, surfaces=True)
    step, reason = passed_unseen(job, reach, *STILL, TIMES)
    assert step < 5
    assert re.search(f"4 mm .* {TIMES[step]:g} s", reason)
    assert f"half of its {thickness:g} mm" in reason
    # Seen only behind its middle, an object that moves on has let go: no force is felt.
    seen_once = np.arange(0.0, 0.01, 0.75e-3 * thickness / 4)
    assert passed_unseen(job, reach, *StillFollicle().pose(seen_once), seen_once)[1]
    fine = np.linspace(0.0, 0.01, 201)
    assert passed_unseen(job, reach, *StillFollicle().pose(fine), fine) == (200, "")


def test_the_force_that_no_whisker_bears_stretches_its_base_by_a_hundredth():
    # .01 E A = .01 × 4e9 Pa × π (50 µm)²; keratin yields at some .02.
    assert strongest_force(WHISKER) == pytest.approx(0.314159, rel=1e-4)


def test_a_surface_without_parts_is_refused_in_words():
    parts = Obstacle((Sphere((0, 0, 0), 1e-3),), surface=TETRAHEDRON)
    require_parts([Job(WHISKER, StillFollicle(), (parts,), TIMES[1:])], "mujoco")
    bare = Obstacle((), surface=TETRAHEDRON)
    with pytest.raises(UsageError, match=r"'mujoco' .* 4 triangles.*'rod'"):
        require_parts([Job(WHISKER, StillFollicle(), (parts, bare), TIMES[1:])], "mujoco")


@pytest.mark.parametrize(
    ("changed", "until", "retryable", "words"),
    [
        ({}, np.inf, False, ""),
        ({"crowded": 2}, np.inf, False, ""),
        ({"status": BENT, "failed": 0.3}, 0.3, True, "a joint bent by more than 1.5 rad"),
        ({"status": LOST, "failed": 0.3}, 0.3, True, "stopped being finite"),
        ({"status": STARTED_INSIDE, "failed": 0.0, "depth": 4e-3}, 0.0, False, "starts 4 mm deep"),
        ({"status": GOT_INSIDE, "failed": 0.3, "depth": 7e-4}, 0.3, True, "0.7 mm deep in an object at 0.3 s"),
        ({"status": AT_BASE, "failed": 0.3}, 0.3, False, "base point, where nothing is felt, at 0.3 s"),
        ({"strength": 31.0, "strong_at": 0.2}, 0.2, False, "reached 31 N, and 30 N stretch"),
        ({"strength": 31.0, "strong_at": 0.2, "status": BENT, "failed": 0.3}, 0.2, True, "stretch the whisker"),
        ({"strength": 31.0, "strong_at": 0.4, "status": BENT, "failed": 0.3}, 0.3, True, "a joint bent"),
        ({"travel": 9e-4, "fast_at": 0.1}, 0.1, False, "moves by 0.9 mm"),
        ({"travel": 9e-4, "fast_at": 0.1, "status": BENT, "failed": 0.3}, 0.1, False, "moves by 0.9 mm"),
        ({"residual": 0.06}, -np.inf, True, "missed by 6%"),
        ({"residual": np.nan}, -np.inf, True, "contact forces missed"),
        ({"crowded": 3}, -np.inf, True, "in 3 of 100 steps"),
        ({"residual": 0.06, "strength": 31.0, "strong_at": 0.2}, 0.2, False, "stretch the whisker"),
    ],
)
def test_what_goes_wrong_first_is_told_and_finer_steps_are_tried_where_they_may_mend_it(
    changed, until, retryable, words
):
    verdict = judge(facts(**changed))
    assert verdict.until.tolist() == [until]
    assert verdict.retryable.tolist() == [retryable]
    assert verdict.unstable.tolist() == [until < np.inf]
    assert words in verdict.reasons[0]
    assert bool(verdict.reasons[0]) == verdict.unstable[0]


def test_the_residual_is_what_changed_last_over_the_forces():
    np.testing.assert_allclose(residual(np.array([0.04, 0.0]), np.array([4.0, 0.0])), [0.1, 0.0])


@pytest.mark.parametrize(
    ("changed", "suspicious"),
    [
        ({}, False),
        ({"peak": 13.0}, True),
        ({"depth": 2.1e-4}, True),
        ({"residual": 0.021}, True),
        ({"residual": 0.06}, False),
        ({"status": BENT, "failed": 0.3, "depth": 3e-4}, False),
    ],
)
def test_whiskers_near_a_limit_are_suspicious_and_those_beyond_it_are_not(changed, suspicious):
    assert judge(facts(**changed)).suspicious.tolist() == [suspicious]


def test_a_force_that_changes_by_a_fifth_with_half_the_step_is_flagged_and_tried_again():
    verdict, which = judge(facts(depth=3e-4)), np.array([True])
    kept = halved(verdict, np.array([0.19]), which)
    assert (kept.unstable.tolist(), kept.suspicious.tolist(), kept.reasons[0]) == ([False], [False], "")
    for change, words in ((0.23, "by 23%"), (np.nan, "beyond what can be trusted")):
        found = halved(verdict, np.array([change]), which)
        assert (found.until.tolist(), found.retryable.tolist()) == ([-np.inf], [True])
        assert words in found.reasons[0]
    assert not halved(verdict, np.array([np.nan]), ~which).unstable.any()
    force = np.zeros((1, 4, 2, 3))
    force[..., 0] = 1.0
    np.testing.assert_allclose(force_change(force, force * [[1.25], [0.8]]), [[0.2, 0.2]])
    assert force_change(force, -force).tolist() == [[2.0, 2.0]]


FINE, SUSPICIOUS, MENDABLE, HOPELESS = range(4)
DIVISORS = [1, 2, 3, 4, 5, 6, 8, 10, 12, 20]
FATES = st.fixed_dictionaries(
    {divisor: st.tuples(st.sampled_from([FINE, SUSPICIOUS, MENDABLE, HOPELESS]), st.booleans()) for divisor in DIVISORS}
)
"""What a whisker comes to with steps over each of these, and which of two forces it has then."""


class _Runs:
    """Whiskers simulated with fates that are known."""

    def __init__(self, fates, finer):
        found = [fate[finer] for fate in fates]
        self.state, self.force = (np.array(values, dtype=int) for values in (zip(*found, strict=True)))
        self.finer, self.steps = np.full(len(fates), finer), np.full(len(fates), 100 * finer)
        bad = self.state >= MENDABLE
        words = np.where(bad, f"bad at {finer}", "").astype(object)
        self.verdict = Verdict(np.where(bad, 0.0, np.inf), self.state == MENDABLE, words, self.state == SUSPICIOUS)

    def _arrays(self):
        return {"force": self.force, "finer": self.finer, "steps": self.steps, **vars(self.verdict)}

    def picked(self, which):
        some = object.__new__(_Runs)
        values = {name: array[which] for name, array in self._arrays().items()}
        some.force, some.finer, some.steps = (values.pop(name) for name in ("force", "finer", "steps"))
        some.verdict = Verdict(**values)
        self.steps[which] = 0
        return some

    def replaced(self, which, finer):
        finer.steps += self.steps[which]
        for name, array in self._arrays().items():
            array[which] = finer._arrays()[name]
        return self

    def compared(self, which, half):
        change = np.full(len(which), np.nan)
        change[which] = np.where(half.verdict.unstable, np.nan, half.force != self.force[which])
        self.verdict = halved(self.verdict, change, which)
        self.steps[which] += half.steps
        return self


def _one_after_the_other(fate, retry):
    """The rule for one whisker, as docs/unstable-whiskers.md tells it: divisor that counts, flagged, simulated."""
    simulated = {1}
    for finer in (1, retry, 2 * retry) if retry > 1 else (1,):
        simulated.add(finer)
        state, force = fate[finer]
        changed = False
        if state == SUSPICIOUS and retry > 1:
            simulated.add(2 * finer)
            half, half_force = fate[2 * finer]
            changed = half >= MENDABLE or half_force != force
        if state != MENDABLE and not changed:
            break
    return finer, state >= MENDABLE or changed, simulated


@pytest.mark.parametrize(
    ("ahead", "most"),
    [
        ([ONE_BY_ONE], 5),
        ([((), ())], 6),
        ([((1,), (2, 4))], 3),
        ([((1, 2), (4,))], 3),
        ([((1, 2, 4), ())], 2),
        # Asked before each try: the device may have become idle or busy meanwhile.
        ([ONE_BY_ONE, ((1,), (2, 4))], 4),
        ([((1,), (2, 4)), ONE_BY_ONE], 4),
    ],
)
@pytest.mark.parametrize("retry", [1, 2, 3, 5])
@given(fates=st.lists(FATES, min_size=1, max_size=6))
def test_tries_at_the_same_time_give_what_tries_one_after_the_other_give(retry, ahead, most, fates):
    seen = Counter()
    launches = []

    def simulate(tries):
        launches.append([finer for _, finer in tries])
        masks = [(np.ones(len(fates), dtype=bool) if which is None else which, finer) for which, finer in tries]
        seen.update((whisker, finer) for which, finer in masks for whisker in np.flatnonzero(which))
        return [
            _Runs([fate for fate, chosen in zip(fates, which, strict=True) if chosen], finer) for which, finer in masks
        ]

    answers = cycle(ahead)
    result = run_with_retries(simulate, retry, ahead=lambda: next(answers))
    expected = [_one_after_the_other(fate, retry) for fate in fates]
    assert result.finer.tolist() == [finer for finer, *_ in expected]
    assert result.verdict.unstable.tolist() == [bool(reason) for reason in result.verdict.reasons]
    assert result.verdict.unstable.tolist() == [unstable for _, unstable, _ in expected]
    # Steps are those of the tries that the rule asks for, however many there were.
    assert result.steps.tolist() == [100 * sum(simulated) for *_, simulated in expected]
    needed = {(whisker, finer) for whisker, (*_, simulated) in enumerate(expected) for finer in simulated}
    # Nothing is simulated twice; without tries ahead, nothing that is not needed.
    assert set(seen.values()) == {1}
    assert needed <= set(seen)
    assert most < 5 or needed == set(seen)
    assert len(launches) <= most


def test_an_engine_whose_whiskers_only_bend_refuses_twist():
    jobs = [Job(WHISKER, StillFollicle(), (), TIMES[1:])]
    engine = get_engine("bullet")
    check_jobs(engine, jobs, Fidelity(), None)
    check_jobs(engine, jobs, Fidelity(twist=False), None)
    with pytest.raises(UsageError, match=r"'bullet'.*'rod'"):
        check_jobs(engine, jobs, Fidelity(twist=True), None)
