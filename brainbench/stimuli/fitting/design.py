"""Choose how to whisk, or where to hold objects, so that the base wrenches tell the objects apart in few whisks.

Two objects a, b that are felt with white noise of standard deviation σ in each reading are apart by Mahalanobis'
distance D, D² = Σ ((wₐ − w_b)/σ)² over the readings, whiskers and components of a whisk. D² of n whisks is n times that
of one, so a motion with twice the D² needs half the whisks. The smallest D² of all pairs is raised by its gradient
(:mod:`brainbench.stimuli.fitting.gradients`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, check_each, check_once
from brainbench.core.limits import Count, Limit, Seed, limited
from brainbench.core.records import Status
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.fitting.gradients import GradientRun
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.scenes.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DesignVariable:
    """One thing that may be chosen."""

    unit: str
    low: float
    high: float
    """Usual bounds: those of whisking mice and rats, or a shift of objects (m) against the scenes'."""
    read: Callable[[Scene], float]
    change: Callable[[Scene, float], Scene]


def _whisking(name: str, unit: str, low: float, high: float) -> DesignVariable:
    def _change(scene: Scene, value: float) -> Scene:
        return replace(scene, whisking=replace(_sinusoid(scene), **{name: value}))

    return DesignVariable(unit, low, high, lambda scene: getattr(_sinusoid(scene), name), _change)


def _sinusoid(scene: Scene) -> Whisking:
    if not isinstance(scene.whisking, Whisking):
        raise UsageError(
            f"The scene {scene.label!r} does not whisk in a sinusoid; only the place of objects can be chosen."
        )
    return scene.whisking


def _shift(axis: int) -> DesignVariable:
    def _change(scene: Scene, value: float) -> Scene:
        def _moved(position: Sequence[float]) -> Any:
            return tuple(one + value * (index == axis) for index, one in enumerate(position))

        return replace(scene, objects=tuple(replace(item, position=_moved(item.position)) for item in scene.objects))

    return DesignVariable("m", -0.003, 0.003, lambda scene: 0.0, _change)


VARIABLES: Mapping[str, DesignVariable] = {
    "frequency": _whisking("frequency", "Hz", 4.0, 25.0),
    "protraction": _whisking("protraction", "rad", math.radians(5), math.radians(45)),
    "retraction": _whisking("retraction", "rad", math.radians(0), math.radians(25)),
    **{f"object_{name}": _shift(axis) for axis, name in enumerate("xyz")},
}
"""What can be chosen, by name."""


def read_limits(
    scenes: Sequence[Scene], variables: Sequence[str], bounds: Mapping[str, tuple[float, float]]
) -> tuple[Array, Array]:
    """Return the values [p] of variables in some scenes, and their bounds [p, 2]."""
    check_once("--variables", variables)
    check_each("variable of a design", variables, VARIABLES)
    check_each("chosen variable with bounds", bounds, variables)
    limits = np.array([bounds.get(name, (VARIABLES[name].low, VARIABLES[name].high)) for name in variables])
    first = scenes[0]
    if any(one.names != first.names or one.whisking.config() != first.whisking.config() for one in scenes):
        raise UsageError("The scenes of a design have the same whiskers and the same whisking; these differ.")
    begin = np.array([VARIABLES[name].read(first) for name in variables])
    if not (limits[:, 0] < limits[:, 1]).all():
        raise UsageError(f"The bounds of {', '.join(variables)} are a lower and a higher number each.")
    if (begin < limits[:, 0]).any() or (begin > limits[:, 1]).any():
        raise UsageError(f"The given motion lies outside the bounds of {', '.join(variables)}; widen them.")
    return begin, limits


def changed(scene: Scene, names: Sequence[str], values: Array) -> Scene:
    """Return a scene with variables at some values [p]."""
    for name, value in zip(names, values, strict=True):
        scene = VARIABLES[name].change(scene, float(value))
    return scene


SCALE = 0.05  # size of a small change of a variable, as a share of its range
NOTHING = -50.0  # log D² where nothing is felt
SOFTNESS = 0.15  # width of the soft minimum over pairs, in log D²


@limited
class DesignOptions:
    """Sensor, simulation and search of a design."""

    force_noise: Annotated[float, Limit(above=0, unit="N")] = 2e-6
    """Standard deviation of a force reading (N)."""
    moment_noise: Annotated[float, Limit(above=0, unit="N·m")] = 1e-8
    """Standard deviation of a moment reading (N·m)."""
    rate: Annotated[float, Limit(above=0, unit="Hz")] = 1000.0
    """Readings per second."""
    fidelity: str = "balanced"
    """Setting of the search; the result is measured again with `check`."""
    check: str = "accurate"
    """Setting with which default and design are compared at the end."""
    iterations: Count = 12
    """Iterations of the search."""
    starts: Annotated[int, Limit(least=0)] = 16
    """Other motions that are tried before, spread over the bounds."""
    searches: Count = 3
    """Best of these from which the search goes on."""
    seed: Seed = 0
    """Of these."""

    def __post_init__(self) -> None:
        Fidelity.parse(self.fidelity)
        Fidelity.parse(self.check)


