"""Derivatives of recorded runs beside central differences: bench tests, contact scenes, and random scenes.

python -m benchmarks.whiskers.gradients [--scenes 50] [--write]

Measured are the error and the cost of one pass over the recorded steps, which gives the derivatives of all readings by
all parameters. Four random sums of the base wrenches of each scene, of its shapes and of its contact forces are
differentiated by every parameter. Central differences are those of the same runs in double precision, with changes of
1e-5 and 1e-6 of the parameter's scale. Where these two differ by more than .3 %, and by more than rounding, or runs
take other steps, a change of contact lies between: the scene counts as an event for this parameter, and no error is
taken.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli import Fidelity, Whisker
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.fitting.gradients import GradientRun, JobParameters
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle, Trace
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle
from brainbench.stimuli.validation.bench_tests import OBJECTS, contact_jobs
from tests.factories.gradients import traces_at

FIDELITY = Fidelity(links=11, time_step=1e-4, precision="double")
MATERIAL = ("young_modulus", "density", "damping_ratio", "base_radius", "tip_radius", "curvature")
BASE = ("base.x", "base.y", "base.theta", "base.phi", "base.zeta")
OBJECT = ("object.x", "object.y", "object.z", "object.rx", "object.ry", "object.rz")
OUTPUTS = ("wrench", "shape", "contact force")
SUMS = 4
CHANGES = 1e-5, 1e-6
SMOOTH = 3e-3
ROUNDING = 1e-11
"""Share of what the outputs are worth below which two runs differ by rounding; searches for contacts end at less."""
NOTHING = 1e-6
"""Derivative, as a share of what the outputs are worth, below which there is nothing to compare."""


@dataclass
class Comparison:
    """Errors of one scene by parameter."""

    error: dict[str, list[float]] = field(default_factory=dict)
    """[output] relative error of the derivatives; NaN where an output does not depend on the parameter."""
    events: list[str] = field(default_factory=list)
    """Parameters with a change of contact between the differences."""
    status: str = ""
    close: tuple[str, ...] = ()
    costs: tuple[float, ...] = ()
    """Processor times (s) of the ordinary run in double precision, of the recorded run, and of the pass over it that
    gives the derivatives by all parameters, with all packing."""
    parameters: int = 0


def compare(job: Job, names: tuple[str, ...]) -> Comparison | None:
    """Compare all derivatives of a job; None when it cannot be simulated."""
    parameters = JobParameters([job], names)
    run = GradientRun(parameters.build, parameters.values, scales=parameters.scales, fidelity=FIDELITY)
    trace = run.traces[0]
    if trace.status != "ok":
        return None
    weights = _weights(trace)
    found = Comparison()
    exact = np.array([[_contract(weights[k], change, p) for p in range(len(names))]
                      for k, change in enumerate(vars(run.tangents()[0]).values())]).swapaxes(1, 2)  # fmt: skip
    event = run.gradient([weights[0][0]]).events[0]
    found.status, found.close = event.status, event.close
    for p, name in enumerate(names):
        differences, same = [], True
        for change in CHANGES:
            shift = change * parameters.scales[p] * (np.arange(len(names)) == p)
            ends = [traces_at(run, parameters.values + sign * shift)[0] for sign in (1, -1)]
            same &= all(end.status == "ok" and end.steps == trace.steps for end in ends)
            sums = [_sums(weights, end) for end in ends]
            differences.append((sums[0] - sums[1]) / (2 * shift[p]))
        error = []
        for output in range(len(OUTPUTS)):
            coarse, fine = (difference[output] for difference in differences)
            size = np.linalg.norm(coarse)
            if size * parameters.scales[p] < NOTHING * len(job.times):
                error.append(np.nan)
                continue
            apart = float(np.linalg.norm(fine - coarse))
            rounded = 2 * CHANGES[1] * parameters.scales[p] * apart < ROUNDING * len(job.times)
            same &= apart <= SMOOTH * size or rounded
            best = coarse if rounded else fine
            error.append(float(np.linalg.norm(exact[output, :, p] - best) / np.linalg.norm(best)))
        if same:
            found.error[name] = error
        else:
            found.events.append(name)
    found.costs, found.parameters = _costs(job, parameters), len(names)
    return found


def _weights(trace: Trace) -> list[list[NDArray[np.float64]]]:
    """Return random weights [output][sum] that make all readings of an output count alike."""
    random = np.random.default_rng(0)
    assert trace.link_positions is not None
    assert trace.contact_wrench is not None
    found = []
    for values in (trace.wrench, trace.link_positions - trace.link_positions[:1], trace.contact_wrench):
        scale = np.abs(values).max()
        found.append([random.normal(size=values.shape) / (scale or 1.0) for _ in range(SUMS)])
    return found


def _sums(weights: list[list[NDArray[np.float64]]], trace: Trace) -> NDArray[np.float64]:
    outputs = trace.wrench, trace.link_positions, trace.contact_wrench
    pairs = ((some, np.asarray(values)) for some, values in zip(weights, outputs, strict=True))
    return np.array([[np.vdot(weight, values) for weight in some] for some, values in pairs])


def _contract(weights: list[NDArray[np.float64]], change: NDArray[np.float64], p: int) -> list[float]:
    return [float(np.vdot(weight, change[p])) for weight in weights]


def _costs(job: Job, parameters: JobParameters) -> tuple[float, ...]:
    """Return the processor times of :attr:`Comparison.costs`, the best of three."""
    times = np.full(3, np.inf)
    engine = get_engine("rod")
    for _ in range(3):
        clock = [time.process_time()]
        engine.run([job], FIDELITY, record_shape=True, workers=1)
        clock.append(time.process_time())
        run = GradientRun(parameters.build, parameters.values, scales=parameters.scales, fidelity=FIDELITY)
        clock.append(time.process_time())
        run.tangents()
        clock.append(time.process_time())
        times = np.minimum(times, np.diff(clock))
    return tuple(times.tolist())


def bench_scenes() -> Iterator[tuple[str, Job, tuple[str, ...]]]:
    """Yield name, job and parameters of the bench tests and of one contact scene of each kind."""
    whisker = Whisker(0.02, 5e-5, 5e-6, 3e9, 1300.0, 0.2)
    still, times = StillFollicle(), np.linspace(1e-3, 0.06, 60)
    load = Load(0.015, (0.0, 1e-5, 0.5e-5))
    yield "point load", Job(whisker, still, (), times, loads=(load,)), (*MATERIAL, "arc_length")
    yield "ring-down", Job(whisker, still, (), times, loads=(replace(load, stop=0.0202),)), (*MATERIAL, "arc_length")

    def motion(when: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        rise = smooth_step(when, 0.05) * 2e-3
        place = np.column_stack([np.full(len(when), 0.01), rise - 2.8e-4, np.zeros(len(when))])
        return place, np.tile([1.0, 0.0, 0.0, 0.0], (len(when), 1))

    peg = Obstacle((Capsule((0.0, 0.0, -0.01), (0.0, 0.0, 0.01), 2.5e-4),), motion, friction=0.0)
    yield "peg", Job(whisker, still, (peg,), times), (*MATERIAL, *OBJECT[:2], *BASE[:3])
    for kind in OBJECTS:
        for friction in (0.0, 0.4):
            jobs = contact_jobs(3, objects=(kind,), each=1)
            job = next(job for job in jobs if job.obstacles[0].friction == friction)
            yield f"{kind}, friction {friction:g}", job, contact_names(friction)


def contact_names(friction: float) -> tuple[str, ...]:
    """Return the parameters of a contact scene."""
    return (*MATERIAL, *BASE, *OBJECT, *(("object.friction",) if friction else ()))


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=11)
    args = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    results: dict[str, Comparison] = {}
    for name, job, names in bench_scenes():
        if (found := compare(job, names)) is not None:
            results[name] = found
            print(name, _worst(found), found.status, found.events, flush=True)
    jobs = iter(contact_jobs(args.seed, each=1) + contact_jobs(args.seed + 1, each=1))
    drawn = refused = 0
    while drawn < args.scenes:
        job = next(jobs)
        found = compare(job, contact_names(job.obstacles[0].friction or 0.0))
        if found is None:
            refused += 1
            continue
        drawn += 1
        results[f"random {drawn}"] = found
        print(f"random {drawn}", _worst(found), found.status, found.events, flush=True)
    text = report(results, refused)
    publish(args, "Gradients", text)


def _worst(found: Comparison) -> float:
    return max((float(np.nan_to_num(error).max()) for error in found.error.values()), default=0.0)


def report(results: dict[str, Comparison], refused: int) -> str:
    """Return the tables as text."""
    names = list(dict.fromkeys(name for found in results.values() for name in (*found.error, *found.events)))
    fixed = [name for name in results if not name.startswith("random")]
    random = [results[name] for name in results if name.startswith("random")]
    rows = []
    for name in names:
        cells = []
        for scene in fixed:
            found = results[scene]
            cells.append("event" if name in found.events else _cell(found.error.get(name)))
        errors = [np.nanmax(found.error[name]) for found in random if np.isfinite(found.error.get(name, np.nan)).any()]
        events = sum(name in found.events for found in random)
        within = np.mean(np.array(errors) <= 0.01) if errors else np.nan
        cells += [f"{100 * np.median(errors):.1g}" if errors else "–", f"{100 * np.max(errors):.1g}" if errors else "–"]
        cells += [f"{100 * within:.0f}", str(events)]
        rows.append([name, *cells])
    head = ["parameter", *fixed, "random, median", "random, worst", "within 1 %, %", "events"]
    smooth = [found for found in random if found.status == "smooth"]
    costs = np.array([found.costs for found in results.values()])
    recorded, tangents = (costs[:, 1:] / costs[:, :1]).T
    each = tangents / [found.parameters for found in results.values()]
    close = Counter(what for found in random for what in found.close)
    missed = [
        f"{name} ({', '.join(found.events)})"
        for name, found in results.items()
        if found.events and found.status == "smooth"
    ]
    told = ", ".join(f"{what} {count}" for what, count in close.items())
    worst = [f"{np.median(cost):.2f} [{np.max(cost):.2f}]" for cost in (recorded, tangents, each)]
    return (
        f"Relative error (%) of the derivatives of {SUMS} random sums of base wrenches, of shapes and of contact "
        "forces, the worst of the three, beside central differences in double precision. *event*: a change of contact "
        f"lies between the differences. {len(random)} random scenes of contact; {refused} others began in contact and "
        f"were not simulated. Called smooth: {len(smooth)}, of which with an event for some parameter: "
        f"{sum(bool(found.events) for found in smooth)}; one-sided: "
        f"{sum(found.status == 'one-sided' for found in random)}; degenerate: "
        f"{sum(found.status == 'degenerate' for found in random)}.\n\n"
        + table(head, rows)
        + f"\nRandom scenes close to a change of contact: {told}. Events without a flag: {'; '.join(missed) or 'none'}."
        f"\n\nProcessor time over that of the ordinary run (one whisker in double precision with its shapes, "
        f"contact forces to its own tolerance), median of all {len(results)} scenes [worst]: the recorded run, whose "
        f"contact forces are solved to rounding, {worst[0]}; the pass over it, with the packing for up to {len(names)} "
        f"parameters, {worst[1]}, which is {worst[2]} for each parameter, where a central difference takes 2."
    )


def _cell(error: list[float] | None) -> str:
    if error is None:
        return ""
    return "–" if np.isnan(error).all() else f"{100 * np.nanmax(error):.1g}"


if __name__ == "__main__":
    main()
