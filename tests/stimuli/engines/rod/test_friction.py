"""Friction of ``rod`` beside a differential equation with penalty contact and viscous creep, solved by SciPy's BDF."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.mujoco import build_model, engine
from brainbench.stimuli.engines.reach import Reach
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Cylinder, Obstacle, Sphere
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import Whisker, build_chain
from tests.factories.contact_scenes import contact_jobs, difference

SPEED = 0.03
"""Of the object (m/s), a brisk sweep of the recipes."""
STIFFNESS, RELAXATION, CREEP = 200.0, 1e-2, 1e-5
"""Of a contact: stiffness (N/m), relaxation time (ms), and the slip (m/s) below which friction is viscous."""
SCALE = np.repeat([1e-3, 1e-6], 3)
"""Newtons and newton metres of the reference's units (mg, mm, ms)."""
SLIPPED, FELT, FLICK = 0.2, 5e-3, 200_000
"""A whisker slips off where its contact force falls to this share of the last reading's, if that was above so much
(mN); or flicks and bounces, where a millisecond needs more evaluations than this."""


@dataclass(frozen=True)
class Passing:
    """A round object that passes a still whisker from the side: a ball, or a long cylinder about ``axis``."""

    whisker: Whisker
    start: tuple[float, float, float]
    """Its middle at the start (m, world)."""
    radius: float
    axis: tuple[float, float, float] | None
    friction: float

    @classmethod
    def of(cls, whisker: Whisker, shape: str, friction: float) -> Passing:
        """A tilted peg at three quarters of the whisker, or a ball beside its outer part that it slides up on."""
        length = whisker.arc_length
        x, y = whisker.centre_line(np.array([0.85 * length]))[0]
        if shape == "ball":
            return cls(whisker, (float(x) + 0.08 * length, float(y) - 3.5e-3, 0.8e-3), 3e-3, None, friction)
        tilted = (0.3 / np.sqrt(1.09), 0.0, 1 / np.sqrt(1.09))
        return cls(whisker, (0.75 * length, float(y) - 2e-3, 0.0), 0.5e-3, tilted, friction)

    def job(self, duration: float) -> Job:
        """The same for an engine, read every millisecond of ``duration`` (s)."""
        if self.axis is None:
            part: Any = Sphere((0.0, 0.0, 0.0), self.radius)
        else:
            end = np.multiply(self.axis, 0.05)
            part = Cylinder(tuple(-end), tuple(end), self.radius)

        def motion(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return self.start + np.outer(times, (0.0, SPEED, 0.0)), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

        obstacle = Obstacle(parts=(part,), friction=self.friction, motion=motion)
        return Job(self.whisker, StillFollicle(), (obstacle,), times=np.arange(0.0, duration, 1e-3))


class Penalty:
    """The reference for one passing; units mg, mm, ms, mN, µN m."""

    def __init__(
        self,
        passing: Passing,
        links: int,
        stiffness: float = STIFFNESS,
        relaxation: float = RELAXATION,
        creep: float = CREEP,
    ) -> None:
        mujoco = self._mujoco = engine()
        chain = build_chain(passing.whisker, links)
        bare = Job(passing.whisker, StillFollicle(), (), times=np.zeros(1))
        # The damping that a step would add vanishes with the step.
        self._model = build_model(bare, chain, Reach((), np.inf), 1e-12, np.array([0.0, 1e-9])).model
        self._model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        self._data = mujoco.MjData(self._model)
        self._links = np.arange(self._model.nbody)[-links:]
        self._lengths, self._radii = 1e3 * chain.lengths, 1e3 * passing.whisker.radius(chain.nodes)
        self._start, self._radius = 1e3 * np.array(passing.start), 1e3 * passing.radius
        self._axis = None if passing.axis is None else np.array(passing.axis)
        self._friction, self.size = passing.friction, 4 * links
        self._stiffness, self._relaxation, self._creep = stiffness, relaxation, creep
        self._velocity = np.array([0.0, SPEED, 0.0])
        self.calls = 0

    def rate(self, now: float, state: np.ndarray) -> np.ndarray:
        """Time derivative of hinge angles and rates."""
        self.calls += 1
        model, data = self._model, self._data
        spins = self._set(state)
        data.qfrc_applied[:] = 0
        for link, point, force in self._contacts(now, *spins):
            self._mujoco.mj_applyFT(model, data, force, np.zeros(3), point, self._links[link], data.qfrc_applied)
        self._mujoco.mj_fwdActuation(model, data)
        self._mujoco.mj_fwdAcceleration(model, data)
        return np.concatenate([state[model.nv :], data.qacc_smooth])

    def jacobian(self, now: float, state: np.ndarray) -> np.ndarray:
        """Its derivative by central differences; one-sided ones let BDF crawl."""
        shifts = 1e-7 * np.eye(self.size)
        columns = [self.rate(now, state + shift) - self.rate(now, state - shift) for shift in shifts]
        return np.array(columns).T / 2e-7

    def pressed(self, now: float, state: np.ndarray) -> float:
        """Sum of the contact forces (mN)."""
        return float(sum(np.linalg.norm(force) for *_, force in self._contacts(now, *self._set(state))))

    def wrench(self, now: float, state: np.ndarray) -> np.ndarray:
        """Force and moment [6] of the whisker on its base: what presses on it less its rate of momentum."""
        contacts = self._contacts(now, *self._set(state))
        total = np.zeros(6)
        for _, point, force in contacts:
            total += np.concatenate([force, np.cross(point, force)])
        step = 1e-6 * self.rate(now, state)
        return total - (self._momentum(state + step) - self._momentum(state - step)) / 2e-6

    def _set(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angular velocities [N, 3] of the links and velocities [N, 3] of their joints."""
        model, data = self._model, self._data
        data.qpos[:], data.qvel[:] = state[: model.nv], state[model.nv :]
        self._mujoco.mj_fwdPosition(model, data)
        self._mujoco.mj_fwdVelocity(model, data)
        spin, about = data.cvel[self._links, :3], data.subtree_com[model.body_rootid[self._links[0]]]
        return spin, data.cvel[self._links, 3:] + np.cross(spin, data.xpos[self._links] - about)

    def _contacts(self, now: float, spin: np.ndarray, velocity: np.ndarray) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """(link, point, force on it) where a link overlaps the object."""
        joints = self._data.xpos[self._links]
        along = self._data.xmat[self._links].reshape(-1, 3, 3)[:, :, 0]
        to_middle, across = self._start + self._velocity * now - joints, along
        if self._axis is not None:
            to_middle = to_middle - np.outer(to_middle @ self._axis, self._axis)
            across = along - np.outer(along @ self._axis, self._axis)
        reach = np.einsum("ij,ij->i", to_middle, across) / np.einsum("ij,ij->i", across, across)
        reach = np.clip(reach, 0.0, self._lengths)
        share = reach / self._lengths
        thick = self._radii[:-1] * (1 - share) + self._radii[1:] * share
        away = reach[:, None] * across - to_middle
        distance = np.linalg.norm(away, axis=1)
        gap = distance - self._radius - thick
        found = []
        for i in np.flatnonzero(gap < 0).tolist():
            normal = away[i] / distance[i]
            point = joints[i] + reach[i] * along[i] - thick[i] * normal
            moving = velocity[i] + np.cross(spin[i], point - joints[i]) - self._velocity
            closing = moving @ normal
            press = -self._stiffness * (gap[i] + self._relaxation * closing)
            if press > 0:
                slip = moving - closing * normal
                drag = self._friction * press / np.sqrt(slip @ slip + self._creep**2)
                found.append((i, point, press * normal - drag * slip))
        return found

    def _momentum(self, state: np.ndarray) -> np.ndarray:
        """Linear and angular momentum [6] about the base."""
        spin, velocity = self._set(state)
        model, data = self._model, self._data
        middle = data.xipos[self._links]
        linear = model.body_mass[self._links, None] * (velocity + np.cross(spin, middle - data.xpos[self._links]))
        frames = data.ximat[self._links].reshape(-1, 3, 3)
        own = np.einsum("nij,nj,nkj,nk->ni", frames, model.body_inertia[self._links], frames, spin)
        return np.concatenate([linear.sum(axis=0), (np.cross(middle, linear) + own).sum(axis=0)])


def solve(penalty: Penalty, duration: float, tolerance: float = 1e-5) -> tuple[np.ndarray, np.ndarray]:
    """Readings [n] (s) every millisecond until the whisker slips off, and the wrench [n, 6] (N, N m) on its base."""
    from scipy.integrate import BDF

    half = penalty.size // 2
    least = np.concatenate([np.full(half, 1e-2 * tolerance), np.full(half, tolerance)])
    options = {"rtol": tolerance, "atol": least, "max_step": 0.25, "first_step": 1e-3, "jac": penalty.jacobian}
    solver = BDF(penalty.rate, 0.0, np.zeros(penalty.size), 1e3 * duration, **options)
    times, found, pressed, calls = [0.0], [np.zeros(6)], [0.0], 0
    while solver.status == "running":
        solver.step()
        dense = solver.dense_output()
        while len(times) <= solver.t and len(times) < 1e3 * duration:
            now = float(len(times))
            found.append(penalty.wrench(now, dense(now)))
            times.append(now)
            pressed.append(penalty.pressed(now, dense(now)))
            calls = penalty.calls
        slipped = pressed[-1] > FELT and penalty.pressed(solver.t, solver.y) < SLIPPED * pressed[-1]
        if slipped or penalty.calls - calls > FLICK:
            break
    return 1e-3 * np.array(times), SCALE * np.array(found)


def misses(found: np.ndarray, truth: np.ndarray) -> list[float]:
    """Per cent of the peak, of force and moment: difference of the peaks, median reading, root mean square."""
    parts = slice(0, 3), slice(3, 6)
    return [
        100 * float(value[0]) for part in parts for value in differences(found[None, :, part], truth[None, :, part])
    ]


def differences(found: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each whisker's own peak [whisker]: of the peaks, of the median reading in contact, root mean square.

    Args:
        found, truth: forces or moments [whisker, reading, 3].
    """
    size, other = (np.linalg.norm(values, axis=-1) for values in (truth, found))
    peak = np.maximum(size.max(axis=1), 1e-30)
    miss = np.linalg.norm(found - truth, axis=-1) / peak[:, None]
    touching = size > 0.05 * peak[:, None]
    touching |= ~touching.any(axis=1, keepdims=True)
    readings = np.array([np.median(row[row_on]) for row, row_on in zip(miss, touching, strict=True)])
    return np.abs(other.max(axis=1) / peak - 1), readings, np.sqrt((miss**2).mean(axis=1))


LINKS = 6


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "duration"), [("peg", 0.2), ("ball", 0.15)])
def test_a_whisker_dragged_over_something_rough_feels_what_the_differential_equation_says(shape, duration):
    passing = Passing.of(WhiskerArray.mouse()["C2"].whisker, shape, 0.48)
    times, truth = solve(Penalty(passing, LINKS), duration)
    # The equation is that of straight links.
    fidelity = Fidelity(links=LINKS, time_step=1e-4, contact_line="links")
    trace = get_engine("rod").run([passing.job(duration)], fidelity)[0]
    assert len(times) > 100
    assert np.linalg.norm(truth[-1, :3]) > 1e-5
    # Per cent of the peak: difference of the peaks, median reading, root mean square; force, then moment.
    assert np.all(np.array(misses(trace.wrench[: len(truth)], truth)) < 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("backend", "left"), [("rod", 1e-4), ("mujoco", 1e-3)])
