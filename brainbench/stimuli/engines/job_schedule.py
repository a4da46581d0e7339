"""Distinct jobs of a list of scenes, and the objects that each whisker could ever touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brainbench.core.files import content_hash
from brainbench.stimuli.engines.reach import Reach, reachable
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.motion.trajectories import Still
from brainbench.stimuli.scenes.scene import Scene

SAMPLING = 1000.0
"""Instants per second at which reach is judged; what moves in between counts as an error bound."""


@dataclass(frozen=True, eq=False)
class JobSchedule:
    """Distinct jobs of some scenes, and where each whisker of each scene finds its trace."""

    jobs: tuple[Job, ...]
    """Jobs to run: a whisker that reaches no object does the same in every scene with the same motion."""
    places: tuple[tuple[int, ...], ...]
    """[scene][whisker] index into ``jobs``."""
    reaches: tuple[tuple[Reach, ...], ...]
    """[scene][whisker] what of its scene the whisker could ever touch."""
    surfaces: bool = False
    """True for an engine that touches exact surfaces where there are some, instead of convex parts."""


def plan(scenes: Sequence[Scene], *, surfaces: bool = False) -> JobSchedule:
    """Find the distinct jobs of ``scenes``, for an engine that touches exact ``surfaces`` or convex parts."""
    distinct: dict[str, int] = {}
    jobs: list[Job] = []
    places, reaches = [], []
    for scene in scenes:
        row, near = [], []
        digests: dict[tuple[int, bool], str] = {}
        owners = [part for part in scene.split() for _ in part.array]
        for mount, owner, job in zip(scene.mounts, owners, scene.jobs(), strict=True):
            reach = reach_of(job, surfaces=surfaces)
            travels = not isinstance(owner.head.motion, Still)
            # Of one animal the whiskers differ by their mounts alone, and a scene may have a thousand objects.
            what = id(owner), bool(travels or reach)
            if what not in digests:
                seen = owner.config() if travels or reach else {"whisking": owner.whisking.config()}
                digests[what] = content_hash({**seen, "label": None})
            # A head that is turned otherwise feels gravity in another direction.
            pull = {"pull": job.gravity} if any(job.gravity) else {}
            key = content_hash(mount, digests[what], pull)
            if key not in distinct:
                distinct[key] = len(jobs)
                jobs.append(job)
            row.append(distinct[key])
            near.append(reach)
        places.append(tuple(row))
        reaches.append(tuple(near))
    return JobSchedule(tuple(jobs), tuple(places), tuple(reaches), surfaces)


def reach_of(job: Job, *, surfaces: bool = False) -> Reach:
    """Return what of its obstacles the whisker of this job could ever touch."""
    duration = job.times[-1] - job.start
    times = np.linspace(job.start, job.times[-1], max(2, math.ceil(duration * SAMPLING)))
    return reachable(job.whisker, job.follicle.pose(times)[0], job.obstacles, times, surfaces=surfaces)
