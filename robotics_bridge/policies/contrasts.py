"""Differences between arms of policies, where networks were drawn and policies trained several times.

A policy's success depends on its arm, on the network that was drawn for it (a reservoir, an initial state, a training
on whiskers) and on the seed of the policy's own training. Networks are nested in arms and crossed with policy seeds:

    success = arm + draw(arm) + seed + seed(arm) + residual,

arms fixed, the others random with variances that all arms share. The variances are REML estimates (Fisher scoring;
Searle, Casella & McCulloch 1992, chapter 6), means and differences generalised least squares, and intervals t with
Satterthwaite's degrees of freedom (Giesbrecht & Burns 1985). How often these intervals hold the truth, with as few
draws and seeds as we can train, ``benchmarks.policies.coverage`` simulates. Letters: n policies, A arms, K variances.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from brainbench.core.errors import UsageError, check_each, check_name, repeats
from brainbench.core.records import Interval

MARGIN = 0.05
"""Success over the best random arm below which an arm is not said to help."""
_LEVEL, _ITERATIONS = 0.95, 100
_TOLERANCE, _SHORTEST = 1e-8, 1e-4
"""Change of a variance, in units of all variance, at which the estimates stand; shortest part of a step."""
_SAME = 1e-12
"""Variance of success within arms below which there is none."""


@dataclass(frozen=True)
class TrainedPolicy:
    """Success of one policy, and what it depends on."""

    arm: str
    success: float
    """Share of successful episodes."""
    seed: int
    """Seed of the policy's training."""
    draw: Hashable = None
    """Network that was drawn for it, by seed or name; None where nothing is drawn."""


@dataclass(frozen=True)
class Contrast:
    """Difference of two arms' mean success, or the mean of one."""

    difference: float
    """Share of the first less share of the second."""
    interval: Interval | None
    """95 %, not corrected for the number of contrasts; None where all policies of every arm succeed equally often."""
    p: float
    """p of no difference, two-sided, not corrected for the number of contrasts; NaN where there is no interval."""
    freedom: float = math.nan
    """Degrees of freedom of the interval."""


@dataclass(frozen=True)
class Help:
    """Judgement of an arm against random ones."""

    helps: bool
    """True if it succeeds by :data:`MARGIN` more often than the best random arm, the interval above 0."""
    best: str
    """Random arm of the highest mean."""
    contrast: Contrast
    """The arm less that one."""


