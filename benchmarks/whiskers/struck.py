"""Whiskers that objects strike, and whiskers on rough objects in soft contacts: what is wrong, and what is found.

``python -m benchmarks.whiskers.struck [--whiskers 400] [--speeds 1.05,1.5,2,2.9] [--fidelity balanced]``
``python -m benchmarks.whiskers.struck --soft 2 --fidelity balanced``
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from unittest.mock import patch

import numpy as np

from benchmarks.report import table
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.engines.trust import LARGEST_CHANGE, LARGEST_STRUCK_CHANGE, force_change
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.objects.solid import box, capsule, sphere
from brainbench.stimuli.validation.bench_tests import FRICTIONS, contact_jobs, difference
from brainbench.stimuli.whiskers.array import SPECIES, WhiskerArray

Array = np.ndarray


def struck_jobs(seed: int, count: int, speed: float) -> list[Job]:
    """Return whiskers at rest that a post, a ball or a box strikes from a random side, with and without friction."""
    rng, jobs = np.random.default_rng(seed), []
    arrays = [WhiskerArray.of(species).mounts for species in SPECIES]
    for k in range(count):
        whisker = arrays[k % 2][rng.integers(len(arrays[k % 2]))].whisker
        size = whisker.arc_length / 0.02 * rng.uniform(1, 2)
        kinds = capsule(4e-4 * size, 0.03), sphere(2e-3 * size), box((3e-3 * size, 3e-3 * size, 3e-3 * size))
        which = rng.integers(3)
        solid, half = kinds[which], (4e-4, 2e-3, 2.7e-3)[which] * size
        tilt = rng.uniform(-0.4, 0.4)
        way = np.array([math.sin(tilt) / 2, rng.choice([-1, 1]) * math.cos(tilt), rng.uniform(-0.5, 0.5)])
        way = speed * way / np.linalg.norm(way)
        place = np.append(whisker.centre_line(rng.uniform(0.4, 0.85) * whisker.arc_length), 0.0)
        # It is there after 2.3 ms.
        start = place - way * ((half + whisker.base_radius) / speed + 2.3e-3)

        def motion(
            times: np.ndarray, start: np.ndarray = start, way: np.ndarray = way
        ) -> tuple[np.ndarray, np.ndarray]:
            return start + times[:, None] * way, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

        motion.finest = math.inf  # type: ignore[attr-defined]
        obstacle = Obstacle(solid.parts, friction=float(rng.choice([0.0, 0.4])), surface=solid.surface, motion=motion)
        times = np.arange(1e-3, max(0.03, 0.01 / speed), 1e-3)
        jobs.append(Job(whisker, StillFollicle(), (obstacle,), times))
    return jobs


def struck(speed: float, count: int, fidelity: Fidelity) -> list[str]:
    """Return a row: errors of one run, of those that stay ``ok``, and what changes with shorter steps."""
    jobs, alone = struck_jobs(1, count, speed), RodEngine(retry=1)
    fine = {"steps_per_period": None, "precision": "double", "contact_tolerance": 1e-8}
    reference = alone.run(jobs, replace(fidelity, time_step=1e-6 if speed > 1 else 2e-6, **fine))
    once, judged = alone.run(jobs, fidelity), RodEngine().run(jobs, fidelity)
    step, period = fidelity.time_step, fidelity.steps_per_period or 4
    half, fifth = (alone.run(jobs, replace(fidelity, time_step=step / k, steps_per_period=k * period)) for k in (2, 5))
    some = [k for k, one in enumerate(reference) if one.status == "ok" and np.abs(one.wrench).max() > 1e-9]
    error, left = (np.array([difference(one[k], reference[k]) for k in some]) for one in (once, judged))
    wrong, found = error > LARGEST_CHANGE, []
    for other in (half, fifth):
        pairs = [[one[k].wrench[None, :, None, :3] for one in (once, other)] for k in some]
        changed = np.array([not force_change(*pair)[0, 0] <= LARGEST_STRUCK_CHANGE for pair in pairs])
        found.append(f"{(changed & wrong).sum()} and {(changed & ~wrong).sum()}")
    good = np.isfinite(left)
    return [f"{speed:g}", f"{len(some)}", f"{np.median(error):.1%}", f"{wrong.sum()}", *found, f"{(~good).sum()}",
            f"{(left[good] > LARGEST_CHANGE).sum()}"]  # fmt: skip


def soft(each: int, fidelity: Fidelity) -> list[list[str]]:
    """Return rows for each friction: what ``mujoco`` misses beside a converged ``rod``, by whiskers flagged or not."""
    jobs, engine = contact_jobs(21, each=each), get_engine("mujoco", errors=True)
    fine = replace(fidelity, time_step=2e-5, steps_per_period=120, precision="double", contact_tolerance=1e-9)
    reference, judged = RodEngine().run(jobs, fine), engine.run(jobs, fidelity)
    # Without the limit, what soft contacts lose of the friction has numbers too.
    with patch("brainbench.stimuli.engines.mujoco.LARGEST_CHANGE", 9.0):
        every = get_engine("mujoco").run(jobs, fidelity)
    rows = []
    for friction in FRICTIONS:
        for flagged in (True, False):
            kinds = zip(jobs, judged, every, reference, strict=True)
            pairs = [
                (one.wrench, right.wrench)
                for job, told, one, right in kinds
                if (job.obstacles[0].friction, told.status != "ok" or bool(told.remark)) == (friction, flagged)
                if one.status == right.status == "ok"
            ]
            parts = [
                [np.linalg.norm(one[:, cut] - right[:, cut]) / np.linalg.norm(right[:, cut]) for one, right in pairs]
                for cut in (slice(0, 3), slice(3, 6))
            ]
            wrong = np.max(parts, axis=0) > LARGEST_CHANGE
            middle = [f"{np.median(part):.0%}" if part else "" for part in parts]
            rows.append([f"{friction:g}", "yes" if flagged else "no", f"{len(pairs)}", f"{wrong.sum()}", *middle])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--whiskers", type=int, default=400, help="whiskers at each speed")
    parser.add_argument("--speeds", default="1.05,1.5,2,2.9", help="speeds of the objects (m/s)")
    parser.add_argument("--soft", type=int, default=0, help="whiskers of each kind of random scene in mujoco, instead")
    parser.add_argument("--fidelity", default="balanced")
    args = parser.parse_args()
    fidelity = replace(Fidelity.of(args.fidelity), twist=False)
    if args.soft:
        columns = ["friction", "flagged", "whiskers", "err > 20 %", "force, median", "moment, median"]
        print(table(columns, soft(args.soft, fidelity)))
        return
    columns = ["m/s", "whiskers", "median error", "err > 20 %", "half the step changes these and others",
               "a fifth changes these and others", "flagged", "ok and err > 20 %"]  # fmt: skip
    print(table(columns, [struck(float(speed), args.whiskers, fidelity) for speed in args.speeds.split(",")]))


if __name__ == "__main__":
    main()
