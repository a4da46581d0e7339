"""What PyBullet's own time step does to a whisker: every way tried to make it an elastic rod, with its error.

Run from the repository root: ``python -m benchmarks.whiskers.bullet_attempts``. Subject: mouse whisker C2, 10 links.
Static: critical damping, a frictionless peg of .25 mm at a/L .5 raised to d/L .1 within 40 ms; error of the base
moment k₀ q₀ against the elastica. Dynamic: damping ratio .15, bent by a tip load and let go; error of the first
frequency against Euler-Bernoulli. Letters: h time step, k and d spring and damper of a joint, M inertia.

- ``explicit``: torques −k q − d v, held over Bullet's step.
- ``stable PD``: the torque that the linearly implicit spring would have without contact, (M + hd + h²k) a =
  −k (q + h v) − d v, torque M a.
- ``added inertia``: explicit torques, and on every link a rotary inertia of twice (h²k + 2hd)/4 of the joints at
  its ends: the least that keeps each spring stable. True augmentation acts on angles between links, which no
  rigid body in the chain can have, so this one makes the whole whisker heavier.
- ``motors``: Bullet's joint motors, which are velocity constraints, told the velocity of the implicit spring.
- ``implicit``: the backend as shipped: Bullet's M, inverse dynamics and closest points, own time step.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from brainbench.stimuli.engines.bullet.model import FOLLICLE, BulletWorld
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle
from brainbench.stimuli.validation import bench_tests, references
from brainbench.stimuli.validation.ringing import fit_decay, ringdown
from brainbench.stimuli.whiskers.chain import build_chain
from brainbench.stimuli.whiskers.whisker import Whisker

C2 = Whisker(0.015265, 48.365e-6, 8.78e-6, young_modulus=5e9, density=(1260.0, 1690.0), damping_ratio=1.0)
AT, OFFSET, RADIUS, LINKS = 0.5 * C2.arc_length, 0.1 * C2.arc_length, 2.5e-4, 10
RISE, END = 0.04, 0.072
RING = 0.02
ATTEMPTS = (
    ("explicit", 1e-5),
    ("explicit", 1e-6),
    ("explicit", 1e-7),
    ("stable PD", 1e-4),
    ("stable PD", 1e-5),
    ("added inertia", 1e-4),
    ("added inertia", 1e-5),
    ("added inertia", 1e-6),
    ("motors", 1e-4),
    ("motors", 1e-5),
)


class Native:
    """The whisker of the backend, stepped by Bullet itself."""

    def __init__(self, method: str, step: float, damping_ratio: float) -> None:
        self.method, self.h = method, step * 1e3
        self.chain = build_chain(replace(C2, damping_ratio=damping_ratio), LINKS)
        self.k = np.repeat(self.chain.stiffness, 2) * 1e6
        # Explicit steps add no damping of their own.
        self.d = np.repeat(self.chain.damping(step if method in ("stable PD", "motors") else 0.0), 2) * 1e9

    def peg(self) -> tuple[float, float]:
        """Relative error of the base moment against the elastica (NaN when unstable) and seconds taken."""
        contact = references.elastica(C2, AT, OFFSET)
        end = np.array(references.peg_centre(C2, contact, RADIUS)) * 1e3
        start = np.array([end[0], -1e3 * (RADIUS + float(C2.radius(end[0] / 1e3)))])
        rod = Obstacle((Capsule((0, 0, -0.015), (0, 0, 0.015), RADIUS),))

        def place(time: float) -> np.ndarray:
            u = min(time / (RISE * 1e3), 1.0)
            return np.array([*(start + u**3 * (10 - 15 * u + 6 * u * u) * (end - start)), 0.0])

        began = time.process_time()
        moments = self._run([rod], np.zeros(2 * LINKS), END, place)
        return moments[-1] / contact.moment - 1, time.process_time() - began

    def ring(self) -> float:
        """Relative error of the first frequency; NaN when unstable."""
        lever = C2.arc_length * (1 - np.arange(LINKS) / LINKS)
        bent = np.zeros(2 * LINKS)
        bent[1::2] = 1e-7 * lever / self.chain.stiffness
        moments = self._run([], bent, RING, None)
        if math.isnan(moments[-1]) or np.abs(moments).max() > 3 * abs(moments[0]):
            return math.nan
        expected = float(references.natural_frequencies(C2, 1)[0])
        times = self.h / 1e3 * np.arange(1, len(moments) + 1)
        return fit_decay(times, moments, expected, 0.15)[0] / expected - 1

    def _run(
        self, obstacles: list[Obstacle], q: np.ndarray, end: float, place: Callable[[float], np.ndarray] | None
    ) -> np.ndarray:
        """Base moments (N·m) after every step, the last NaN when it became unstable."""
        v, moments = np.zeros(2 * LINKS), []
        world = BulletWorld(self.chain, obstacles, 0.0, np.zeros(3))
        # Bullet's own contacts do not know what the backend adds around a cone: let it have plain capsules.
        world._cores[:] = 0.0
        with world:
            self._prepare(world)
            world.place([0.0] * FOLLICLE + q.tolist())
            for n in range(round(end * 1e3 / self.h)):
                if place is not None:
                    world.place_obstacle(0, place((n + 1) * self.h), np.array([1.0, 0, 0, 0]))
                q, v = self._step(world, q, v)
                moments.append(self.k[1] * q[1] * 1e-6)
                if not np.isfinite(q).all() or np.abs(q).max() > 1.5:
                    moments.append(math.nan)
                    break
        return np.array(moments)

    def _prepare(self, world: BulletWorld) -> None:
        b, body = world.bullet, world.whisker
        b.setPhysicsEngineParameter(
            fixedTimeStep=self.h,
            numSubSteps=0,
            numSolverIterations=500,
            solverResidualThreshold=1e-14,
            contactERP=0.2,
        )
        for part in itertools.chain(*world.parts):
            b.changeDynamics(part, -1, lateralFriction=0)
        least = (self.h**2 * self.k + 2 * self.h * self.d)[1::2] / 4
        added = 2 * (least + np.append(least[1:], 0.0)) if self.method == "added inertia" else np.zeros(LINKS)
        for joint in range(FOLLICLE + 2 * LINKS):
            options: dict[str, Any] = {"linearDamping": 0, "angularDamping": 0, "jointDamping": 0, "lateralFriction": 0}
            if joint < FOLLICLE:
                # Bullet has no clamp for a multi-body that we also drive: make it immovable by its inertia.
                options.update(mass=1e9, localInertiaDiagonal=(1e9,) * 3)
            elif joint % 2:
                inertia = self.chain.inertias[(joint - FOLLICLE) // 2] * 1e12
                more = added[(joint - FOLLICLE) // 2]
                options.update(localInertiaDiagonal=(inertia[0], inertia[1] + more, inertia[1] + more))
            b.changeDynamics(body, joint, **options)
        # Every joint is born with a motor that holds it.
        b.setJointMotorControlArray(
            body, range(FOLLICLE + 2 * LINKS), b.VELOCITY_CONTROL, forces=[0.0] * (FOLLICLE + 2 * LINKS),
        )  # fmt: skip

    def _step(self, world: BulletWorld, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        b, body, h = world.bullet, world.whisker, self.h
        joints = range(FOLLICLE, FOLLICLE + 2 * LINKS)
        if self.method in ("explicit", "added inertia"):
            torque = -self.k * q - self.d * v
        else:
            mass = world.mass_matrix([0.0] * FOLLICLE + q.tolist())[FOLLICLE:, FOLLICLE:]
            a = np.linalg.solve(mass + np.diag(h * self.d + h * h * self.k), -self.k * (q + h * v) - self.d * v)
            torque = mass @ a
        if self.method == "motors":
            b.setJointMotorControlArray(
                body, joints, b.VELOCITY_CONTROL, targetVelocities=(v + h * a).tolist(), forces=[1e9] * 2 * LINKS,
            )  # fmt: skip
        else:
            b.setJointMotorControlArray(body, joints, b.TORQUE_CONTROL, forces=torque.tolist())
        b.stepSimulation()
        states = b.getJointStates(body, joints)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])


def show(method: str, step: float, static: float, dynamic: float, cost: float) -> None:
    cells = ["unstable" if math.isnan(error) else f"{error:+.2%}" for error in (static, dynamic)]
    print(f"| {method} | {step * 1e6:g} µs | {cells[0]} | {cells[1]} | {cost:.3g} |", flush=True)


def main() -> None:
    print("| Bullet stepped by | time step | base moment on a peg | first frequency | seconds per whisker-second |")
    print("|---|---|---|---|---|")
    for method, step in ATTEMPTS:
        static, seconds = Native(method, step, 1.0).peg()
        show(method, step, static, Native(method, step, 0.15).ring(), seconds / END)
    for step in (1e-4, 1e-5):
        fidelity = Fidelity(LINKS, time_step=step)
        static = bench_tests.peg(C2, AT, OFFSET, backend="bullet", fidelity=fidelity)
        ringing = ringdown(replace(C2, damping_ratio=0.15), backend="bullet", fidelity=fidelity)
        cost = static.trace.seconds / (static.trace.steps * step)
        show("implicit", step, static.wrench[5] / static.reference[5] - 1, ringing.frequency_error, cost)


if __name__ == "__main__":
    main()
