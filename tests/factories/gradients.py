"""Gradients of a run beside central differences of the same run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from brainbench.core.rotations import base_rotation
from brainbench.geometry import Mesh
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import make_task
from brainbench.stimuli.engines.rod.packing import knots_alike
from brainbench.stimuli.fitting.gradients import GradientRun, JobParameters
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.objects.obstacle import Obstacle, Part
from brainbench.stimuli.whiskers.whisker import Whisker, build_chain
from tests.factories.engine_scenes import Oscillation

COARSE = Fidelity(links=8, time_step=1e-4)
WHISKER = Whisker(0.02, 5e-5, 5e-6, 3e9, 1300.0, 0.3, curvature=10.0, friction=0.0)


@dataclass(frozen=True)
class Swing(Oscillation):
    """A base that swings by .35 rad at 10 Hz about its rest, in all three angles."""

    finest: ClassVar[float] = 0.05
    angles: tuple[float, float, float] = (0.35, 0.105, 0.14)
    frequency: float = 10.0


def touching_job(solid: Part | Mesh, *, friction: float = 0.0, frames: int = 30) -> Job:
    """Return the job of a whisker that swings onto a solid, which stands beside its middle."""
    whole = ((), solid) if isinstance(solid, Mesh) else ((solid,), None)
    obstacle = Obstacle(whole[0], surface=whole[1])
    whisker = replace(WHISKER, friction=friction)
    return Job(whisker, Swing(), (obstacle,), np.linspace(1e-3, frames * 1e-3, frames))


def gradient_errors(
    job: Job, names: tuple[str, ...], *, fidelity: Fidelity = COARSE, change: float = 1e-5, **options: object
) -> tuple[NDArray[np.float64], GradientRun]:
    """Return the errors [output, parameter] of derivatives beside central differences, relative to the latter.

    Outputs are random sums of wrenches, shapes and contact forces; NaN where one does not depend on a parameter.
    """
    parameters = JobParameters([job], names, **options)  # pyright: ignore[reportArgumentType]
    run = GradientRun(parameters.build, parameters.values, scales=parameters.scales, fidelity=fidelity)
    trace = run.traces[0]
    assert trace.status == "ok", trace.reason
    random = np.random.default_rng(0)
    weights = [random.normal(size=values.shape) / (np.abs(values).max() or 1.0) for values in outputs_of(trace)]
    exact = [
        run.gradient(*[[weight if k == output else None] for k in range(3)]) for output, weight in enumerate(weights)
    ]
    errors = np.full((3, len(names)), np.nan)
    for p, scale in enumerate(parameters.scales):
        shift = change * scale * (np.arange(len(names)) == p)
        ends = [outputs_of(traces_at(run, parameters.values + sign * shift)[0]) for sign in (1, -1)]
        for output, weight in enumerate(weights):
            expected = np.vdot(weight, ends[0][output] - ends[1][output]) / (2 * shift[p])
            if abs(expected * scale) > 1e-6:
                errors[output, p] = abs(exact[output].values[p] / expected - 1)
    return errors, run


def traces_at(run: GradientRun, values: NDArray[np.float64]) -> list[Trace]:
    """Return what the jobs of other values give, simulated as those of a run, with its links, steps, knots and hinges.

    Contacts are solved to rounding here, which the ordinary engine does not do.
    """
    tasks, steps = [], []
    for job, (group, row) in zip(run.build(np.array(values, dtype=float)), run._rows, strict=True):
        near, span = group.packed.tasks[row], (job.start, float(job.times[-1]))
        task = make_task(job, run.fidelity, {}, silent=True)
        assert task is not None
        knots = knots_alike(near.base, job.follicle.pose, base_rotation, span, "the base of a whisker")
        base, chain = replace(near.base, knots=knots), build_chain(job.whisker, near.chain.links)
        like = {"limit": near.limit, "twists": near.twists, "fidelity": near.fidelity}
        tasks.append(replace(task, chain=chain, base=base, **like))
        steps.append(group.solver.steps[group.packed.jobs.whisker[row]])
    return run._launch(tasks, steps)[0]


def outputs_of(trace: Trace) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return what a gradient run differentiates."""
    assert trace.link_positions is not None
    assert trace.contact_wrench is not None
    return trace.wrench, trace.link_positions, trace.contact_wrench
