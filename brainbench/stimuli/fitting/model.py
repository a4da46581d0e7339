"""The model of a fit: coordinates of the parameters → whitened residuals over all trials, and where a fit begins.

Letters: m reading, p parameter, g noise group (a channel of a wrench, or shapes).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import MOST_LINKS, Fidelity
from brainbench.stimuli.fitting.gradients import GradientRun, Tangents
from brainbench.stimuli.fitting.parameters import FitOptions, FreeParameters
from brainbench.stimuli.fitting.trials import Trial
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.validation import references

Array = NDArray[np.float64]
SCALE = 5e-3  # size of a small change of a coordinate
SHORTER = 2.5
"""Divisor of the time step of the simulations that show how far an estimate is from that of a finer simulation."""
FEWEST = 20
"""Readings of a noise group from which it has a noise of its own. A fit can follow fewer so closely that their noise
seems small, and then goes by them alone: of the intervals from three instants 60 % contained the truth."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Where each reading of the residuals comes from."""

    trial: NDArray[np.int_]
    """[m] trial it belongs to."""
    place: NDArray[np.int_]
    """[m, 3] instant, point (0 for wrenches) and channel or direction."""
    group: NDArray[np.int_]
    """[m] noise group."""
    groups: tuple[str, ...]
    """[g] name of each noise group: Fx … Mz, or shape."""
    noise: Array
    """[g] standard deviation that repeats tell (N, N·m, m); NaN where it is estimated."""
    size: Array
    """[g] root mean square of the readings, or of shapes a hundredth of the whisker's length."""

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> Readings:
        """Return the readings of some trials: every finite number that was measured."""
        names = tuple(dict.fromkeys(name for trial in trials for name in trial.channels))
        rows: list[NDArray[np.int_]] = []
        owners, groups = [], []
        noise, squares, counts = np.full(len(names), np.nan), np.zeros(len(names)), np.zeros(len(names))
        for index, trial in enumerate(trials):
            values = trial.measured["shape" if trial.of_shapes else "wrench"].values
            if trial.of_shapes:
                directions = values.shape[-1] - 1
                measured = np.repeat(np.isfinite(values).all(axis=-1, keepdims=True), directions, axis=-1)
                group = np.full(measured.shape, names.index("shape"))
                sizes = np.full(measured.shape, trial.job.whisker.arc_length / 100)
            else:
                # A component that is zero throughout was not measured, or is zero by symmetry: it tells nothing.
                measured = (np.isfinite(values) & np.any(np.nan_to_num(values) != 0, axis=0))[:, None, :]
                channel = np.array([names.index(name) for name in trial.channels])
                group, sizes = np.broadcast_to(channel, measured.shape), np.nan_to_num(values)[:, None, :]
            rows.append(np.argwhere(measured))
            owners.append(np.full(len(rows[-1]), index))
            groups.append(group[measured])
            np.add.at(squares, group[measured], sizes[measured] ** 2)
            np.add.at(counts, group[measured], 1)
            if "noise" in trial.measured:
                stated = np.broadcast_to(trial.measured["noise"].values, len(trial.channels))
                mine = [names.index(name) for name in trial.channels]
                if (np.isfinite(noise[mine]) & (noise[mine] != stated)).any():
                    raise DataError("Two trials state a different noise of one channel; a fit takes one of each.")
                noise[mine] = stated
        size = np.sqrt(squares / np.maximum(counts, 1))
        # Small components are no more reliable than large ones of the same kind.
        for kind in ("F", "M", "s"):
            same = [i for i, name in enumerate(names) if name.startswith(kind)]
            size[same] = np.maximum(size[same], 0.1 * size[same].max(initial=0.0))
        return cls(np.concatenate(owners), np.concatenate(rows).astype(int), np.concatenate(groups), names, noise, size)

    def __len__(self) -> int:
        return len(self.trial)


