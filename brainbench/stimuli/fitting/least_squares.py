"""Fit parameters of whiskers to measurements by nonlinear least squares, with confidence intervals.

Letters: m residual, p parameter. Sums of squares S are of whitened residuals, priors included as residuals.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, check_each
from brainbench.core.files import provenance
from brainbench.core.records import Interval, Status
from brainbench.stimuli.fitting.model import FitModel, find_starts, scanned
from brainbench.stimuli.fitting.parameters import PARAMETERS, PUBLISHED, FitOptions, FreeParameters, Prior
from brainbench.stimuli.fitting.result import (
    FitResult,
    FittedParameter,
    check_residuals,
    check_wrenches,
    dead_channels,
    directions,
    failed_words,
    other_sizes,
    unknown_parameters,
)
from brainbench.stimuli.fitting.trials import Trial

Array = NDArray[np.float64]
WIDEST = 12.0  # distance from the estimate, in coordinates, at which an interval counts as open (a factor of 160,000)
_STEPS = 12  # points at which the profile is looked at on each side


def quantile(level: float, freedom: float) -> float:
    """Return Student's t of a two-sided interval; the normal one for infinitely many degrees of freedom."""
    from scipy.special import ndtri, stdtrit

    share = (1 + level) / 2
    return float(stdtrit(freedom, share)) if math.isfinite(freedom) else float(ndtri(share))


def laplace_interval(free: FreeParameters, index: int, u: Array, deviation: float, level: float, t: float) -> Interval:
    """Return the interval u ± t s of one parameter, in its unit; infinite where the deviation s is."""
    half = t * deviation if math.isfinite(deviation) else math.inf
    return _interval(free, index, u[index] - half, u[index] + half, level, "Laplace")


def _interval(free: FreeParameters, index: int, low: float, high: float, level: float, method: str) -> Interval:
    name = free.names[index]
    parameter, start = PARAMETERS[name], free.start[name]

    def _value(end: float) -> float:
        if abs(end) <= 700:
            return parameter.value(start, end, free.start.whisker)
        return (0.0 if end < 0 else math.inf) if parameter.kind == "log" else end

    first, second = _value(low), _value(high)
    return Interval(min(first, second), max(first, second), level, method)


@dataclass(frozen=True, eq=False)
class Profile:
    """The likelihood along one parameter, maximised over the others."""

    residual: Callable[[Array], Array]
    jacobian: Callable[[Array], Array]
    limits: tuple[Array, Array]
    best: Array
    """[p]"""
    covariance: Array
    """[p, p] at the best fit, scaled by the noise."""
    least: float
    """Sum of squares at the best fit."""
    scale: float
    """Variance of a whitened residual."""

    def interval(self, free: FreeParameters, index: int, level: float, t: float, error: float = 0.0) -> Interval:
        """Return where (S − S_min)/s² stays below t² along a parameter; a side that reaches its bound ends there.

        ``error`` is another standard deviation of the coordinate, which does not depend on the data's.
        """
        best = self.best[index]
        low, high = (best + side * math.hypot(self._end(index, side, t) - best, t * error) for side in (-1, 1))
        return _interval(free, index, low, high, level, "profile likelihood")

    def _end(self, index: int, side: int, t: float) -> float:
        deviation = math.sqrt(max(float(self.covariance[index, index]), 0.0))
        bound = float(self.limits[0 if side < 0 else 1][index])
        most = min(abs(bound - self.best[index]), WIDEST)
        if not math.isfinite(deviation) or most <= 0:
            return bound
        near, far = (0.0, 0.0), None
        reach = min(t * deviation, most)
        # The signed root of the fall is nearly linear in the coordinate, so the secant through 0 is a good guess.
        for _ in range(_STEPS):
            fall = self._fall(index, self.best[index] + side * reach)
            if abs(fall - t) < 0.01 * t:
                return self.best[index] + side * reach
            if fall < t:
                near = (reach, fall)
                if reach >= most:
                    return bound
            else:
                far = (reach, fall)
            if far is None:
                reach = min(reach * min(max(1.05 * t / max(fall, 1e-3), 1.05), 3.0), most)
            else:
                share = (t - near[1]) / max(far[1] - near[1], 1e-12)
                reach = near[0] + min(max(share, 0.05), 0.95) * (far[0] - near[0])
        return self.best[index] + side * reach

    def _fall(self, index: int, place: float) -> float:
        """Return √((S − S_min)/s²) with one coordinate at a place and the others at their best."""
        from scipy.optimize import least_squares

        others = [j for j in range(len(self.best)) if j != index]
        u = self.best.copy()
        # Along the profile the others follow their regression on this one.
        u += self.covariance[:, index] / max(float(self.covariance[index, index]), 1e-300) * (place - u[index])
        u[index] = place
        u = np.clip(u, self.limits[0] + 1e-9, self.limits[1] - 1e-9)
        u[index] = place

        def _full(rest: Array) -> Array:
            point = u.copy()
            point[others] = rest
            return point

        if others:
            minimum = least_squares(
                lambda rest: self.residual(_full(rest)),
                u[others],
                jac=lambda rest: self.jacobian(_full(rest))[:, others],  # type: ignore[arg-type]
                bounds=(self.limits[0][others], self.limits[1][others]),
                max_nfev=8,
                ftol=1e-6,
                xtol=1e-5,
            )
            squares = 2 * float(minimum.cost)
        else:
            squares = float(np.sum(self.residual(u) ** 2))
        return math.sqrt(max(squares - self.least, 0.0) / self.scale)


