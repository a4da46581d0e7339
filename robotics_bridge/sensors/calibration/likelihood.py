"""The likelihood behind :mod:`robotics_bridge.sensors.calibration.calibrate`.

Letters: T reading, N probe. A part is one episode: (x [T], y [T, N]).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robotics_bridge.sensors.calibration.calibrate import _SIGNIFICANT, _Z, Estimate, Log

if TYPE_CHECKING:
    from numpy.typing import NDArray

Part = tuple["NDArray[np.float64]", "NDArray[np.float64]"]
Aligned = tuple["NDArray[np.float64]", "NDArray[np.float64]", "NDArray[np.int64]"]
"""x [T'] from the start of the episode, readings y [T, N], and for each reading the index of x that it shows."""

_SURE = 25.0
"""Difference of the misfit, in units of the noise's variance, at which one lag beats the next."""
_WINDOW = 40
"""Readings to either side over which drift counts as a level."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted dynamics."""

    estimates: dict[str, Estimate]
    gains: NDArray[np.float64]
    """[probes × episodes]."""
    gain_errors: NDArray[np.float64]
    parameters: tuple[float, ...]
    """log white, log walk, β, log τ."""


def segments(log: Log) -> list[Part]:
    """Split a log into its episodes."""
    x = np.zeros(len(log.time)) if log.reference is None else log.reference
    numbers = np.zeros(len(x), int) if log.episode is None else log.episode
    edges = np.flatnonzero(np.diff(numbers)) + 1
    parts = zip(np.split(x, edges), np.split(log.readings, edges), strict=True)
    return [(a, b) for a, b in parts if len(a) >= 10]


def find_dead(parts: list[Part]) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.float64]]]:
    """Return per episode which probes [N] never change, and their values."""
    stuck = [np.ptp(y, axis=0) == 0 for _x, y in parts]
    return stuck, [y[0] for _x, y in parts]


def find_quantum(values: NDArray[np.float64]) -> float:
    """Return the step of which all readings are multiples, 0 if there is none."""
    distinct = np.unique(values)
    if len(distinct) < 2:
        return 0.0
    steps = np.diff(distinct)
    scale = float(np.abs(distinct).max())
    steps = steps[steps > 1e-6 * scale]
    if not len(steps):
        return 0.0
    step = float(steps.min())
    # A finer estimate from far apart values, then the test that every value is a multiple.
    for _ in range(3):
        whole = np.round(distinct / step)
        step = float(distinct @ whole / (whole @ whole)) if whole @ whole else step
    off = np.abs(distinct / step - np.round(distinct / step))
    coarse = len(distinct) < 0.5 * len(values) or len(values) < 50
    return step if off.max() < 0.02 and coarse else 0.0


def blur(x: NDArray[np.float64], first: int, last: int) -> NDArray[np.float64]:
    """Return the mean of ``x`` over lags of ``first`` to ``last`` readings; it was 0 before."""
    total = np.cumsum(np.pad(x, (last + 1, 0)))
    end = np.arange(len(x)) + last + 1
    return (total[end - first] - total[end - last - 1]) / (last - first + 1)