@dataclass(frozen=True, eq=False)
class MixedModel:
    """Arms of policies with random draws and seeds."""

    policies: tuple[TrainedPolicy, ...]

    def __post_init__(self) -> None:
        cells = [(one.arm, one.draw, one.seed) for one in self.policies]
        for arm, draw, seed in repeats(cells):
            raise UsageError(f"The policy of arm {arm!r}, draw {draw!r} and seed {seed} is given twice.")
        if len(cells) <= len(self.arms):
            raise UsageError(
                "Every student has one training seed, which tells nothing of the spread between seeds; train one more "
                "with another --seed."
            )

    @cached_property
    def arms(self) -> tuple[str, ...]:
        """Arms, in the order of the policies."""
        return tuple(dict.fromkeys(one.arm for one in self.policies))

    @cached_property
    def _design(self) -> NDArray[np.float64]:
        """[n, A]."""
        return np.array([[float(one.arm == arm) for arm in self.arms] for one in self.policies])

    @cached_property
    def _covariances(self) -> dict[str, NDArray[np.float64]]:
        """Name → covariance [n, n] of policies that share a level; of those that the policies can tell apart."""
        count, some = len(self.policies), self.policies
        parts: dict[str, NDArray[np.float64]] = {"residual": np.eye(count)}
        levels = {
            "draw": [None if one.draw is None else (one.arm, one.draw) for one in some],
            "seed(arm)": [(one.arm, one.seed) for one in some],
            "seed": [one.seed for one in some],
        }
        # Outside the arms' means: what these absorb tells nothing of a variance.
        rest = np.eye(count) - self._design @ np.linalg.pinv(self._design)
        seen = [(rest @ parts["residual"] @ rest).ravel()]
        for name, keys in levels.items():
            same = np.array([[float(a == b and a is not None) for b in keys] for a in keys])
            column = (rest @ same @ rest).ravel()
            basis = np.stack([*seen, column], 1)
            basis /= np.maximum(np.linalg.norm(basis, axis=0), 1e-12)
            if np.linalg.matrix_rank(basis, tol=1e-6) == basis.shape[1]:
                parts[name] = same
                seen.append(column)
        return parts

    @cached_property
    def _fit(self) -> _Fit | None:
        """None where no arm's policies differ in success."""
        y, x, parts = self._success, self._design, dict(self._covariances)
        if np.var(y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) < _SAME:
            return None
        found = _reml(y, x, parts)
        # A variance is not below zero: the lowest leaves the model, until none is.
        while found.variances[1:].min(initial=0.0) < 0:
            del parts[list(parts)[1 + int(found.variances[1:].argmin())]]
            found = _reml(y, x, parts)
        return found

    @property
    def _success(self) -> NDArray[np.float64]:
        return np.array([one.success for one in self.policies])

    @property
    def spread(self) -> dict[str, float]:
        """Standard deviation of each random part that these policies can tell apart."""
        told = {} if self._fit is None else dict(zip(self._fit.parts, np.sqrt(self._fit.variances), strict=True))
        return {name: float(told.get(name, 0.0)) for name in self._covariances}

    def mean(self, arm: str) -> Contrast:
        """Return the mean success of an arm; its p is that of no success at all."""
        check_name("arm", arm, self.arms)
        return self._estimate(np.array([float(arm == other) for other in self.arms]))

    def contrast(self, one: str, other: str) -> Contrast:
        """Return the difference of two arms' means."""
        check_each("arm", (one, other), self.arms)
        return self._estimate(np.array([float(one == arm) - float(other == arm) for arm in self.arms]))

    def judge(self, arm: str, random: Collection[str]) -> Help:
        """Return whether an arm helps beyond the best of some random arms."""
        check_each("arm", (arm, *random), self.arms)
        if not random or arm in random:
            raise UsageError(f"The arm {arm!r} is held against at least one random arm other than itself.")
        best = max(random, key=lambda name: self.mean(name).difference)
        found = self.contrast(arm, best)
        above = found.interval is not None and found.interval.low > 0
        return Help(above and found.difference >= MARGIN, best, found)

    def _estimate(self, weights: NDArray[np.float64]) -> Contrast:
        x, y = self._design, self._success
        if self._fit is None:
            value = float(weights @ np.linalg.lstsq(x, y, rcond=None)[0])
            return Contrast(value, None, math.nan)
        weighed = self._fit.inverse @ x
        spread = np.linalg.inv(x.T @ weighed)
        value, variance = float(weights @ spread @ weighed.T @ y), float(weights @ spread @ weights)
        # d Var / d σ²_k = a' V_k a with the weights a of the policies in the estimate.
        share = weighed @ spread @ weights
        slope = np.array([float(share @ part @ share) for part in self._fit.parts.values()])
        freedom = max(2 * variance**2 / float(slope @ self._fit.uncertain @ slope), 1.0)
        error = math.sqrt(variance)
        half = float(stdtrit(freedom, (1 + _LEVEL) / 2)) * error
        method = f"t with {freedom:.1f} degrees (mixed model: {', '.join(self._fit.parts)})"
        p = 2 * float(stdtr(freedom, -abs(value) / error))
        return Contrast(value, Interval(value - half, value + half, _LEVEL, method), p, freedom)


@dataclass(frozen=True, eq=False)
class _Fit:
    parts: dict[str, NDArray[np.float64]]
    """Name → V_k [n, n]: 1 where two policies share a level; the residual is first."""
    variances: NDArray[np.floating]
    """σ²_k [K]."""
    uncertain: NDArray[np.floating]
    """[K, K]: covariance of the variances."""
    inverse: NDArray[np.float64]
    """[n, n]: that of V = Σ σ²_k V_k."""


def _reml(y: NDArray[np.float64], x: NDArray[np.float64], parts: dict[str, NDArray[np.float64]]) -> _Fit:
    """Return the estimates for success y [n] and arms x [n, A], of which variances may be below zero."""
    covariances = list(parts.values())
    scale = float(np.var(y - x @ np.linalg.lstsq(x, y, rcond=None)[0]))
    variances = np.array([scale, *[0.0] * (len(parts) - 1)])
    inverse, information = np.eye(len(y)) / scale, np.eye(len(parts))
    for _ in range(_ITERATIONS):
        weighed = inverse @ x
        project = inverse - weighed @ np.linalg.solve(x.T @ weighed, weighed.T)
        moved, residual = [project @ part for part in covariances], project @ y
        # F_kl = tr(P V_k P V_l), q_k = y' P V_k P y: F⁻¹ q is the next estimate (iterated MINQUE).
        information = np.array([[float((a * b.T).sum()) for b in moved] for a in moved])
        wanted = np.linalg.solve(information, [float(residual @ part @ residual) for part in covariances])
        step, share, following = wanted - variances, 1.0, None
        while share > _SHORTEST and (following := _inverse(variances + share * step, covariances)) is None:
            share /= 2
        if following is None:
            break
        variances, inverse = variances + share * step, following
        if np.abs(share * step).max() < _TOLERANCE * scale:
            break
    return _Fit(parts, variances, 2 * np.linalg.inv(information), inverse)


def _inverse(variances: NDArray[np.floating], parts: Sequence[NDArray[np.float64]]) -> NDArray[np.float64] | None:
    """Return the inverse of Σ σ²_k V_k; None where that is no covariance."""
    values, vectors = np.linalg.eigh(np.tensordot(variances, np.stack(parts), 1))
    if values[0] <= 1e-6 * values[-1]:
        return None
    return (vectors / values) @ vectors.T