_ROUNDS = 3  # fits with the noise of each channel estimated anew; it settles in two
STATED = 5.0  # fitted over stated deflection of a plucked whisker, or its inverse, from which a unit is wrong
ALIKE = 16.0  # difference of the deviance (−2 log likelihood) up to which two minima fit alike: odds of 3,000 to one


def fit(
    trials: Trial | Sequence[Trial],
    parameters: Sequence[str],
    *,
    start: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, Prior] | None = None,
    options: FitOptions | None = None,
) -> FitResult:
    """Estimate parameters of a whisker from one or several trials of it.

    Args:
        trials: what was measured, with motion and objects; the fit starts from the whisker of the first.
        parameters: names of :data:`brainbench.stimuli.fitting.parameters.PARAMETERS`.
        start: start values of parameters, free or not, in place of the trials'.
        bounds: bounds of single parameters, in their units.
        priors: priors of single parameters, beside those that the options name.
        options: how the fit simulates, weighs and judges.

    Returns:
        Estimates with intervals, noise, tests of the residuals, and a status with reasons.
    """
    began = time.perf_counter()
    trials, options = [trials] if isinstance(trials, Trial) else list(trials), options or FitOptions()
    if not trials:
        raise UsageError("There is no trial to fit.")
    condition = trials[0].condition
    if start:
        FreeParameters(tuple(start), condition)
        condition = condition.changed(start)
    if "deflection" in (start or {}):
        trials = [
            replace(trial, pluck=replace(trial.pluck, deflection=condition["deflection"])) if trial.pluck else trial
            for trial in trials
        ]
    free = FreeParameters(tuple(parameters), condition, bounds or {})
    check_each("fitted parameter with a prior", priors or {}, free.names)
    model = FitModel(trials, free, options)
    chosen = {**(PUBLISHED if options.priors == "published" else {}), **(priors or {})}
    problem = _Problem(model, {index: chosen[name] for index, name in enumerate(free.names) if name in chosen})
    begin = np.zeros(len(free))
    if not np.isfinite(model.residual(begin)).all():
        raise DataError(
            f"The whisker is unstable at the start values ({model.reason or 'no reading'}); start nearer to the truth, "
            "or with a shorter time step."
        )
    check_wrenches(trials, model.run(begin).traces)
    solutions = sorted((problem.solve(u) for u in find_starts(model)), key=lambda solution: solution.deviance)
    return _judge(problem, solutions, began)


