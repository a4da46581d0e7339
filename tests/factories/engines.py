"""A physics double, whose forces are readable functions of the job, and facts of simulated whiskers to be judged."""

from __future__ import annotations

import numpy as np

from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.engines.trust import OK, RunFacts
from brainbench.stimuli.motion.jobs import Trace


class FakeEngine(WhiskerEngine):
    """Force = base position (as N), moment = where the whisker points (as N·m), both in the job's frame.

    A whisker "touches" while its unbent tip lies inside an obstacle's bounding box.
    """

    name = "fake"

    def __init__(self, unstable: dict[int, str] | None = None) -> None:
        super().__init__()
        self.jobs = []
        self.unstable = unstable or {}

    def run(self, jobs, fidelity, *, progress=None, workers=None, record_shape=False):
        traces = []
        for index, job in enumerate(jobs):
            self.jobs.append(job)
            traces.append(self._trace(job, self.unstable.get(index)))
            if progress:
                progress(index + 1, len(jobs))
        return traces

    def _trace(self, job, reason):
        position, euler = job.follicle.pose(job.times)
        axes = base_rotation(euler)
        wrench = np.concatenate([position, axes[:, :, 0]], axis=1)
        x, y = job.whisker.centre_line(job.whisker.arc_length)
        tip = position + axes @ np.array([x, y, 0.0])
        contact = np.zeros(len(job.times), bool)
        for obstacle in job.obstacles:
            travel = 0.0 if obstacle.motion is None else obstacle.motion(job.times)[0]
            for part in obstacle.parts:
                low, high = part.bounds()
                contact |= ((tip - travel >= low) & (tip - travel <= high)).all(axis=1)
        if reason is not None:
            wrench[len(wrench) // 2 :] = np.nan
        return Trace(
            wrench=wrench,
            contact=contact,
            contact_arc=np.where(contact, job.whisker.arc_length, np.nan),
            status="ok" if reason is None else "unstable",
            reason=reason or "",
            penetration=1e-6 * contact.any(),
            steps=len(job.times),
        )


def facts(**changed):
    """Facts of one whisker in good order but for what is changed."""
    values = {
        "status": OK, "failed": 0.0, "strength": 0.0, "strong_at": np.inf, "strongest": 30.0, "travel": 0.0,
        "farthest": 8e-4, "fast_at": np.inf, "struck": False,
        "residual": 0.01, "crowded": 0, "steps": 100, "depth": 1e-5, "peak": 1e-3, "third": 9e-4,
    }  # fmt: skip
    return RunFacts(**{name: np.array([value]) for name, value in (values | changed).items()})