@dataclass(eq=False)
class FitModel:
    """Simulates the trials of a fit; counts the whiskers that it simulated."""

    trials: Sequence[Trial]
    free: FreeParameters
    options: FitOptions

    def __post_init__(self) -> None:
        self.readings = Readings.of(self.trials)
        if len(self.readings) <= len(self.free):
            raise DataError(
                f"{len(self.readings)} measured numbers cannot tell {len(self.free)} parameters; measure longer or fit "
                "fewer parameters."
            )
        self.reset_noise()
        self.limits = self.free.limits()
        self.fidelity = self._fidelity()
        self._last: GradientRun | None = None
        self.simulated = 0
        self.reason = ""
        """Why a simulation could not be trusted, of the last that was not."""

    def reset_noise(self) -> None:
        """Take the noise that repeats tell, or the size of the readings where there is none."""
        self.sigma = np.where(np.isfinite(self.readings.noise), self.readings.noise, self.readings.size)
        """[g] standard deviation by which residuals are divided (N, N·m, m)."""

    def deviance(self, residual: Array) -> float:
        """Return −2 log likelihood, but for a constant, of residuals [m, or more: priors] divided by the noise."""
        return float(residual @ residual) + 2 * float(np.log(self.sigma[self.readings.group]).sum())

    def _fidelity(self) -> Fidelity:
        """Return the fidelity of all simulations: a step that stays, so that the residuals are smooth."""
        whisker = self.free.start.whisker
        first = float(references.natural_frequencies(whisker, 1)[0])
        options = self.options
        step = min(options.time_step, 1 / (options.steps_per_period * first))
        return Fidelity(
            links=options.links,
            time_step=max(step, 1e-7),
            precision="double",
            solver=options.solver,
            twist=options.twist,
        )

    def least_damping(self, u: Array) -> float:
        """Return the damping ratio that the time step alone gives the first mode at coordinates u [p]."""
        if self.options.solver == "quasistatic":
            return 0.0
        first = float(references.natural_frequencies(self.free.condition(u).whisker, 1)[0])
        return math.pi * first * self.fidelity.time_step

    def run(self, u: Array) -> GradientRun:
        """Simulate every trial at coordinates u [p], or return the last run if it was there."""
        # Packing is differentiated by small changes, which must not lie beyond a bound. The last run is kept, because
        # SciPy asks for the residuals and then for the Jacobian at the same place.
        u = np.clip(u, self.limits[0] + SCALE / 1000, self.limits[1] - SCALE / 1000)
        if self._last is None or not np.array_equal(self._last.values, u):
            self._last = GradientRun(self._jobs, u, scales=np.full(len(u), SCALE), fidelity=self.fidelity)
            self.simulated += len(self.trials)
        return self._last

    def _jobs(self, u: Array) -> list[Job]:
        condition = self.free.condition(u)
        if "deflection" in self.free.names:
            return [trial.job_of(condition) for trial in self.trials]
        bent = [trial.condition["deflection"] for trial in self.trials]  # each keeps its own
        return [trial.job_of(condition.changed({"deflection": d})) for trial, d in zip(self.trials, bent, strict=True)]

    def residual(self, u: Array) -> Array:
        """Return the whitened residuals [m] at coordinates u [p]; NaN where a simulation cannot be trusted."""
        return self._residual(u, self._traces(u))

    def refined(self, u: Array) -> list[Array]:
        """Return by how much the residuals [m] at coordinates u [p] change in shorter steps, and with more links."""
        # First the step alone, then step and links: two independent parts of the error, each by its own change.
        shorter = replace(self.fidelity, time_step=max(self.fidelity.time_step / SHORTER, 1e-7))
        finer = replace(shorter, links=min(2 * shorter.links, MOST_LINKS))
        coarse, *others = (self.scan([u], fidelity)[0] for fidelity in (self.fidelity, shorter, finer))
        return [other - coarse for other in others]

    def scan(self, points: Sequence[Array], fidelity: Fidelity | None = None) -> list[Array]:
        """Return the residuals [m] at each of many coordinates [p], simulated in one run of the engine."""
        jobs = [self._jobs(u) for u in points]
        shapes = any(trial.of_shapes for trial in self.trials)
        traces = iter(get_engine("rod").run(list(chain(*jobs)), fidelity or self.fidelity, record_shape=shapes))
        self.simulated += len(points) * len(self.trials)
        return [self._residual(u, list(islice(traces, len(self.trials)))) for u in points]

    def _residual(self, u: Array, traces: Sequence[Trace]) -> Array:
        whisker = self.free.condition(u).whisker
        return self._whitened([
            trial.residuals(trace, whisker) for trial, trace in zip(self.trials, traces, strict=True)
        ])  # fmt: skip

    def jacobian(self, u: Array) -> Array:
        """Return the derivatives [m, p] of the whitened residuals."""
        # Chain rule: ∂r/∂u = ∂r/∂(wrench, shape) · ∂(wrench, shape)/∂u + ∂r/∂(whisker) · ∂(whisker)/∂u. The
        # second factor of the first term is exact.
        tangents = self.run(u).tangents()
        traces = self._traces(u)
        columns = []
        for p, step in enumerate(SCALE * np.eye(len(u))):
            # How residuals follow from shapes, and from the length of the whisker, is differentiated by differences.
            ends = [self.free.condition(u + sign * step).whisker for sign in (1, -1)]
            changes = []
            for trial, trace, tangent in zip(self.trials, traces, tangents, strict=True):
                above, below = (
                    trial.residuals(_moved(trace, tangent, p, sign * SCALE), whisker)
                    for sign, whisker in zip((1, -1), ends, strict=True)
                )
                changes.append((above - below) / (2 * SCALE))
            columns.append(self._whitened(changes))
        jacobian = np.stack(columns, axis=1)
        if not np.isfinite(jacobian).all():
            raise DataError("The whisker becomes unstable here; no derivative exists. Fit with a shorter time step.")
        return jacobian

    def _traces(self, u: Array) -> list[Trace]:
        traces = self.run(u).traces
        self.reason = next((trace.reason for trace in traces if trace.status != "ok"), self.reason)
        return traces

    def _whitened(self, values: Sequence[Array]) -> Array:
        """Return the readings [m] among residuals, or changes of these, of each trial, divided by the noise."""
        readings = self.readings
        parts = []
        for index, (trial, some) in enumerate(zip(self.trials, values, strict=True)):
            some = some if trial.of_shapes else some[:, None, :]
            parts.append(some[tuple(readings.place[readings.trial == index].T)])
        return np.concatenate(parts) / self.sigma[readings.group]

    def update_noise(self, residual: Array, sigma: Array) -> None:
        """Estimate the noise of each group from residuals [m] that were divided by ``sigma`` [g], where none is known.

        Of the squares of n readings with p free parameters, n − p are noise; each group is taken to give up its share.
        Groups with fewer than :data:`FEWEST` readings have the relative noise of all, over the largest of their kind.
        """
        # E Σ r² = σ² (n − p), so that the mean square is divided by 1 − p/n.
        readings, total = self.readings, len(self.readings)
        share = 1 - len(self.free) / total
        some = [index for index in np.flatnonzero(~np.isfinite(readings.noise)) if (readings.group == index).any()]
        largest = [
            max(size for other, size in zip(readings.groups, readings.size, strict=True) if other[0] == name[0])
            for name in readings.groups
        ]
        left = {index: residual[readings.group == index] * sigma[index] for index in some}
        shared = np.concatenate([left[index] / largest[index] for index in some]) if len(some) > 1 else np.zeros(0)
        for index in some:
            few = len(left[index]) < FEWEST and len(shared)
            square = largest[index] ** 2 * float(np.mean(shared**2)) if few else float(np.mean(left[index] ** 2))
            # Without any noise the numbers of the simulation are exact to about this.
            self.sigma[index] = max(math.sqrt(square / share), 1e-6 * readings.size[index], 1e-300)