@dataclass(frozen=True)
class DesignResult:
    """The chosen motion, and what it is worth."""

    status: Status
    """``unreliable``: at the finer setting it is not better, or whiskers were unstable; ``undefined``: no whisker
    touches anything at the start, so there is nothing to compare with."""
    reason: str
    values: Mapping[str, float]
    """Chosen values, in their units."""
    start: Mapping[str, float]
    distances: Mapping[str, tuple[float, float]]
    """D² of one whisk for each pair of objects: before, after (at the setting `check`)."""
    whisks: float
    """Whisks that the chosen motion needs over those of the given one, for the same distance of the closest pair."""
    time: float
    """The same of the time that these whisks take: slow whisks are long, and have more readings."""
    scenes: tuple[Scene, ...]
    """The scenes with the chosen motion."""
    evaluations: int
    """Motions that were simulated in the search."""


def design(
    scenes: Sequence[Scene],
    variables: Sequence[str],
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    options: DesignOptions | None = None,
    backend: str = DEFAULT_ENGINE,
) -> DesignResult:
    """Choose the motion that tells the objects of some scenes apart in the fewest whisks.

    Args:
        scenes: the same whiskers and motion, each with another object; at least two.
        variables: names of :data:`brainbench.stimuli.fitting.design.VARIABLES`.
        bounds: bounds of single variables, in their units.
        options: sensor, simulation and search.
        backend: physics engine.
    """
    options = options or DesignOptions()
    if len(scenes) < 2:
        raise UsageError("A design needs at least two scenes, each with an object to tell from the others.")
    begin, limits = read_limits(scenes, variables, bounds or {})
    evaluator = _Evaluator(scenes, tuple(variables), options, backend)
    finalists = find_motions(evaluator.worths, evaluator.slope, begin, limits, options)
    # What is best at the coarse setting need not be at the finer one, which has the last word.
    fine = _Evaluator(scenes, tuple(variables), replace(options, fidelity=options.check), backend)
    measured = fine.distances(finalists)
    best = int(np.argmax(np.nan_to_num([_soft_least(one)[0] for one in measured[1:]], nan=-math.inf))) + 1
    return _result(fine, variables, (begin, finalists[best]), (measured[0], measured[best]), evaluator.count)


def find_motions(
    worths: Callable[[Sequence[Array]], list[float]],
    slope: Callable[[Array, Array], tuple[float, Array]] | None,
    begin: Array,
    limits: Array,
    options: DesignOptions,
) -> list[Array]:
    """Return the given motion and the best that were found: ends of searches by gradient, and the best that was tried.

    Args:
        worths: worth of a motion at each of some values [p], more is better; NaN with unstable whiskers.
        slope: worth at some values [p] and its derivatives by them, given the sizes of small changes [p]; NaN and 0
            with unstable whiskers. None where there is no gradient.
        begin, limits, options: values [p] of the given motion, bounds [p, 2], and the search.
    """
    from scipy.optimize import minimize

    width = limits[:, 1] - limits[:, 0]

    def _cost(x: Array) -> tuple[float, Array]:
        value, by = slope(limits[:, 0] + x * width, SCALE * width)  # type: ignore[misc]
        if math.isnan(value):  # unstable: the line search turns back
            return -NOTHING, np.zeros(len(x))
        return -value, -by * width

    # The search runs over the unit cube, in which all variables have one scale.
    at = (begin - limits[:, 0]) / width
    others = np.random.default_rng(options.seed).uniform(size=(options.starts, len(at)))
    tried = [at, *others]
    first = worths([limits[:, 0] + x * width for x in tried])
    if not np.isfinite(first[0]):
        raise DataError("Whiskers are unstable with the given motion; simulate the scenes more finely.")
    order = np.argsort(-np.nan_to_num(first, nan=-math.inf))[: options.searches]
    best = [tried[index] for index in order]
    if slope is not None:
        how = {"maxiter": options.iterations, "maxls": 8}
        bounds = [(0, 1)] * len(at)
        ends = [minimize(_cost, x, jac=True, bounds=bounds, method="L-BFGS-B", options=how).x for x in best]
        best = [*ends, best[0]]
    return [begin, *(limits[:, 0] + x * width for x in best)]


def _result(
    fine: _Evaluator, variables: Sequence[str], values: tuple[Array, Array], distances: tuple[Array, Array], count: int
) -> DesignResult:
    before, after = distances
    pairs = [f"{a} – {b}" for a, b in combinations([scene.label for scene in fine.scenes], 2)]
    ratio, status, reason = math.nan, "ok", ""
    if not np.isfinite(after).all() or not np.isfinite(before).all():
        status, reason = "unreliable", "Whiskers are unstable at the finer setting."
    elif not before.min() > 0:
        status, reason = "undefined", "With the given motion some objects are not felt, or are felt alike."
    else:
        ratio = float(before.min() / after.min())
        if ratio >= 1:
            status, reason = "unreliable", "At the finer setting the chosen motion is no better than the given one."
    return DesignResult(
        status=status,  # type: ignore[arg-type]
        reason=reason,
        values=dict(zip(variables, values[1].tolist(), strict=True)),
        start=dict(zip(variables, values[0].tolist(), strict=True)),
        distances={pair: (float(a), float(b)) for pair, a, b in zip(pairs, before, after, strict=True)},
        whisks=ratio,
        time=ratio * fine.period(values[1]) / fine.period(values[0]),
        scenes=tuple(changed(scene, fine.names, values[1]) for scene in fine.scenes),
        evaluations=count,
    )