@dataclass(frozen=True, eq=False)
class _Solution:
    """A minimum."""

    u: Array  # [p] coordinates
    sigma: Array  # [g] noise of each group (N, N·m, m)
    deviance: float  # −2 log likelihood, but for a constant
    converged: bool
    iterations: int


class _Problem:
    """Residuals with priors as more of them, and their minimum."""

    def __init__(self, model: FitModel, priors: Mapping[int, Prior]) -> None:
        self.model, self.priors = model, priors
        free = model.free
        rows = [prior.row(free.names[i], free.start[free.names[i]], free.start.whisker) for i, prior in priors.items()]
        self.mean, self.spread = np.array(rows).reshape(-1, 2).T
        self.prior_jacobian = np.zeros((len(rows), len(free)))
        for row, index in enumerate(priors):
            self.prior_jacobian[row, index] = 1 / self.spread[row]

    def residual(self, u: Array) -> Array:
        """Return the whitened residuals [m + priors] at coordinates u [p]."""
        return np.concatenate([self.model.residual(u), (u[list(self.priors)] - self.mean) / self.spread])

    def jacobian(self, u: Array) -> Array:
        """Return their derivatives."""
        return np.concatenate([self.model.jacobian(u), self.prior_jacobian])

    def solve(self, start: Array) -> _Solution:
        """Return the minimum that is reached from coordinates [p]."""
        from scipy.optimize import least_squares

        u, iterations, minimum = start, 0, None
        stated = bool(np.isfinite(self.model.readings.noise).all())
        self.model.reset_noise()
        for _ in range(1 if stated else _ROUNDS):
            low, high = self.model.limits
            # Counted from −1: SciPy's first step is as long as the start is far from 0, where the coordinates begin.
            minimum = least_squares(
                lambda moved: self.residual(moved - 1),
                np.clip(u, low + 1e-6, high - 1e-6) + 1,
                jac=lambda moved: self.jacobian(moved - 1),  # type: ignore[arg-type]
                bounds=(low + 1, high + 1),
                loss=self.model.options.loss,
                # A change of the cost by this share moves no coordinate by a hundredth of its standard deviation.
                ftol=1e-7,
                xtol=1e-5,
                gtol=1e-9,
                max_nfev=self.model.options.most_iterations,
            )
            step = float(np.abs(minimum.x - 1 - u).max())
            u, iterations = minimum.x - 1, iterations + int(minimum.njev)
            before = self.model.sigma.copy()
            self.model.update_noise(self.model.residual(u), before)
            if minimum.status <= 0 or (step < 1e-3 and np.allclose(before, self.model.sigma, rtol=0.05)):
                break
        # Minima with other noise have other whitened residuals: only the likelihood compares them.
        deviance = self.model.deviance(self.residual(u))
        return _Solution(u, self.model.sigma.copy(), deviance, minimum is not None and minimum.status > 0, iterations)


