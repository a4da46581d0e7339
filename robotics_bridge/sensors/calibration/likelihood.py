"""Exact likelihood of a log under white noise, drift and hysteresis, and the delays of its readings.

Letters: T reading, N probe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dst
from scipy.linalg import solveh_banded
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import chi2

from brainbench.core.errors import DataError

Episode = tuple["NDArray[np.float64]", "NDArray[np.float64]"]
"""x [T], y [T, N]: the true signal and the readings."""
Aligned = tuple["NDArray[np.float64]", "NDArray[np.float64]", "NDArray[np.int64]"]
"""x [T'] from the start of the episode, readings y [T, N], and for each reading the index of x that it shows."""

Z95 = 1.959963984540054  # half width of a 95 % interval in standard errors
SIGNIFICANT = 6.63
"""Twice the gain in log-likelihood (χ², one degree, 1 %) that drift or hysteresis must bring to be kept."""
_UNTOLD = 7.0
"""Half width of the interval of a logarithm, a factor of a thousand, at which a log does not tell a number."""
MOST_HYSTERESIS = 5.0  # largest |β| of a device; beyond it the signal itself counts for nothing
_LOAD = 0.01  # share of the largest load above which an episode begins under load


@dataclass(frozen=True)
class Estimate:
    """A knob with its interval."""

    value: float
    low: float
    """Lower end of the 95 % interval; NaN where there is none."""
    high: float
    how: str
    """Basis of the value."""


class Dynamics(NamedTuple):
    """Parameters of the dynamics, as they are fitted."""

    log_white: float
    log_walk: float
    hysteresis: float
    """β."""
    log_tau: float

    @property
    def white(self) -> float:
        """Standard deviation of the white noise [unit of the sensor]."""
        return math.exp(self.log_white)

    @property
    def walk(self) -> float:
        """Standard deviation of a step of the drift [unit of the sensor]."""
        return math.exp(self.log_walk)

    @property
    def tau(self) -> float:
        """Time constant of the hysteresis [s]."""
        return math.exp(self.log_tau)

    def response(self, x: NDArray[np.float64], dt: float, creep: float) -> NDArray[np.float64]:
        """Return x + β ξ (4.26, 4.27) for a signal before which ξ was ``creep``."""
        keep = math.exp(-dt / self.tau)
        return x + self.hysteresis * (maxwell(x, keep) + creep * keep ** np.arange(len(x)))


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted dynamics."""

    estimates: dict[str, Estimate]
    gains: NDArray[np.float64]
    """[probes × episodes]."""
    gain_errors: NDArray[np.float64]
    dynamics: Dynamics
    creep: list[float]
    """ξ before each episode [unit of the sensor]; 0 of those that begin without load."""
    cost: float
    """Negative logarithm of the likelihood."""


def begins_loaded(x: NDArray[np.float64]) -> bool:
    """Return whether an episode with the signal ``x`` begins under load."""
    return bool(abs(x[0]) > _LOAD * np.abs(x).max())


def maxwell(x: NDArray[np.float64], keep: float) -> NDArray[np.float64]:
    """Return ξ [T, …] of 4.26 for a signal that had its first value before, as a device loaded for a while."""
    return np.asarray(lfilter([1.0, -1.0], [1.0, -keep], x - x[0]))


def _sine(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(dst(np.diff(values, axis=0), type=1, axis=0, norm="ortho"))


class _Likelihood:
    """Minus the log-likelihood of the dynamics.

    Differences of a random walk plus white noise have a tridiagonal Toeplitz covariance, which the sine transform
    diagonalises: walk² + white² (2 − 2 cos(π k / (T + 1))).
    """

    def __init__(self, parts: list[Aligned], dt: float, moving: bool) -> None:
        self.dt, self.moving = dt, moving
        self.x = [x for x, _y, _at in parts]
        self.at = [at for _x, _y, at in parts]
        self.y = [_sine(y) for _x, y, _at in parts]
        self.signal = [_sine(x[at]) for x, at in zip(self.x, self.at, strict=True)]
        self.rate = [2 - 2 * np.cos(np.pi * np.arange(1, len(y) + 1) / (len(y) + 1)) for y in self.y]
        self.loaded = [moving and begins_loaded(x) for x in self.x]
        self._cached: tuple[float, list[tuple[Any, Any]]] = (math.nan, [])

    def lagged(self, tau: float) -> list[tuple[Any, Any]]:
        """Return the transformed ξ of each part, and how a ξ of 1 before it dies away where it begins under load."""
        if self._cached[0] != tau:
            keep = math.exp(-self.dt / tau)
            self._cached = (tau, [
                (_sine(maxwell(x, keep)[at]), _sine(keep ** at.astype(float)) if loaded else 0.0)
                for x, at, loaded in zip(self.x, self.at, self.loaded, strict=True)
            ])  # fmt: skip
        return self._cached[1]

    def models(self, d: Dynamics) -> list[tuple[NDArray[np.float64], float]]:
        """Return the transformed signal of each part with its hysteresis, and ξ before the part."""
        extra = self.lagged(d.tau) if d.hysteresis else [(0.0, 0.0)] * len(self.x)
        models = []
        for x, y, s, (e, k), rate, loaded in zip(
            self.x, self.y, self.signal, extra, self.rate, self.loaded, strict=True
        ):
            model, creep = s + d.hysteresis * e, 0.0
            if loaded and d.hysteresis:
                # What the sensor felt before a load, or whether it crept when it was reset, stands in no log.
                creep = _creep(y, model, d.hysteresis * k, d.walk**2 + d.white**2 * rate, most=float(np.abs(x).max()))
                model = model + creep * d.hysteresis * k
            models.append((model, creep))
        return models

    def __call__(self, d: Dynamics) -> float:
        total = 0.0
        models = self.models(d) if self.moving else [(0.0, 0.0)] * len(self.x)
        for y, (model, _), rate in zip(self.y, models, self.rate, strict=True):
            # Gaussian likelihood in the sine basis, where differences are independent: no matrix has to be inverted.
            variance = d.walk**2 + d.white**2 * rate
            rest = y
            if self.moving:
                # Gains are profiled out: for given dynamics the best one of each probe is a weighted projection on the
                # signal.
                weight = model / variance
                rest = y - np.outer(model, (weight @ y) / max(float(weight @ model), 1e-300))
            total += 0.5 * float(y.shape[1] * np.log(variance).sum() + (rest**2 / variance[:, None]).sum())
        return total

    def gains(self, d: Dynamics) -> tuple[NDArray, NDArray]:
        """Return gains and their standard errors, of all probes and episodes."""
        gains, errors = [], []
        for y, (model, _), rate in zip(self.y, self.models(d), self.rate, strict=True):
            weight = model / (d.walk**2 + d.white**2 * rate)
            power = max(float(weight @ model), 1e-300)
            gains.append((weight @ y) / power)
            errors.append(np.full(y.shape[1], 1 / math.sqrt(power)))
        return np.concatenate(gains), np.concatenate(errors)


def _creep(y: NDArray, model: NDArray, fading: NDArray, variance: NDArray, *, most: float) -> float:
    """Return the c within ±``most`` for which ``model`` + c ``fading``, by a gain each, explains y [T, N] best."""
    basis = np.stack([model, fading])
    share, gram = (basis / variance) @ y, (basis / variance) @ basis.T
    power = share @ share.T
    (p, q), (_, r), (u, v), (_, w) = *power.tolist(), *gram.tolist()
    # What is explained is (p + 2 q c + r c²) / (u + 2 v c + w c²): its slope is 0, or the range ends.
    turns = np.real(np.roots([r * v - q * w, r * u - p * w, q * u - p * v])).tolist()
    choices = [0.0, *(c for c in turns if abs(c) < most), -most, most]
    return max(choices, key=lambda c: (p + c * (2 * q + c * r)) / max(u + c * (2 * v + c * w), 1e-300))


def fit_dynamics(parts: list[Aligned], dt: float, quantum: float, *, moving: bool, start: Fit | None = None) -> Fit:
    """Fit white noise, drift, hysteresis, gains and bias by maximum likelihood, from the fit ``start`` if given.

    Drift and hysteresis are kept if they raise the likelihood by more than chance would.
    """
    target = _Likelihood(parts, dt, moving)
    spread = math.sqrt(float(np.mean([np.mean(y**2) for y in target.y]))) or 1e-12
    duration, no_lag = max(len(x) for x in target.x) * dt, math.log(10 * dt)

    def _dynamics_of(white: float, walk: float, hysteresis: float, tau: float) -> Dynamics:
        # White noise far below the drift changes nothing. Hysteresis of less than a reading is a delay by another name.
        hysteresis = min(max(hysteresis, -MOST_HYSTERESIS), MOST_HYSTERESIS)
        return Dynamics(max(white, walk - 14), walk, hysteresis, min(max(tau, math.log(dt)), math.log(100 * duration)))

    def _minimum(dynamics: Callable[[list[float]], Dynamics], start: list[float]) -> tuple[list[float], float]:
        options = {"xatol": 1e-6, "fatol": 1e-7, "maxiter": 4000, "maxfev": 4000}
        solution = minimize(lambda p: target(dynamics(p)), start, method="Nelder-Mead", options=options)
        return [float(value) for value in solution.x], float(solution.fun)

    noise, plain_cost = _minimum(
        lambda p: _dynamics_of(p[0], p[1], 0.0, no_lag), [math.log(spread / 2), math.log(spread / 20)]
    )
    plain = _dynamics_of(noise[0], noise[1], 0.0, no_lag)
    best, cost = plain, plain_cost
    if moving:
        # The likelihood has several maxima in τ: starts spread over the decades that the log can tell.
        taus = np.geomspace(2 * dt, min(duration / 4, 100.0 * dt), 5)
        if start and start.dynamics.hysteresis:
            taus = [start.dynamics.tau]
        for tau in taus:
            point, value = _minimum(lambda p: _dynamics_of(*p), [*noise, 0.1, math.log(tau)])
            if value < cost - 1e-9:
                best, cost = _dynamics_of(*point), value
    # Likelihood-ratio tests: a knob must earn its place, or every log would have a little drift and hysteresis.
    # Each unknown ξ before an episode under load is one number more.
    more = float(chi2.isf(0.01, 2 + sum(target.loaded)) - chi2.isf(0.01, 2))
    hysteresis = moving and 2 * (plain_cost - cost) > SIGNIFICANT + 2.6 + more
    if not hysteresis:
        best, cost = plain, plain_cost
    tiny = math.log(1e-6) + best.log_white

    def _without_drift(p: list[float]) -> Dynamics:
        return _dynamics_of(p[0], tiny, p[1] if hysteresis else 0.0, p[2])

    point, value = _minimum(_without_drift, [best.log_white, best.hysteresis, best.log_tau])
    drifts = 2 * (value - cost) > SIGNIFICANT
    if not drifts:
        best, cost = _without_drift(point), value
    free = ["log_white"] + ["log_walk"] * drifts + ["hysteresis", "log_tau"] * hysteresis
    estimates = _estimates(best, _errors(target, best, free), quantum)
    gains, gain_errors = target.gains(best) if moving else (np.ones(1), np.ones(1))
    creep = [own for _, own in target.models(best)] if moving else [0.0] * len(parts)
    bias, error = _bias(parts, dt, best, creep, drifts, gains, moving)
    estimates["bias"] = Estimate(bias, bias - Z95 * error, bias + Z95 * error, "level of the residuals")
    return Fit(estimates, gains, gain_errors, best, creep, cost)


def _errors(target: _Likelihood, best: Dynamics, free: list[str]) -> dict[str, float]:
    """Return standard errors of the free parameters from the curvature of the likelihood."""
    step, n = 1e-3, len(free)
    hessian = np.zeros((n, n))

    def _cost(*moves: tuple[int, float]) -> float:
        values = {name: getattr(best, name) for name in free}
        for index, move in moves:
            values[free[index]] += move
        return target(best._replace(**values))

    for i in range(n):
        for j in range(n):
            # Central second differences of the likelihood; the inverse of the curvature is the covariance. The
            # pseudo-inverse copes with parameters that the log does not tell.
            corners = _cost((i, step), (j, step)) - _cost((i, step), (j, -step))
            corners += _cost((i, -step), (j, -step)) - _cost((i, -step), (j, step))
            hessian[i, j] = corners / (4 * step * step)
    # The pseudo-inverse copes with parameters that the log does not tell.
    covariance = np.linalg.pinv((hessian + hessian.T) / 2)
    return {name: math.sqrt(max(covariance[index, index], 0.0)) for index, name in enumerate(free)}


def _estimates(best: Dynamics, errors: dict[str, float], quantum: float) -> dict[str, Estimate]:
    """Turn parameters into knobs; the rounding's share leaves the white noise."""
    how = "likelihood of the differences"

    def _spread(name: str) -> tuple[float, float, float]:
        value, error = getattr(best, name), min(Z95 * errors[name], _UNTOLD)
        return math.exp(value), math.exp(value - error), math.exp(value + error)

    # Rounding to steps q has the variance q²/12, which the fit has counted as white noise.
    white = [math.sqrt(max(value**2 - quantum**2 / 12, 0.0)) for value in _spread("log_white")]
    estimates = {"white": Estimate(white[0], white[1], white[2], how)}
    if Z95 * errors["log_white"] >= _UNTOLD:
        estimates["white"] = Estimate(0.0, 0.0, math.nan, "too little beside the drift to be told")
    if "log_walk" in errors:
        estimates["walk"] = Estimate(*_spread("log_walk"), how)
    else:
        estimates["walk"] = Estimate(0.0, 0.0, math.nan, "no drift beyond chance")
    if "hysteresis" in errors:
        half = Z95 * errors["hysteresis"]
        estimates["hysteresis_tau"] = Estimate(*_spread("log_tau"), how)
        estimates["hysteresis"] = Estimate(best.hysteresis, best.hysteresis - half, best.hysteresis + half, how)
    else:
        estimates["hysteresis"] = Estimate(0.0, math.nan, math.nan, "none beyond chance")
    return estimates


def _bias(
    parts: list[Aligned], dt: float, best: Dynamics, creep: list[float], drifts: bool, gains: NDArray, moving: bool
) -> tuple[float, float]:
    """Return the common offset and its error: the best linear estimate under drift that starts at zero."""
    estimates, precisions, place = [], [], 0
    white, walk = best.white, best.walk if drifts else 0.0
    for (x, y, at), past in zip(parts, creep, strict=True):
        count, n = y.shape
        model = best.response(x, dt, past)[at] if moving else np.zeros(count)
        rest = y - np.outer(model, gains[place : place + n] if moving else np.ones(n))
        place += n
        # Differences, with the first reading in front: its drift is one step.
        z = np.vstack([rest[:1], np.diff(rest, axis=0)])
        # Covariance of the differences, tridiagonal: walk² + 2 white² on the diagonal, −white² beside it.
        band = np.zeros((2, count))
        band[0, 1:] = -(white**2)
        band[1] = walk**2 + 2 * white**2
        band[1, 0] = (at[0] + 1) * walk**2 + white**2
        unit = np.zeros(count)
        unit[0] = 1
        solved = solveh_banded(band, unit)
        estimates += ((solved @ z) / solved[0]).tolist()
        precisions += [float(solved[0])] * n
    values = np.array(estimates)
    statistical = math.sqrt(1 / np.sum(precisions))
    between = float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else 0.0
    return float(np.average(values, weights=precisions)), max(statistical, between)


_SURE = 25.0  # difference of the misfit, in units of the noise's variance, at which one lag beats the next
_WINDOW = 40  # readings to either side over which drift counts as a level


def blur(x: NDArray[np.float64], first: int, last: int) -> NDArray[np.float64]:
    """Return the mean [T] of ``x`` over lags of ``first`` to ``last`` readings; before, it had its first value."""
    # Running mean as a difference of two sums: its cost does not depend on the range of lags.
    total = np.cumsum(np.pad(x, (last + 1, 0), mode="edge"))
    end = np.arange(len(x)) + last + 1
    return (total[end - first] - total[end - last - 1]) / (last - first + 1)


def find_delays(parts: list[Episode], longest: int) -> tuple[int, int]:
    """Return the range of lags over which the blurred signal explains the differences of the readings best.

    Lags that vary blur a signal in the mean. The best single lag is found first and its range then grown.
    """
    longest = min(longest, min(len(x) for x, _y in parts) // 2)
    steps = [np.diff(y[longest:], axis=0) for _x, y in parts]
    powers = [np.maximum((step * step).sum(axis=0), 1e-300) for step in steps]

    def _explained(first: int, last: int) -> float:
        score = 0.0
        for (x, _y), step, power in zip(parts, steps, powers, strict=True):
            # Squared correlation of differences: gain, bias and drift of the readings do not enter.
            a = np.diff(blur(x, first, last)[longest:])
            energy = float(a @ a)
            score += float(((a @ step) ** 2 / energy / power).mean()) if energy > 0 else 0.0
        return score

    best = max(((lag, lag) for lag in range(longest + 1)), key=lambda lags: _explained(*lags))
    while True:
        first, last = best
        steps_of = [(-1, 0), (1, 0), (0, -1), (0, 1)]
        near = [(first + a, last + b) for a, b in steps_of if 0 <= first + a <= last + b <= longest]
        neighbour = max(near, key=lambda lags: _explained(*lags), default=best)
        if _explained(*neighbour) <= _explained(*best):
            return best
        best = neighbour


def unknown_past(x: NDArray[np.float64], longest: int) -> int:
    """Return how many readings of an episode may show what came before it: ``longest``, or none if that was no load."""
    return min(longest, len(x) // 2) if begins_loaded(x) else 0


def align(parts: list[Episode], first: int, last: int, longest: int) -> list[Aligned]:
    """Return the parts with the signal blurred over a range of lags, from where their past is known."""
    starts = [unknown_past(x, longest) for x, _y in parts]
    return [(blur(x, first, last), y[at:], np.arange(at, len(x))) for (x, y), at in zip(parts, starts, strict=True)]


def find_lags(
    parts: list[Episode], guess: tuple[int, int], dt: float, fit: Fit, longest: int
) -> tuple[list[Aligned], NDArray[np.int64]]:
    """Return the parts with each reading aligned by itself, and the lags [n] that could be told, in readings.

    All probes of an update are equally late, so that together they show by how much wherever the signal moves.
    """
    dynamics = fit.dynamics
    middle = sum(guess) // 2
    lags = np.arange(2 * guess[1] + 1)
    episodes, certain, place = [], [], 0
    for (x, y), creep in zip(parts, fit.creep, strict=True):
        n = y.shape[1]
        model = dynamics.response(x, dt, creep)
        gain = fit.gains[place : place + n]
        place += n
        rows = np.arange(max(lags[-1], unknown_past(x, longest)), len(x))
        if not len(rows):
            raise DataError(
                f"An episode of the log has {len(x)} readings, no more than twice the delay that would explain it "
                f"({guess[1]} readings); record longer ones, or allow shorter delays."
            )
        lagged = model[rows[:, None] - lags]
        # Dynamics that were fitted to misplaced readings call noise what is late.
        noise = min(dynamics.white**2 + dynamics.walk**2, 4 * calm(model, y, int(lags[-1])))
        level = _level(y[rows] - np.outer(model[rows - middle], gain), np.ptp(lagged, axis=1), noise)
        rest = y[rows] - level
        # Σ (rest − gain · shown)² for every lag, from its three terms.
        misfit = (rest**2).sum(axis=1)[:, None] - 2 * lagged * (rest @ gain)[:, None] + lagged**2 * (gain @ gain)
        order = np.argsort(misfit, axis=1)
        best, second = (np.take_along_axis(misfit, order[:, [k]], axis=1)[:, 0] for k in (0, 1))
        sure = second - best > _SURE * noise
        certain.append(order[sure, 0])
        episodes.append((x, y[rows], rows, misfit))
    lags = np.concatenate(certain)
    first, last = extent(lags, guess)
    return [(x, y, rows - first - misfit[:, first : last + 1].argmin(axis=1)) for x, y, rows, misfit in episodes], lags


def extent(lags: NDArray[np.int64], guess: tuple[int, int]) -> tuple[int, int]:
    """Return the smallest and largest lag that occur more often than mistakes do (2 % of the certain ones)."""
    values, counts = np.unique(lags, return_counts=True)
    frequent = values[counts > 0.02 * max(len(lags), 1)]
    return (int(frequent.min()), int(frequent.max())) if len(frequent) and len(lags) >= 8 else guess


def calm(model: NDArray[np.float64], y: NDArray[np.float64], longest: int) -> float:
    """Return the noise's variance in the quarter of readings [T, N] that lags of up to ``longest`` move least."""
    rows = np.arange(longest, len(model))
    if len(rows) < 2:
        return np.inf
    moves = np.ptp(model[rows[:, None] - np.arange(longest + 1)], axis=1)
    either = np.maximum(moves[1:], moves[:-1])
    return float(np.mean(np.diff(y[rows], axis=0)[either <= np.quantile(either, 0.25)] ** 2)) / 2


def _level(rest: NDArray, moves: NDArray, noise: float) -> NDArray:
    """Return what drifts slowly under ``rest`` [T, N], told where no lag matters: ``moves`` [T] is how much one can."""
    # Readings at which the lag matters would pull the level towards a wrong lag, so they count little.
    weight = 1 / (1 + moves**2 / noise) ** 2
    window = np.ones(2 * _WINDOW + 1)
    total = np.convolve(weight, window)[_WINDOW:-_WINDOW]
    mixed = np.cumsum(np.pad(weight[:, None] * rest, ((_WINDOW + 1, _WINDOW), (0, 0))), axis=0)
    return (mixed[len(window) :] - mixed[: -len(window)]) / np.maximum(total, 1e-12)[:, None]