def test_contact_forces_are_as_exact_as_is_asked_for(backend, left):
    engine = get_engine(backend)
    jobs = [job for job in contact_jobs(5, each=1) if job.obstacles[0].friction == 0.8 and len(job.times) < 200]
    jobs = jobs[:: 4 if backend == "rod" else 2]
    if backend == "mujoco":  # loses more friction, and says so
        jobs = [replace(job, obstacles=tuple(replace(item, friction=0.2) for item in job.obstacles)) for job in jobs]
    fidelity = Fidelity(links=12, time_step=1e-4, precision="double")
    runs = [engine.run(jobs, replace(fidelity, contact_tolerance=tolerance)) for tolerance in (None, 1e-6, 1e-10)]
    # Soft contacts throw one of the whiskers about, which the engine says.
    trusted = [row for row in zip(*runs, strict=True) if {trace.status for trace in row} == {"ok"}]
    assert len(trusted) >= 3
    few, asked, solved = zip(*trusted, strict=True)
    assert max(map(difference, few, solved)) > 0.01
    assert max(map(difference, asked, solved)) < left


def test_steps_whose_contact_forces_were_not_solved_are_counted():
    jobs = [job for job in contact_jobs(5, each=1) if len(job.times) < 200][::4]
    runs = [get_engine("rod").run(jobs, Fidelity(links=12, contact_tolerance=tolerance)) for tolerance in (None, 1e-5)]
    rough = np.array([job.obstacles[0].friction > 0 for job in jobs])
    few, solved = (np.array([trace.unsolved / max(1, trace.steps) for trace in traces]) for traces in runs)
    assert few[~rough].max() < 1e-3 < few[rough].mean()
    assert solved.max() < 0.1 * few[rough].mean()