def _soft_least(distances: Array) -> tuple[float, Array]:
    """Return a smooth lower bound of the smallest log D², NaN with unstable whiskers, and its slope by each log D²."""
    if np.isnan(distances).any():
        return math.nan, np.zeros(len(distances))
    # −s log Σ exp(−xᵢ/s), the largest shift taken out so that nothing overflows.
    logs = np.log(np.maximum(distances, math.exp(NOTHING)))
    least = float(logs.min())
    weights = np.exp(-(logs - least) / SOFTNESS)
    return least - SOFTNESS * math.log(float(weights.sum())), weights / weights.sum()


class _Evaluator:
    """Distances between the objects of scenes, at values of the variables."""

    def __init__(self, scenes: Sequence[Scene], names: tuple[str, ...], options: DesignOptions, backend: str) -> None:
        self.scenes, self.names, self.options = list(scenes), names, options
        self.engine = get_engine(backend)
        twist = self.engine.twists and any(scene.twist for scene in scenes)
        self.fidelity = Fidelity.of(options.fidelity).resolved(twist)
        self.noise = np.repeat([options.force_noise, options.moment_noise], 3)
        self.count = 0

    def worths(self, points: Sequence[Array]) -> list[float]:
        """Return the soft minimum of log D² at each of some values [p]; NaN with unstable whiskers."""
        return [_soft_least(one)[0] for one in self.distances(points)]

    def period(self, values: Array) -> float:
        """Return the time [s] of one whisk at some values."""
        return 1 / getattr(changed(self.scenes[0], self.names, values).whisking, "frequency", 1.0)

    def distances(self, points: Sequence[Array]) -> list[Array]:
        """Return D² [pair] of one whisk, after the onset, at each of some values; NaN with unstable whiskers."""
        jobs = [job for values in points for job in self._jobs(values, self._times(values))]
        self.count += len(points)
        traces = self.engine.run(jobs, self.fidelity)
        some = len(jobs) // len(points)
        return [self._apart(traces[begin : begin + some])[0] for begin in range(0, len(jobs), some)]

    def slope(self, values: Array, scales: Array) -> tuple[float, Array]:
        """Return the soft minimum of log D² at some values [p], and its derivatives by them; NaN and 0 if unstable."""
        times = self._times(values)
        run = GradientRun(lambda moved: self._jobs(moved, times), values, scales=scales, fidelity=self.fidelity)
        self.count += 1
        distances, gaps = self._apart(run.traces)
        least, weights = _soft_least(distances)
        if math.isnan(least) or not distances.all():
            return least, np.zeros(len(values))
        by_wrench = np.zeros_like(gaps, shape=(len(self.scenes), *gaps.shape[1:]))
        for (a, b), gap, share in zip(self._pairs, gaps, weights / distances, strict=True):
            by_wrench[a] += 2 * share * gap / self.noise
            by_wrench[b] -= 2 * share * gap / self.noise
        slope = run.gradient(list(by_wrench.reshape(-1, len(times), 6))).values
        if "frequency" in self.names:
            # Slower whisks have more readings; the run has those of one whisk at the given frequency.
            slope[self.names.index("frequency")] -= 1 / values[self.names.index("frequency")]
        return least, slope

    @property
    def _pairs(self) -> list[tuple[int, int]]:
        return list(combinations(range(len(self.scenes)), 2))

    def _times(self, values: Array) -> Array:
        """Return the times [n] (s) of the readings of one whisk, after the onset."""
        whisking = changed(self.scenes[0], self.names, values).whisking
        count = max(int(self.options.rate * self.period(values)), 2)
        return getattr(whisking, "onset", 0.0) + np.arange(1, count + 1) / self.options.rate

    def _jobs(self, values: Array, times: Array) -> list[Job]:
        some = [changed(scene, self.names, values) for scene in self.scenes]
        return [replace(job, times=times) for scene in some for job in scene.jobs()]

    def _apart(self, traces: Sequence[Trace]) -> tuple[Array, Array]:
        """Return D² [pair] of one whisk, and how far pairs are apart [pair, whisker, n, 6] in units of the noise."""
        felt = np.stack([trace.wrench for trace in traces]) / self.noise
        felt = felt.reshape(len(self.scenes), -1, *felt.shape[1:])
        gaps = np.stack([felt[a] - felt[b] for a, b in self._pairs])
        return np.sum(gaps**2, axis=(1, 2, 3)), gaps
