"""Error and cost of whisker simulations over their settings: the data behind ``Fidelity.auto``.

Per setting, in the random scenes of contact of :mod:`brainbench.stimuli.validation.bench_tests`, against a converged
simulation (:data:`REFERENCE`):

- ``error_50``, ``error_90``, ``error_95``, ``worst``: what so many per cent of the whiskers with an object on one side
  stay below (:func:`.bench_tests.difference`), and all; null where more of them cannot be trusted;
- ``hard_50``, ``hard_90``, ``hard_worst``: the same of those with objects on both sides, slipping off or released;
- ``untrusted``: share of the whiskers with an object on one side that were flagged;
- ``cost``: processor seconds per simulated second of one of them.

And against exact solutions, for mouse whisker C2, straightened:

- ``static_error``: worst of base-moment and base-force errors against the elastica over five frictionless pegs;
- ``ring_error``: worst error of first frequency and damping ratio of C2 and E5; null for ``quasistatic``.

Points with a ``collision`` measure instead how a concave object is touched: the scenes with a hollow, where its solid
is exact, cut into convex pieces at a threshold, or its hull; ``pieces`` counts the convex parts or triangles that
stand for it.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import BrainbenchError, check_each, unknown_name
from brainbench.core.tradeoffs import TradeoffPoint
from brainbench.geometry import DecompositionSettings
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, RESOLUTION, Fidelity, list_presets
from brainbench.stimuli.engines.reach import touched
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.objects.solid import Solid, rodgers_solid, touchable
from brainbench.stimuli.validation import bench_tests
from brainbench.stimuli.validation.bench_tests import peg, ringdown
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.tradeoffs.study import Row, Study, front

PROTOCOL = 6  # counts up when the experiments change, so that points of different experiments never share a table
PEGS = ((0.3, 0.05), (0.5, 0.1), (0.5, 0.2), (0.7, 0.2), (0.8, 0.02))
"""Centre-line points (a/L, d/L) of the static tests."""
LINKS = (6, 8, 10, 14, 20, 30)
TIME_STEPS = ((5e-4, 6.0), (2e-4, 10.0), (1e-4, 25.0), (5e-5, 60.0), (5e-5, 120.0), (2e-5, 250.0))
"""Time step [s] with the least steps per period of the first mode, which short whiskers need."""
CONTACT_TOLERANCES = (1e-6, None)  # tolerances of contact forces; None for few iterations
COLLISIONS = ("exact", "decomposition-0.02", "decomposition-0.1", "hull")
"""Collision geometries of the concave object; a decomposition with its threshold."""
SHARES = {0.5: "error_50", 0.9: "error_90", 0.95: "error_95", 1.0: "worst"}
"""Shares of whiskers, and the column of the table with the relative error that they stay below."""
HARD_SHARES = {0.5: "hard_50", 0.9: "hard_90", 1.0: "hard_worst"}
ERROR = SHARES[0.9]  # column that settings are ranked by
TAILS = {"median": "error_50", "90 %": ERROR, "hard, median": "hard_50", "hard, 90 %": "hard_90"}
"""Columns that are shown, by their heading."""
SEED = 0  # scenes of the table; others are held out


@dataclass(frozen=True)
class SimulationSetting:
    """One point of the trade-off."""

    fidelity: Fidelity
    backend: str = DEFAULT_ENGINE
    collision: str | None = None
    """Collision geometry of a concave object, as in :data:`COLLISIONS`; None for the bench tests without one."""

    def __post_init__(self) -> None:
        if self.collision is not None:
            _collision(self.collision)


REFERENCE = SimulationSetting(Fidelity(links=40, time_step=1e-5, precision="double", contact_tolerance=1e-9), "rod")
"""The converged simulation, in double precision: single precision loses more at such short steps than they gain. Its
contact forces are solved, so what few iterations leave counts among the errors. With friction ``rod`` is within some
tenths of a per cent of a differential equation that no engine shares (``benchmarks/whiskers/friction_reference.py``),
``mujoco`` within some per cent."""


def settings(
    *,
    links: Sequence[int] = LINKS,
    time_steps: Sequence[tuple[float, float | None]] = TIME_STEPS,
    backends: Sequence[str] = (DEFAULT_ENGINE,),
    collisions: Sequence[str] = (),
    solvers: Sequence[str] = ("dynamic",),
) -> list[SimulationSetting]:
    """Return every combination (``time_steps`` pairs a step [s] with steps per period), after the presets.

    Args:
        links, time_steps, backends, solvers: axes of the bench tests; the solver ``quasistatic``, of ``rod`` alone, has
            no presets, no steps per period and the first of :data:`CONTACT_TOLERANCES`.
        collisions: geometries of a concave object to measure as well, at each preset, as in :data:`COLLISIONS`.
    """
    presets, steps = [Fidelity.preset(name) for name in list_presets()], list(itertools.product(links, time_steps))
    grid = [
        Fidelity(links=n, time_step=step, steps_per_period=periods, contact_tolerance=tolerance)
        for tolerance, (n, (step, periods)) in itertools.product(CONTACT_TOLERANCES, steps)
    ]
    still = [
        Fidelity(links=n, time_step=step, solver="quasistatic", contact_tolerance=CONTACT_TOLERANCES[0])
        for n, (step, _) in steps
    ]
    fidelities = {"dynamic": dict.fromkeys([*presets, *grid]), "quasistatic": still}
    check_each("solver", solvers, fidelities)
    chosen = [
        SimulationSetting(fidelity, name)
        for solver in fidelities
        for name in backends
        if solver in solvers and (solver == "dynamic" or name == "rod")
        for fidelity in fidelities[solver]
    ]
    return chosen + [SimulationSetting(*point) for point in itertools.product(presets, backends, collisions)]


def study(chosen: Sequence[SimulationSetting] | None = None) -> Study:
    """Return the study of some settings, all by default.

    Its rows have the fields of the module's text, ``backend`` and the fields of :class:`Fidelity`; ``collision`` only
    where a concave object is touched.
    """
    chosen = settings() if chosen is None else chosen
    for name in {setting.backend for setting in chosen}:
        get_engine(name)
    return Study(
        "brainbench tradeoff whisker",
        [_fields(setting) for setting in chosen],
        lambda row: _measure(_setting(row)),
        about={
            "subject": f"{len(_jobs(bench_tests.OBJECTS))} scenes with {', '.join(bench_tests.OBJECTS)}, "
            f"{len(_jobs(bench_tests.HARD_OBJECTS))} with {', '.join(bench_tests.HARD_OBJECTS)}; seed {SEED}",
            "error": "of base force or moment, root mean square; so many per cent of the whiskers stay below it",
            "cost": "processor seconds per whisker-second, objects on one side",
        },
        fixed={"protocol": PROTOCOL, "mujoco": metadata.version("mujoco-core")},
    )


def best(rows: Sequence[Row]) -> list[TradeoffPoint]:
    """Return the settings that none beats in both error and cost, cheapest first.

    Rows with a collision geometry are other experiments and are left out, and so are those without inertia, for
    which some of the errors mean nothing.
    """
    moving = [row for row in rows if not row.get("collision") and _moves(row)]
    return front(moving, ERROR, (*RESOLUTION, "backend", *TAILS.values()))


def _fields(setting: SimulationSetting) -> Row:
    values = {**asdict(setting.fidelity), "backend": setting.backend}
    return values if setting.collision is None else {**values, "collision": setting.collision}


def _setting(row: Mapping[str, Any]) -> SimulationSetting:
    fidelity = Fidelity(**{item.name: row.get(item.name, item.default) for item in fields(Fidelity)})
    return SimulationSetting(fidelity, row["backend"], row.get("collision"))


def _moves(row: Mapping[str, Any]) -> bool:
    return row.get("solver", "dynamic") == "dynamic"


def _jobs(objects: Sequence[str], hollow: Solid | None = None) -> list[Job]:
    each = 1 if objects == bench_tests.HARD_OBJECTS else 3
    return bench_tests.contact_jobs(SEED, each=each, objects=objects, hollow=hollow)


@cache
def _references(reference: SimulationSetting, objects: tuple[str, ...]) -> dict[int, Trace]:
    """Return what a converged simulation says of the scenes with some objects, by the index of their job.

    Only traces are there that can be trusted and touch something.
    """
    traces = get_engine(reference.backend).run(_jobs(objects), reference.fidelity.resolved(True))
    return {i: trace for i, trace in enumerate(traces) if trace.status == "ok" and trace.contact.any()}


def _measure(setting: SimulationSetting) -> Row:
    values: Row = {**dict.fromkeys((*SHARES.values(), "untrusted", "cost")), "note": ""}
    try:
        if setting.collision:
            solid = _touched_solid(setting.collision)
            body = touched(Obstacle(solid.parts, surface=solid.surface), surfaces=get_engine(setting.backend).surfaces)
            values["pieces"] = len(body.parts) if body.surface is None else len(body.surface.faces)
            errors, values["cost"] = _errors(setting, ("hollow",), solid)
        else:
            values |= _test_bench(setting)
            errors, values["cost"] = _errors(setting, bench_tests.OBJECTS)
            hard, _ = _errors(setting, bench_tests.HARD_OBJECTS)
            values |= {name: _bound(hard, share) for share, name in HARD_SHARES.items()}
        values["untrusted"] = float(np.isinf(errors).mean())
        values |= {name: _bound(errors, share) for share, name in SHARES.items()}
    except BrainbenchError as error:
        values["note"] = str(error)
    return values


def _errors(setting: SimulationSetting, objects: tuple[str, ...], hollow: Solid | None = None) -> tuple[NDArray, float]:
    """Return the errors of the whiskers that touch some objects, infinite if they cannot be trusted, and the cost."""
    jobs, references = _jobs(objects, hollow), _references(REFERENCE, objects)
    traces, cost = run_for_cost(setting, [jobs[index] for index in references])
    return np.array(list(map(bench_tests.difference, traces, references.values()))), cost


def _bound(errors: NDArray[np.float64], share: float) -> float | None:
    """Return what a share of errors stays below; None where that is not finite or there are none."""
    bound = float(np.quantile(errors, share, method="higher")) if errors.size else math.inf
    return bound if math.isfinite(bound) else None


def run_for_cost(setting: SimulationSetting, jobs: Sequence[Job]) -> tuple[list[Trace], float]:
    """Return the traces of jobs on one thread, and processor seconds per simulated second of a whisker."""
    engine = get_engine(setting.backend, errors=setting.fidelity.error is not None)
    fidelity = setting.fidelity.resolved(engine.twists)
    # What an engine loads or compiles at first use is no cost of the setting.
    engine.run([replace(job, times=job.times[:2]) for job in jobs], fidelity, workers=1)
    before = os.times()
    traces = engine.run(jobs, fidelity, workers=1)
    used = sum(os.times()[:4]) - sum(before[:4])
    return traces, used / sum(job.times[-1] for job in jobs)


def _test_bench(setting: SimulationSetting) -> Row:
    """Return the errors of pegs and ring-downs."""
    whiskers = [replace(WhiskerArray.mouse()[name].whisker, curvature=0.0) for name in ("C2", "E5")]
    length, how = whiskers[0].arc_length, {"backend": setting.backend, "fidelity": setting.fidelity}
    pegs = [peg(whiskers[0], at * length, offset * length, **how) for at, offset in PEGS]
    rings = [ringdown(whisker, modes=1, **how) for whisker in whiskers if setting.fidelity.solver == "dynamic"]
    off = [
        max(abs(ring.frequency_error), abs(ring.damping_ratio / whisker.damping_ratio - 1))
        for ring, whisker in zip(rings, whiskers, strict=False)
    ]
    return {
        "static_error": max(max(test.moment_error, test.force_error) for test in pegs),
        "ring_error": max(off, default=None),
    }


def _collision(text: str) -> tuple[str, DecompositionSettings | None]:
    """Return the kind of collision geometry that a text names, and how it is cut."""
    kind, _, threshold = text.partition("-")
    try:
        settings = DecompositionSettings(threshold=float(threshold)) if threshold else None
    except ValueError:
        settings = None
    if kind not in ("exact", "hull", "decomposition") or (kind == "decomposition") != (settings is not None):
        raise unknown_name("collision geometry", text, COLLISIONS, hint="Another threshold is possible.")
    return kind, settings


def _touched_solid(collision: str) -> Solid:
    """Return the Rodgers solid with the parts or the surface that stand for it."""
    kind, settings = _collision(collision)
    solid = rodgers_solid()
    return solid if kind == "exact" or solid.mesh is None else touchable(solid.mesh, kind, settings)
