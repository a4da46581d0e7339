"""Error and cost of whisker simulations over their settings: the data behind ``Fidelity.auto``.

Per setting, in the random scenes of contact of :mod:`tests.factories.contact_scenes`, against a converged
simulation (:data:`REFERENCE`):

- ``error_50``, ``error_90``, ``error_95``, ``worst``: what so many per cent of the whiskers with an object on one side
  stay below (:func:`~tests.factories.contact_scenes.difference`), and all; null where more of them cannot be trusted;
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
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import BrainbenchError, check_each
from brainbench.geometry import DecompositionSettings
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity, list_presets
from brainbench.stimuli.engines.reach import touched
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.objects.solid import rodgers_solid, touchable
from brainbench.stimuli.validation.bench_tests import peg, ringdown
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.contact_scenes import HARD_OBJECTS, OBJECTS, contact_jobs, difference

Row = dict[str, Any]
PEGS = ((0.3, 0.05), (0.5, 0.1), (0.5, 0.2), (0.7, 0.2), (0.8, 0.02))
"""Centre-line points (a/L, d/L) of the static tests."""
LINKS = (6, 8, 10, 14, 20, 30)
TIME_STEPS = ((5e-4, 6.0), (2e-4, 10.0), (1e-4, 25.0), (5e-5, 60.0), (5e-5, 120.0), (2e-5, 250.0))
"""Time step [s] with the least steps per period of the first mode, which short whiskers need."""
CONTACT_TOLERANCES = (1e-6, None)  # tolerances of contact forces; None for few iterations
COLLISIONS = {"exact": ("exact", None), "hull": ("hull", None)} | {
    f"decomposition-{threshold}": ("decomposition", DecompositionSettings(threshold=threshold))
    for threshold in (0.02, 0.1)
}
"""Collision geometries of the concave object; a decomposition with its threshold."""
SHARES = {0.5: "error_50", 0.9: "error_90", 0.95: "error_95", 1.0: "worst"}
"""Shares of whiskers, and the column of the table with the relative error that they stay below."""
HARD_SHARES = {0.5: "hard_50", 0.9: "hard_90", 1.0: "hard_worst"}
ERROR = SHARES[0.9]  # column that settings are ranked by
SEED = 0  # scenes of the table; others are held out
ABOUT = {
    "subject": f"216 scenes with {', '.join(OBJECTS)}, 90 with {', '.join(HARD_OBJECTS)}; seed {SEED}",
    "error": "of base force or moment, root mean square; so many per cent of the whiskers stay below it",
    "cost": "processor seconds per whisker-second, objects on one side",
}
FIXED = {"protocol": 6, "mujoco": metadata.version("mujoco-core")}
"""What rows of a table share; the protocol counts up when the experiments change."""
REFERENCE = Fidelity(links=40, time_step=1e-5, precision="double", contact_tolerance=1e-9)
"""The converged simulation, of ``rod`` in double precision: single precision loses more at such short steps than they
gain. Its contact forces are solved, so what few iterations leave counts among the errors. With friction it is within
some tenths of a per cent of a differential equation that no engine shares, ``mujoco`` within some per cent."""


def settings(backends: Sequence[str], solvers: Sequence[str], collisions: Sequence[str]) -> list[Row]:
    """Return the settings to measure: of each backend the presets and the grid, with and without inertia.

    Args:
        backends: engines; ``rod`` alone has the solver ``quasistatic``.
        solvers: ``dynamic``, ``quasistatic`` (without presets, steps per period and few iterations), or both.
        collisions: geometries of a concave object to measure as well, at each preset, of :data:`COLLISIONS`, or all.
    """
    collisions = list(COLLISIONS) if collisions == ["all"] else collisions
    check_each("collision geometry", collisions, COLLISIONS)
    presets, steps = [Fidelity.preset(name) for name in list_presets()], list(itertools.product(LINKS, TIME_STEPS))
    grid = [
        Fidelity(links=n, time_step=step, steps_per_period=periods, contact_tolerance=tolerance)
        for tolerance, (n, (step, periods)) in itertools.product(CONTACT_TOLERANCES, steps)
    ]
    still = [
        Fidelity(links=n, time_step=step, solver="quasistatic", contact_tolerance=CONTACT_TOLERANCES[0])
        for n, (step, _) in steps
    ]
    fidelities = {"dynamic": list(dict.fromkeys([*presets, *grid])), "quasistatic": still}
    check_each("solver", solvers, fidelities)
    rows = [
        {**asdict(fidelity), "backend": get_engine(backend).name, "collision": None}
        for solver, backend in itertools.product(solvers, backends)
        if solver == "dynamic" or backend == "rod"
        for fidelity in fidelities[solver]
    ]
    hollow = itertools.product(presets, backends, collisions)
    return rows + [{**asdict(preset), "backend": name, "collision": surface} for preset, name, surface in hollow]


def competes(row: Row) -> bool:
    """Whether a row measures what others do: hollow objects, and whiskers without inertia, are other experiments."""
    return not row.get("collision") and row.get("solver", "dynamic") == "dynamic"


def measure(row: Row) -> Row:
    """Return errors and cost of a setting; null, with a note, where it cannot be measured."""
    values: Row = {**dict.fromkeys((*SHARES.values(), "untrusted", "cost")), "note": ""}
    backend, fidelity = row["backend"], Fidelity(**{f.name: row[f.name] for f in fields(Fidelity) if f.name in row})
    try:
        if row.get("collision"):
            values["pieces"], jobs = _hollow_jobs(backend, row["collision"])
            errors, values["cost"] = _errors(backend, fidelity, ("hollow",), jobs)
        else:
            values |= _test_bench(backend, fidelity)
            errors, values["cost"] = _errors(backend, fidelity, OBJECTS)
            hard, _ = _errors(backend, fidelity, HARD_OBJECTS)
            values |= {name: _bound(hard, share) for share, name in HARD_SHARES.items()}
        values["untrusted"] = float(np.isinf(errors).mean())
        values |= {name: _bound(errors, share) for share, name in SHARES.items()}
    except BrainbenchError as error:
        values["note"] = str(error)
    return values


def _hollow_jobs(backend: str, collision: str) -> tuple[int, list[Job]]:
    """Return the scenes with a hollow that a geometry stands for, and of how many pieces an engine touches that."""
    solid = rodgers_solid()
    if collision != "exact" and solid.mesh is not None:
        solid = touchable(solid.mesh, *COLLISIONS[collision])
    body = touched(Obstacle(solid.parts, surface=solid.surface), surfaces=get_engine(backend).surfaces)
    pieces = len(body.parts) if body.surface is None else len(body.surface.faces)
    return pieces, contact_jobs(SEED, objects=("hollow",), hollow=solid)


def _jobs(objects: tuple[str, ...]) -> list[Job]:
    return contact_jobs(SEED, each=1 if objects == HARD_OBJECTS else 3, objects=objects)


@cache
def _references(objects: tuple[str, ...]) -> dict[int, Trace]:
    """Return what a converged simulation says of the scenes with some objects, by the index of their job.

    Only traces are there that can be trusted and touch something.
    """
    traces = get_engine("rod").run(_jobs(objects), REFERENCE.resolved(True))
    return {i: trace for i, trace in enumerate(traces) if trace.status == "ok" and trace.contact.any()}


def _errors(
    backend: str, fidelity: Fidelity, objects: tuple[str, ...], jobs: list[Job] | None = None
) -> tuple[NDArray, float]:
    """Return the errors of the whiskers that touch some objects, infinite if they cannot be trusted, and the cost."""
    jobs, references = jobs or _jobs(objects), _references(objects)
    traces, cost = run_for_cost(backend, fidelity, [jobs[index] for index in references])
    return np.array(list(map(difference, traces, references.values()))), cost


def _bound(errors: NDArray[np.float64], share: float) -> float | None:
    """Return what a share of errors stays below; None where that is not finite or there are none."""
    bound = float(np.quantile(errors, share, method="higher")) if errors.size else math.inf
    return bound if math.isfinite(bound) else None


def run_for_cost(backend: str, fidelity: Fidelity, jobs: Sequence[Job]) -> tuple[list[Trace], float]:
    """Return the traces of jobs on one thread, and processor seconds per simulated second of a whisker."""
    engine = get_engine(backend, errors=fidelity.error is not None)
    fidelity = fidelity.resolved(engine.twists)
    # What an engine loads or compiles at first use is no cost of the setting.
    engine.run([replace(job, times=job.times[:2]) for job in jobs], fidelity, workers=1)
    before = os.times()
    traces = engine.run(jobs, fidelity, workers=1)
    used = sum(os.times()[:4]) - sum(before[:4])
    return traces, used / sum(job.times[-1] for job in jobs)


def _test_bench(backend: str, fidelity: Fidelity) -> Row:
    """Return the errors of pegs and ring-downs."""
    whiskers = [replace(WhiskerArray.mouse()[name].whisker, curvature=0.0) for name in ("C2", "E5")]
    length, how = whiskers[0].arc_length, {"backend": backend, "fidelity": fidelity}
    pegs = [peg(whiskers[0], at * length, offset * length, **how) for at, offset in PEGS]
    rings = [ringdown(whisker, modes=1, **how) for whisker in whiskers if fidelity.solver == "dynamic"]
    off = [
        max(abs(ring.frequency_error), abs(ring.damping_ratio / whisker.damping_ratio - 1))
        for ring, whisker in zip(rings, whiskers, strict=False)
    ]
    return {
        "static_error": max(max(test.moment_error, test.force_error) for test in pegs),
        "ring_error": max(off, default=None),
    }