def _judge(problem: _Problem, solutions: Sequence[_Solution], began: float) -> FitResult:
    """Return the result at the first of the minima; the others, in order of their deviance, may fit as well."""
    model, free, options = problem.model, problem.model.free, problem.model.options
    best = solutions[0]
    u, model.sigma = best.u, best.sigma
    residual, jacobian = model.residual(u), model.jacobian(u)
    freedom = len(residual) - len(free)
    stated = bool(np.isfinite(model.readings.noise).all())
    scale = 1.0 if stated else float(residual @ residual) / freedom
    combinations = directions(jacobian, free.names, math.sqrt(scale))
    # Fisher information of the readings, and that of the priors, which no estimated noise scales.
    information = jacobian.T @ jacobian / scale + problem.prior_jacobian.T @ problem.prior_jacobian
    covariance = _inverse(information)
    errors = _simulation_errors(problem, u, jacobian, scale)
    # Student's t, because the noise is estimated from the same residuals.
    t = quantile(options.level, math.inf if stated else freedom)
    profile = None
    if options.intervals == "profile":
        least = float(np.sum(problem.residual(u) ** 2))
        profile = Profile(problem.residual, problem.jacobian, model.limits, u, covariance, least, scale)
    unknown = {name: direction.words for name, direction in unknown_parameters(combinations).items()}
    # Priors took part in the comparison of minima, so that none makes up for it.
    rivals = _rivals(problem, solutions, covariance)
    estimates = []
    for index, (name, value) in enumerate(zip(free.names, free.values(u), strict=True)):
        deviation = math.sqrt(covariance[index, index]) if covariance[index, index] >= 0 else math.inf
        error = float(errors[index])
        rival = rivals.get(name)
        interval = laplace_interval(free, index, u, math.hypot(deviation, error), options.level, t)
        status, reason = _judge_one(problem, index, u, unknown.get(name), error)
        if rival:
            status, reason = "undefined", rival
        elif status == "ok" and (reason := _unlikely(free, index, value, interval)):
            status = "unreliable"
        estimates.append(
            FittedParameter(
                name,
                PARAMETERS[name].unit,
                value,
                free.start[name],
                deviation,
                error,
                interval,
                profile.interval(free, index, options.level, t, error) if profile and status != "undefined" else None,
                problem.priors.get(index),
                status,
                reason,
            )
        )
    tests = check_residuals(residual, jacobian, model.readings)
    traces = model.run(u).traces
    reasons = [
        *(() if best.converged else (f"The fit did not converge within {options.most_iterations} iterations.",)),
        *dict.fromkeys(one.reason for one in estimates if one.reason),
        *failed_words(tests),
        *dead_channels(model.trials, traces),
        *other_sizes(model.trials, traces),
    ]
    worst = {one.status for one in estimates} | ({"unreliable"} if reasons else {"ok"})
    status: Status = "undefined" if not best.converged or "undefined" in worst else "unreliable" if reasons else "ok"
    whisker = free.condition(u).whisker
    predicted = tuple(
        trace.link_positions
        if trial.of_shapes and trace.link_positions is not None
        else trial.residuals(trace, trial.job.whisker) + trial.measured["wrench"].values
        for trial, trace in zip(model.trials, traces, strict=True)
    )
    return FitResult(
        status=status,
        reasons=tuple(reasons),
        estimates=tuple(estimates),
        noise={name: float(level) for name, level in zip(model.readings.groups, model.sigma, strict=True)},
        directions=combinations,
        tests=tests,
        whisker=whisker,
        residuals=tuple(trial.residuals(trace, whisker) for trial, trace in zip(model.trials, traces, strict=True)),
        predicted=predicted,
        covariance=covariance,
        iterations=sum(one.iterations for one in solutions),
        provenance=provenance(
            options=options,
            seconds=time.perf_counter() - began,
            jacobian="forward derivatives of the simulated steps",
            fidelity=model.fidelity,
            simulated_whiskers=model.simulated,
        ),
    )


def _simulation_errors(problem: _Problem, u: Array, jacobian: Array, scale: float) -> Array:
    """Return how far [p] shorter steps, and more links too, move the minimum at coordinates u [p].

    One Gauss-Newton step with the Jacobian of the fit itself. Both together are about as large as the distance from the
    truth: in contact it was ten times the standard deviation by a noise of 1 %.
    """
    both = np.concatenate([jacobian / math.sqrt(scale), problem.prior_jacobian])
    moves = np.zeros((len(u), 2))
    for column, change in enumerate(problem.model.refined(u)):
        # NaN where a finer simulation cannot be trusted: then nothing is known of the error.
        change = np.concatenate([change / math.sqrt(scale), np.zeros(len(problem.prior_jacobian))])
        moves[:, column] = np.linalg.lstsq(both, change)[0] if np.isfinite(change).all() else math.inf
    return np.hypot(*moves.T)


