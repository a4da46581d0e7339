"""Measure error and cost of whisker simulations over their settings: the data behind ``Fidelity.auto``.

Subject: mouse whisker C2, straightened; for the ring-down also the stiffest mouse whisker, E5. Per setting:

- ``static_error``: worst of base-moment and base-force errors against the elastica over five frictionless pegs;
- ``ring_error``: worst error of first frequency and damping ratio of C2 and E5; null for ``quasistatic``;
- ``dynamic_error``: base moment while whisking at 20 Hz against a frictionless post: root-mean-square difference
  from a converged simulation (:data:`REFERENCE`) over its root mean square, read every ms;
- ``sliding_error``, ``flick_error``: the same with friction .48, also past the post so that it springs free each whisk;
- ``error``: the worst of these; null when a run failed, with the reason in ``note``;
- ``cost``: processor seconds per simulated second of one whisker in contact, over the three whisking runs.

Points with a ``collision`` measure instead the collision geometry of a concave object: C2 whisks without friction into
the hollow of the Rodgers solid (30 mm), touched exactly, cut into convex pieces at a threshold, or as its hull.
``concave_error``, also ``error``, is that of the base moment against the exact solid in the converged simulation,
``pieces`` the convex parts or triangles that stand for the solid.

A table is a JSON file; points that it holds already are kept, so an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import BrainbenchError, DataError, unknown_name
from brainbench.core.files import read_json, write_json, write_text
from brainbench.core.progress import Progress
from brainbench.core.tradeoffs import TradeoffPoint, pareto_front
from brainbench.geometry import DecompositionSettings
from brainbench.stimuli.engines import DEFAULT_ENGINE, get_engine
from brainbench.stimuli.engines.fidelity import RESOLUTION, Fidelity, list_presets
from brainbench.stimuli.engines.protocol import Job, Trace
from brainbench.stimuli.engines.reach import touched
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.objects.mesh_solids import touchable
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle
from brainbench.stimuli.objects.placed_object import PlacedObject
from brainbench.stimuli.objects.primitives import rodgers_solid
from brainbench.stimuli.validation.bench_tests import peg, ringdown, run_stable
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import Whisker

PROTOCOL = 3
"""Counts up when the experiments change, so that points of different experiments never share a table."""
PEGS = ((0.3, 0.05), (0.5, 0.1), (0.5, 0.2), (0.7, 0.2), (0.8, 0.02))
"""Centre-line points (a/L, d/L) of the static tests."""
LINKS = (6, 8, 10, 14, 20, 30)
TIME_STEPS = ((2e-4, 10.0), (1e-4, 25.0), (5e-5, 120.0), (2e-5, 250.0))
"""Time step [s] with the least steps per period of the first mode, which short whiskers need."""
COLLISIONS = ("exact", "decomposition-0.02", "decomposition-0.1", "hull")
"""Collision geometries of the concave object; a decomposition with its threshold."""
PARTS = ("static_error", "ring_error", "dynamic_error", "sliding_error", "flick_error")


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


REFERENCE = SimulationSetting(Fidelity(links=40, time_step=1e-5), "rod")
"""The converged simulation of the dynamic tests: with friction ``rod`` is within some tenths of a per cent of a
differential equation that no engine shares (``benchmarks/whiskers/friction_reference.py``), ``mujoco`` within some
per cent."""


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
            no presets and no steps per period.
        collisions: geometries of a concave object to measure as well, at each preset, as in :data:`COLLISIONS`.

    Raises:
        UsageError: a value lies outside the range of :class:`Fidelity`, or a collision geometry is unknown.
    """
    presets, steps = [Fidelity.preset(name) for name in list_presets()], list(itertools.product(links, time_steps))
    grid = [Fidelity(links=n, time_step=step, steps_per_period=periods) for n, (step, periods) in steps]
    still = [Fidelity(links=n, time_step=step, solver="quasistatic") for n, (step, _) in steps]
    fidelities = {"dynamic": dict.fromkeys([*presets, *grid]), "quasistatic": still}
    for solver in solvers:
        if solver not in fidelities:
            raise unknown_name("solver", solver, fidelities)
    chosen = [
        SimulationSetting(fidelity, name)
        for solver in fidelities
        for name in backends
        if solver in solvers and (solver == "dynamic" or name == "rod")
        for fidelity in fidelities[solver]
    ]
    return chosen + [SimulationSetting(*point) for point in itertools.product(presets, backends, collisions)]