def _moved(trace: Trace, tangent: Tangents, p: int, way: float) -> Trace:
    """Return a trace moved along the derivative by a parameter."""
    shape = trace.link_positions
    assert shape is not None
    wrench = trace.wrench + way * tangent.wrench[p]
    return replace(trace, wrench=wrench, link_positions=shape + way * tangent.link_positions[p])


SWING = ("young_modulus", "density", "arc_length", "base_radius")
"""Parameters that set the frequency of a swing; the first that is free is scanned."""
MOST, WORSE = 5, 4.0
"""Minima from which a fit is begun, of those whose sum of squares is at most so many times the least."""
PER_SWING = 6
"""Points for each swing that is seen: the nearest to a minimum is then out of step by half a radian at most."""
_FEWEST, _MOST_POINTS = 9, 129


# A swing that begins out of step leads least squares to a wrong number of swings, and readings rarer than two in a
# period fit several frequencies equally well. Both are local minima of the likelihood over the one parameter that sets
# the frequency, so that parameter is scanned before the fit, finely enough that no minimum lies between two points.
def scanned(model: FitModel) -> int | None:
    """Return the index of the parameter whose range is scanned; None when no trial is a ring-down, or it is known."""
    if not any(trial.pluck for trial in model.trials):
        return None
    return next((model.free.names.index(name) for name in SWING if name in model.free.names), None)


def find_starts(model: FitModel) -> list[Array]:
    """Return coordinates [p] at which fits begin: the lowest minima of the scan, or the start values alone."""
    start, index = np.zeros(len(model.free)), scanned(model)
    if index is None:
        return [start]
    points = np.tile(start, (_count(model, index), 1))
    low, high = (float(limit[index]) for limit in model.limits)
    points[:, index] = np.linspace(low, high, len(points) + 2)[1:-1]
    points = np.insert(points, int(np.searchsorted(points[:, index], 0.0)), start, axis=0)
    values = np.array([float(one @ one) for one in model.scan(list(points))])
    values[~np.isfinite(values)] = math.inf
    walled = np.concatenate([[math.inf], values, [math.inf]])
    least = np.flatnonzero((values <= walled[:-2]) & (values <= walled[2:]) & np.isfinite(values))
    least = least[np.argsort(values[least], kind="stable")[:MOST]]
    return [points[place] for place in least if values[place] <= WORSE * values[least[0]]] or [start]


def _count(model: FitModel, index: int) -> int:
    """Return how many points are scanned, evenly in the logarithm of the frequency."""
    unit = np.eye(len(model.free))[index]
    whiskers = [model.free.condition(float(limit[index]) * unit).whisker for limit in model.limits]
    ends = [float(references.natural_frequencies(one, 1)[0]) for one in whiskers]
    duration = max(float(trial.job.times[-1]) for trial in model.trials if trial.pluck)
    # A swing of damping ratio ζ has fallen to e⁻² after 1 / (π ζ) periods.
    swings = min(duration * max(ends), 1 / (math.pi * max(whiskers[0].damping_ratio, 0.01)))
    wanted = math.ceil(PER_SWING * swings * abs(math.log(ends[1] / ends[0]))) + 1
    return min(max(wanted, _FEWEST), _MOST_POINTS)