def find_delays(parts: list[Part], longest: int) -> tuple[int, int]:
    """Return the range of lags over which the blurred signal explains the differences of the readings best.

    Lags that vary blur a signal in the mean. The best single lag is found first and its range then grown.
    """
    longest = min(longest, min(len(x) for x, _y in parts) // 2)
    steps = [np.diff(y[longest:], axis=0) for _x, y in parts]
    powers = [np.maximum((step * step).sum(axis=0), 1e-300) for step in steps]

    def explained(first: int, last: int) -> float:
        score = 0.0
        for (x, _y), step, power in zip(parts, steps, powers, strict=True):
            a = np.diff(blur(x, first, last)[longest:])
            own = float(a @ a)
            score += float(((a @ step) ** 2 / own / power).mean()) if own > 0 else 0.0
        return score

    best = max(((lag, lag) for lag in range(longest + 1)), key=lambda lags: explained(*lags))
    while True:
        first, last = best
        steps_of = [(-1, 0), (1, 0), (0, -1), (0, 1)]
        near = [(first + a, last + b) for a, b in steps_of if 0 <= first + a <= last + b <= longest]
        found = max(near, key=lambda lags: explained(*lags), default=best)
        if explained(*found) <= explained(*best):
            return best
        best = found


def align(parts: list[Part], first: int, last: int) -> list[Aligned]:
    """Return the parts with the signal blurred over a range of lags."""
    return [(blur(x, first, last), y, np.arange(len(x))) for x, y in parts]


def find_lags(
    parts: list[Part], guess: tuple[int, int], dt: float, fit: Fit
) -> tuple[list[Aligned], NDArray[np.int64]]:
    """Return the parts with each reading aligned by itself, and the lags [n] that could be told, in readings.

    All probes of an update are equally late, so that together they show by how much wherever the signal moves.
    """
    white, walk, beta, tau = fit.parameters
    middle = sum(guess) // 2
    lags = np.arange(2 * guess[1] + 1)
    found, told, place = [], [], 0
    for x, y in parts:
        n = y.shape[1]
        model = x + beta * maxwell(x, math.exp(-dt / math.exp(tau)))
        gain = fit.gains[place : place + n]
        place += n
        rows = np.arange(lags[-1], len(x))
        shown = model[rows[:, None] - lags]
        noise = math.exp(2 * white) + math.exp(2 * walk)
        level = _level(y[rows] - np.outer(model[rows - middle], gain), np.ptp(shown, axis=1), noise)
        rest = y[rows] - level
        # Σ (rest − gain · shown)² for every lag, from its three terms.
        misfit = (rest**2).sum(axis=1)[:, None] - 2 * shown * (rest @ gain)[:, None] + shown**2 * (gain @ gain)
        order = np.argsort(misfit, axis=1)
        best, second = (np.take_along_axis(misfit, order[:, [k]], axis=1)[:, 0] for k in (0, 1))
        sure = second - best > _SURE * noise
        told.append(order[sure, 0])
        found.append((x, y[rows], rows, misfit))
    lags = np.concatenate(told)
    first, last = extent(lags, guess)
    return [(x, y, rows - first - misfit[:, first : last + 1].argmin(axis=1)) for x, y, rows, misfit in found], lags


def extent(lags: NDArray[np.int64], guess: tuple[int, int]) -> tuple[int, int]:
    """Return the smallest and largest lag that occur more often than mistakes do (2 % of the certain ones)."""
    values, counts = np.unique(lags, return_counts=True)
    kept = values[counts > 0.02 * max(len(lags), 1)]
    return (int(kept.min()), int(kept.max())) if len(kept) and len(lags) >= 20 else guess


def _level(rest: NDArray, moves: NDArray, noise: float) -> NDArray:
    """Return what drifts slowly under ``rest`` [T, N], told where no lag matters: ``moves`` [T] is how much one can."""
    weight = 1 / (1 + moves**2 / noise) ** 2
    window = np.ones(2 * _WINDOW + 1)
    total = np.convolve(weight, window)[_WINDOW:-_WINDOW]
    mixed = np.cumsum(np.pad(weight[:, None] * rest, ((_WINDOW + 1, _WINDOW), (0, 0))), axis=0)
    return (mixed[len(window) :] - mixed[: -len(window)]) / np.maximum(total, 1e-12)[:, None]


def maxwell(x: NDArray[np.float64], keep: float) -> NDArray[np.float64]:
    """Return ξ of 4.26 for a signal that was 0 before."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0, -1.0], [1.0, -keep], x))


def _sine(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the orthonormal sine transform of differences along the first axis."""
    from scipy.fft import dst

    return np.asarray(dst(np.diff(values, axis=0), type=1, axis=0, norm="ortho"))


class _Likelihood:
    """Minus the log-likelihood as a function of (log white, log walk, β, log τ)."""

    def __init__(self, parts: list[Aligned], dt: float, moving: bool) -> None:
        self.dt, self.moving = dt, moving
        self.x = [x for x, _y, _at in parts]
        self.at = [at for _x, _y, at in parts]
        self.y = [_sine(y) for _x, y, _at in parts]
        self.signal = [_sine(x[at]) for x, at in zip(self.x, self.at, strict=True)]
        self.rate = [2 - 2 * np.cos(np.pi * np.arange(1, len(y) + 1) / (len(y) + 1)) for y in self.y]
        self._cached: tuple[float, list[NDArray[np.float64]]] = (math.nan, [])

    def lagged(self, tau: float) -> list[NDArray[np.float64]]:
        """Return the transformed ξ of each part."""
        if self._cached[0] != tau:
            keep = math.exp(-self.dt / tau)
            self._cached = (tau, [_sine(maxwell(x, keep)[at]) for x, at in zip(self.x, self.at, strict=True)])
        return self._cached[1]

    def __call__(self, white: float, walk: float, beta: float, tau: float) -> float:
        total = 0.0
        extra = self.lagged(tau) if beta else [0.0] * len(self.x)
        for y, s, e, rate in zip(self.y, self.signal, extra, self.rate, strict=True):
            variance = walk**2 + white**2 * rate
            rest = y
            if self.moving:
                model = s + beta * e
                weight = model / variance
                rest = y - np.outer(model, (weight @ y) / max(float(weight @ model), 1e-300))
            total += 0.5 * float(y.shape[1] * np.log(variance).sum() + (rest**2 / variance[:, None]).sum())
        return total

    def gains(self, white: float, walk: float, beta: float, tau: float) -> tuple[NDArray, NDArray]:
        """Return gains and their standard errors, of all probes and episodes."""
        found, errors = [], []
        for y, s, e, rate in zip(self.y, self.signal, self.lagged(tau), self.rate, strict=True):
            model = s + beta * e
            weight = model / (walk**2 + white**2 * rate)
            power = max(float(weight @ model), 1e-300)
            found.append((weight @ y) / power)
            errors.append(np.full(y.shape[1], 1 / math.sqrt(power)))
        return np.concatenate(found), np.concatenate(errors)


def fit_dynamics(parts: list[Aligned], dt: float, quantum: float, *, moving: bool, known: Fit | None = None) -> Fit:
    """Fit white noise, drift, hysteresis, gains and bias by maximum likelihood, near ``known`` if that is given."""
    target = _Likelihood(parts, dt, moving)
    spread = math.sqrt(float(np.mean([np.mean(y**2) for y in target.y]))) or 1e-12
    duration = max(len(x) for x in target.x) * dt
    starts = [math.log(spread / 2), math.log(spread / 20)]
    still = _minimum(lambda p: target(math.exp(p[0]), math.exp(p[1]), 0.0, dt), starts)
    best, cost = (*still[0], 0.0, math.log(10 * dt)), still[1]
    if moving:
        taus = np.geomspace(2 * dt, min(duration / 4, 100.0 * dt), 5)
        if known and known.parameters[2]:
            taus = [math.exp(known.parameters[3])]
        for tau in taus:
            found = _minimum(_free(target), [*still[0], 0.1, math.log(tau)])
            if found[1] < cost - 1e-9:
                best, cost = tuple(found[0]), found[1]
    hysteresis = moving and 2 * (still[1] - cost) > _SIGNIFICANT + 2.6
    if not hysteresis:
        best, cost = (*still[0], 0.0, math.log(10 * dt)), still[1]
    level = [best[0], *best[2:]]
    tiny = math.log(1e-6) + best[0]
    flat = _minimum(
        lambda p: target(math.exp(p[0]), math.exp(tiny), p[1] if hysteresis else 0.0, math.exp(p[2])), level
    )
    drifts = 2 * (flat[1] - cost) > _SIGNIFICANT
    if not drifts:
        best, cost = (flat[0][0], tiny, flat[0][1] if hysteresis else 0.0, flat[0][2]), flat[1]
    free = [True, drifts, hysteresis, hysteresis]
    errors = _errors(target, best, free)
    estimates = _named(best, errors, free, quantum)
    white, walk = math.exp(best[0]), math.exp(best[1])
    gains, gain_errors = np.ones(1), np.ones(1)
    if moving:
        gains, gain_errors = target.gains(white, walk, best[2], math.exp(best[3]))
    bias, error = _bias(parts, dt, white, walk if drifts else 0.0, best, gains, moving)
    estimates["bias"] = Estimate(bias, bias - _Z * error, bias + _Z * error, "level of the residuals")
    return Fit(estimates, gains, gain_errors, best)


def _free(target: _Likelihood) -> Any:
    return lambda p: target(math.exp(p[0]), math.exp(p[1]), p[2], math.exp(min(max(p[3], -20.0), 10.0)))


def _minimum(function: Any, start: list[float]) -> tuple[list[float], float]:
    from scipy.optimize import minimize

    options = {"xatol": 1e-6, "fatol": 1e-7, "maxiter": 4000, "maxfev": 4000}
    found = minimize(function, start, method="Nelder-Mead", options=options)
    return [float(value) for value in found.x], float(found.fun)


def _errors(target: _Likelihood, best: tuple[float, ...], free: list[bool]) -> list[float]:
    """Return standard errors from the curvature of the likelihood, NaN for what was held."""
    names = [index for index, use in enumerate(free) if use]
    step = 1e-3

    def cost(point: NDArray[np.float64]) -> float:
        full = np.array(best)
        full[names] = point
        return target(math.exp(full[0]), math.exp(full[1]), full[2] if free[2] else 0.0, math.exp(full[3]))

    center = np.array([best[index] for index in names])
    n = len(names)
    hessian = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            a, b = np.eye(n)[i] * step, np.eye(n)[j] * step
            corners = cost(center + a + b) - cost(center + a - b) - cost(center - a + b) + cost(center - a - b)
            hessian[i, j] = corners / (4 * step * step)
    covariance = np.linalg.pinv((hessian + hessian.T) / 2)
    errors = [math.nan] * 4
    for place, index in enumerate(names):
        errors[index] = math.sqrt(max(covariance[place, place], 0.0))
    return errors


def _named(best: tuple[float, ...], errors: list[float], free: list[bool], quantum: float) -> dict[str, Estimate]:
    """Turn parameters into knobs; the rounding's share leaves the white noise."""

    def less(value: float) -> float:
        return math.sqrt(max(value**2 - quantum**2 / 12, 0.0))

    def spread(index: int) -> tuple[float, float, float]:
        value, error = best[index], _Z * errors[index]
        return math.exp(value), math.exp(value - error), math.exp(value + error)

    white = spread(0)
    found = {"white": Estimate(less(white[0]), less(white[1]), less(white[2]), "likelihood of the differences")}
    for index, name in ((1, "walk"), (3, "hysteresis_tau")):
        if free[index]:
            found[name] = Estimate(*spread(index), "likelihood of the differences")
    if not free[1]:
        found["walk"] = Estimate(0.0, 0.0, math.nan, "no drift beyond chance")
    if free[2]:
        half = _Z * errors[2]
        found["hysteresis"] = Estimate(best[2], best[2] - half, best[2] + half, "likelihood of the differences")
    else:
        found["hysteresis"] = Estimate(0.0, math.nan, math.nan, "none beyond chance")
    return found


def _bias(
    parts: list[Aligned], dt: float, white: float, walk: float, best: tuple[float, ...], gains: NDArray, moving: bool
) -> tuple[float, float]:
    """Return the common offset and its error: the best linear estimate under drift that starts at zero."""
    from scipy.linalg import solveh_banded

    estimates, precisions, place = [], [], 0
    for x, y, at in parts:
        count, n = y.shape
        model = (x + best[2] * maxwell(x, math.exp(-dt / math.exp(best[3]))))[at] if moving else np.zeros(count)
        rest = y - np.outer(model, gains[place : place + n] if moving else np.ones(n))
        place += n
        # Differences, with the first reading in front: its drift is one step.
        z = np.vstack([rest[:1], np.diff(rest, axis=0)])
        band = np.zeros((2, count))
        band[0, 1:] = -(white**2)
        band[1] = walk**2 + 2 * white**2
        band[1, 0] = walk**2 + white**2
        unit = np.zeros(count)
        unit[0] = 1
        solved = solveh_banded(band, unit)
        estimates += ((solved @ z) / solved[0]).tolist()
        precisions += [float(solved[0])] * n
    values = np.array(estimates)
    own = math.sqrt(1 / np.sum(precisions))
    between = float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else 0.0
    return float(np.average(values, weights=precisions)), max(own, between)