def measure_tradeoff(
    path: str | os.PathLike[str], chosen: Iterable[SimulationSetting] | None = None, *, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """Measure the settings that the table at ``path`` lacks, writing it (atomically) after each.

    Returns:
        All points of the table: the fields of the module's text, ``backend`` and the fields of :class:`Fidelity`;
        ``collision`` only where a concave object was touched.

    Raises:
        DataError: ``path`` holds something else, or points of other experiments or of another MuJoCo.
        UsageError: a backend is unknown.
    """
    wanted = settings() if chosen is None else list(chosen)
    for name in {setting.backend for setting in wanted}:
        get_engine(name)
    head, points = _header(), []
    if Path(path).exists():
        table = read_json(path)
        if not isinstance(table, dict) or any(table.get(key) != head[key] for key in ("protocol", "mujoco")):
            raise DataError(
                f"{os.fspath(path)!r} was measured by other experiments or with another MuJoCo than {head['mujoco']}; "
                "write to another file, or delete it to measure everything again."
            )
        points = list(table["points"])
    known = {_key(point) for point in points}
    missing = [setting for setting in wanted if _key(_fields(setting)) not in known]
    # The references cost more than most points, so they are run only when something is missing.
    reference = _whisking(REFERENCE) if any(item.collision is None for item in missing) else []
    hollow = [_into_hollow(replace(REFERENCE, collision="exact"))[0]] if any(item.collision for item in missing) else []
    for done, setting in enumerate(missing, start=1):
        points.append(_measure(setting, hollow if setting.collision else reference))
        write_json(path, {**head, "points": points})
        if progress is not None:
            progress(done, len(missing), "measuring settings")
    return points


def write_csv(points: Iterable[dict[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Write points as comma-separated values, one row each, atomically; what is not known stays empty."""
    import pandas as pd

    # Columns of objects, so that whole numbers stay whole beside missing ones.
    return write_text(path, pd.DataFrame(list(points), dtype=object).sort_index(axis=1).to_csv(index=False))


def front(points: Iterable[dict[str, Any]], *, backend: str | None = None) -> list[TradeoffPoint]:
    """Return the points of the bench tests that none beats in both error and cost, cheapest first.

    They are of one backend, or of all. Points with a collision geometry are other experiments and are left out, and so
    are those without inertia, for which some of the errors mean nothing.
    """
    return pareto_front(
        TradeoffPoint(
            math.inf if p["error"] is None else p["error"], p["cost"], {n: p[n] for n in (*RESOLUTION, "backend")}
        )
        for p in points
        if p["cost"] is not None and not p.get("collision") and backend in (None, p["backend"]) and _moves(p)
    )


def collision_points(points: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the points of a table that touch a concave object."""
    return [point for point in points if point.get("collision")]


def preset_of(point: dict[str, Any]) -> str:
    """Return the name of the preset with the resolution of a point; empty when there is none."""
    presets = {tuple(vars(Fidelity.preset(name))[item] for item in RESOLUTION): name for name in list_presets()}
    return presets.get(tuple(point.get(item) for item in RESOLUTION), "")


def _fields(setting: SimulationSetting) -> dict[str, Any]:
    fields = {**asdict(setting.fidelity), "backend": setting.backend}
    return fields if setting.collision is None else {**fields, "collision": setting.collision}


def _key(point: dict[str, Any]) -> tuple[Any, ...]:
    return (*(point.get(name) for name in (*RESOLUTION, "backend", "collision")), _moves(point))


def _moves(point: dict[str, Any]) -> bool:
    return point.get("solver", "dynamic") == "dynamic"


def _header() -> dict[str, Any]:
    import platform
    from importlib import metadata

    return {
        "made_by": "brainbench tradeoff whisker",
        "protocol": PROTOCOL,
        "subject": "mouse whisker C2 (ring-down also E5)",
        "error": "worst of static (elastica, five pegs), ring-down, dynamic, sliding and flick (whisking on a post)",
        "cost": "processor seconds per whisker-second in contact",
        "mujoco": metadata.version("mujoco-core"),
        "machine": platform.machine(),
    }


def _measure(setting: SimulationSetting, reference: Sequence[Trace]) -> dict[str, Any]:
    errors = ("concave_error",) if setting.collision else PARTS
    values: dict[str, Any] = {**_fields(setting), **dict.fromkeys((*errors, "error", "cost")), "note": ""}
    try:
        if setting.collision:
            trace, values["pieces"] = _into_hollow(setting)
            traces = [trace]
        else:
            _test_bench(setting, values)
            traces = _whisking(setting)
        values["cost"] = float(sum(trace.seconds for trace in traces) / (len(traces) * _FRAMES[-1]))
        for name, trace, other in zip(errors[-len(traces) :], traces, reference, strict=True):
            values[name] = _difference(trace, other)
        values["error"] = max(values[name] for name in errors if values[name] is not None)
    except BrainbenchError as error:
        values["note"] = str(error)
    return values


def _test_bench(setting: SimulationSetting, values: dict[str, Any]) -> None:
    """Measure pegs and ring-downs."""
    whisker = _straight("C2")
    length, how = whisker.arc_length, {"backend": setting.backend, "fidelity": setting.fidelity}
    pegs = [peg(whisker, at * length, offset * length, **how) for at, offset in PEGS]
    values["static_error"] = max(max(test.moment_error, test.force_error) for test in pegs)
    if _moves(values):
        values["ring_error"] = max(_ring_error(_straight(name), setting) for name in ("C2", "E5"))


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


def _into_hollow(setting: SimulationSetting) -> tuple[Trace, int]:
    """Run C2 whisking into the hollow of the Rodgers solid; return the trace and of how much the solid consists."""
    kind, settings = _collision(setting.collision or "exact")
    solid = rodgers_solid(0.03)
    if kind != "exact" and solid.mesh is not None:
        solid = touchable(solid.mesh, kind, settings)
    # The hollow is a trough along the whisker, turned a little and aside, so that the whisker slides down its slope.
    obstacle = PlacedObject(solid, (0.01, 0.0042, 0.002), (0.0, math.pi / 2, 0.3), friction=0.0).obstacle()
    job = Job(_straight("C2"), _Whisk(math.radians(22)), (obstacle,), _FRAMES)
    body = touched(obstacle, surfaces=get_engine(setting.backend).surfaces)
    return _timed([job], setting)[0], len(body.parts) if body.surface is None else len(body.surface.faces)


def _ring_error(whisker: Whisker, setting: SimulationSetting) -> float:
    ring = ringdown(whisker, modes=1, backend=setting.backend, fidelity=setting.fidelity)
    return max(abs(ring.frequency_error), abs(ring.damping_ratio / whisker.damping_ratio - 1))


def _straight(name: str) -> Whisker:
    return replace(WhiskerArray.mouse()[name].whisker, curvature=0.0)


_FRAMES = np.arange(1.0, 151.0) * 1e-3


@dataclass(frozen=True)
class _Whisk:
    """Whisking at 20 Hz by ± ``amplitude`` (rad) from a retracted start without a jump."""

    amplitude: float

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return base points [n, 3] (m), all at the origin, and angles (θ, φ, ζ) [n, 3] (rad) at times [n] (s)."""
        euler = np.tile([math.pi / 2, 0.0, -math.pi / 2], (len(times), 1))
        euler[:, 0] -= self.amplitude * np.cos(2 * np.pi * 20 * times) * smooth_step(times, 0.025)
        return np.zeros((len(times), 3)), euler


def _whisking(setting: SimulationSetting) -> list[Trace]:
    """Run smooth, sliding and flicking contact; an unstable one is a :class:`DataError`."""
    whisker = _straight("C2")
    jobs = []
    for friction, degrees in ((0.0, 12), (0.48, 12), (0.48, 25)):
        # The post of 1 mm radius stands at .7 of the length and .2 mm beside the centre line of the resting whisker.
        post = Obstacle((Capsule((0.0107, 0.0012, -0.02), (0.0107, 0.0012, 0.02), 1e-3),), friction=friction)
        jobs.append(Job(whisker, _Whisk(math.radians(degrees)), (post,), _FRAMES))
    return _timed(jobs, setting)


def _timed(jobs: Sequence[Job], setting: SimulationSetting) -> list[Trace]:
    engine = get_engine(setting.backend)
    # What an engine loads or compiles at first use is no cost of the setting.
    engine.run([replace(job, times=_FRAMES[:2]) for job in jobs], setting.fidelity, workers=1)
    return run_stable(engine, jobs, setting.fidelity)


def _difference(trace: Trace, reference: Trace) -> float:
    # Root mean square over moments and frames, relative to that of the reference.
    gap = trace.wrench[:, 3:] - reference.wrench[:, 3:]
    return float(np.sqrt(np.mean(gap**2) / np.mean(reference.wrench[:, 3:] ** 2)))