def _rivals(problem: _Problem, solutions: Sequence[_Solution], covariance: Array) -> dict[str, str]:
    """Return why the scanned parameter cannot be told, by its name, where another minimum fits as well as the best."""
    model, index, best = problem.model, scanned(problem.model), solutions[0]
    if index is None:
        return {}
    # Two searches that end in one minimum differ by far less than its standard deviation.
    apart = math.sqrt(max(float(covariance[index, index]), 0.0))
    for rival in solutions[1:]:
        if rival.deviance < best.deviance + ALIKE and abs(rival.u[index] - best.u[index]) > max(apart, 0.01):
            name, unit = model.free.names[index], PARAMETERS[model.free.names[index]].unit
            values = sorted(model.free.values(one.u)[index] for one in (best, rival))
            return {
                name: f"{name} of {values[0]:.4g} and of {values[1]:.4g} {unit} fit alike: the readings are too rare "
                "or too few to tell how often the whisker swings; read more often, or give narrower bounds."
            }
    return {}


def _judge_one(problem: _Problem, index: int, u: Array, unknown: str | None, error: float) -> tuple[Status, str]:
    """Return the status of one parameter, and why."""
    model, name = problem.model, problem.model.free.names[index]
    if unknown is not None:
        if index in problem.priors:
            return "unreliable", f"{unknown} {name} is known by its prior."
        return "undefined", unknown
    low, high = (float(limit[index]) for limit in model.limits)
    if min(u[index] - low, high - u[index]) < 1e-3 * min(high - low, 1.0):
        end = "lower" if u[index] - low < high - u[index] else "upper"
        return "unreliable", f"{name} is at its {end} bound, so that its interval means nothing; widen the bounds."
    if name == "damping_ratio" and (value := model.free.values(u)[index]) < 1.2 * (least := model.least_damping(u)):
        return "unreliable", (
            f"damping_ratio is {value:.3g}, and the time step alone damps with {least:.3g}; fit with "
            "more steps_per_period."
        )
    if math.isinf(error):
        return "unreliable", (
            "The fitted whisker is unstable with shorter steps or more links, so that nothing tells the error of the "
            "simulation; fit with more links or steps_per_period."
        )
    return "ok", ""


def _unlikely(free: FreeParameters, index: int, value: float, interval: Interval) -> str:
    """Return why a value can hardly be right though the data tell it; empty for nothing.

    A value that the user began beyond the usual ones, such as that of a steel wire, is meant.
    """
    name, start = free.names[index], free.start[free.names[index]]
    parameter = PARAMETERS[name]
    low, high = (start / STATED, start * STATED) if name == "deflection" else parameter.real
    if not (low <= start <= high and (interval.high < low or interval.low > high)):
        return ""
    expected = f"about {start:.3g} was stated" if name == "deflection" else f"whiskers have {low:g} to {high:g}"
    return (
        f"{name} is {value:.3g} {parameter.unit}, and {expected}: a unit, the frame rate or a property that was "
        "taken as known is wrong. If it is right, start near it."
    )


def _inverse(information: Array) -> Array:
    """Return the inverse [p, p] of the information; infinite variances where it is singular."""
    # An eigenvalue that vanishes is a combination that the data do not tell: all parameters in it are open.
    values, vectors = np.linalg.eigh(information)
    least = values.max(initial=0.0) * 1e-14
    if (values > least).all() and values.max(initial=0.0) > 0:
        return (vectors / values) @ vectors.T
    good = values > least
    covariance = (vectors[:, good] / values[good]) @ vectors[:, good].T
    lost = (vectors[:, ~good] ** 2).sum(axis=1) > 1e-6
    covariance[lost, lost] = math.inf
    return covariance
