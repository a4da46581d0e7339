"""Ridge regression of the targets on environments left out.

Environments are split into folds: a fold is predicted by a regression on the others, whose penalty is chosen among
these alone. Letters: T control step, B environment, F feature, D number of a target, K draw.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import stdtrit

from robotics_bridge.policies.readouts.features import TARGETS

FOLDS = 5
FARTHEST = 10.0
"""Standard deviations to which features are cut."""
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
"""Ridge penalties that are tried, per sample."""


@dataclass(frozen=True, eq=False)
class Readout:
    """How well targets are read from one arm on environments left out."""

    arm: str
    features: int
    """F, without the joints."""
    errors: NDArray[np.float64]
    """[K, B, D] sums of squared errors of each draw and environment; D runs over all numbers of all targets."""
    spread: NDArray[np.float64]
    """[B, D] sums of squares about the mean of the other folds."""

    def r2(self, target: str) -> float:
        """Return R², the mean of the target's three axes and of the draws."""
        return float(np.mean(self.per_draw(target)))

    def per_draw(self, target: str) -> list[float]:
        """Return R² of each draw."""
        return [float(value) for value in self._r2(self._of(target, self.errors).sum(1), self._of(target).sum(0))]

    def _of(self, target: str, values: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        first = 3 * TARGETS.index(target)
        return (self.spread if values is None else values)[..., first : first + 3]

    @staticmethod
    def _r2(lost: NDArray[np.float64], spread: NDArray[np.float64]) -> NDArray[np.float64]:
        return (1 - lost / spread).mean(-1)

    def _without_each(self, target: str) -> NDArray[np.float64]:
        """Return R² [B] of all draws without each environment in turn."""
        lost, spread = self._of(target, self.errors).mean(0), self._of(target)
        return self._r2(lost.sum(0) - lost, spread.sum(0) - spread)

    def interval(self, target: str, *, less: Readout | None = None) -> tuple[float, float]:
        """Return the 95 % interval of R², or of the difference from another arm of the same rollout.

        Environments and draws are both sampled: the variances over environments (jackknife; both arms of a difference
        keep the same ones) and over the draws of each arm are added, with Welch and Satterthwaite's degrees of freedom.
        An arm of one draw is that network alone, whatever others would give.
        """
        value, left = self.r2(target), self._without_each(target)
        if less is not None:
            value, left = value - less.r2(target), left - less._without_each(target)
        count = len(left)
        parts = [((count - 1) / count * float(((left - left.mean()) ** 2).sum()), count - 1)]
        drawn = (one.per_draw(target) for one in (self, less) if one is not None and len(one.errors) > 1)
        parts += [(float(np.var(draws, ddof=1)) / len(draws), len(draws) - 1) for draws in drawn]
        total = sum(part for part, _ in parts)
        if total == 0:
            return value, value
        freedom = total**2 / sum(part**2 / own for part, own in parts)
        half = float(stdtrit(freedom, 0.975)) * math.sqrt(total)
        return value - half, value + half


def read_targets(
    proprio: torch.Tensor, features: torch.Tensor, wanted: torch.Tensor, valid: torch.Tensor
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return squared errors and squares about the mean [B, D], each environment read by the other folds."""
    x, y = torch.cat((proprio, features.to(proprio.device)), -1).float(), wanted.float()
    count = x.shape[1]
    fold = torch.arange(count, device=y.device) % FOLDS
    errors, spread = (torch.zeros(count, y.shape[-1], dtype=torch.float64, device=y.device) for _ in range(2))
    for number in range(FOLDS):
        train = fold != number
        # The penalty is chosen on one more fold of the others: what is left out has no say in it.
        inner = train & (fold != (number + 1) % FOLDS)
        tried = _ridge(x[:, inner], y[:, inner], valid[:, inner])
        aside = train & ~inner
        scores = torch.stack([_squares(tried(x[:, aside], p), y[:, aside], valid[:, aside]).sum(0) for p in PENALTIES])
        best = scores.argmin(0)
        final = _ridge(x[:, train], y[:, train], valid[:, train])
        out = fold == number
        guess = torch.stack([final(x[:, out], p) for p in PENALTIES], -1)
        guess = guess.gather(-1, best.expand(*guess.shape[:-1])[..., None]).squeeze(-1)
        mean = y[:, train][valid[:, train]].mean(0)
        errors[out] = _squares(guess, y[:, out], valid[:, out])
        spread[out] = _squares(mean.expand_as(guess), y[:, out], valid[:, out])
    return errors.cpu().numpy(), spread.cpu().numpy()


def _squares(guess: torch.Tensor, y: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    return torch.where(valid[..., None], (guess - y).square(), 0.0).double().sum(0)


def _ridge(x: torch.Tensor, y: torch.Tensor, valid: torch.Tensor) -> Callable[[torch.Tensor, float], torch.Tensor]:
    """Return the regression [.., F], penalty → [.., D] on standardised features; constant features are left out."""
    rows, aim = x[valid], y[valid]
    mean, scale, centre = rows.mean(0), rows.std(0), aim.mean(0)
    used = scale > 1e-7 * scale.max().clamp(min=1e-30)

    def standard(values: torch.Tensor) -> torch.Tensor:
        # A taxel that was hardly ever touched would otherwise throw a prediction where it is.
        return ((values[..., used] - mean[used]) / scale[used]).clamp(-FARTHEST, FARTHEST)

    z = standard(rows)
    gram, products = z.T @ z / len(z), z.T @ (aim - centre) / len(z)
    solved: dict[float, torch.Tensor] = {}

    def predict(values: torch.Tensor, penalty: float) -> torch.Tensor:
        if penalty not in solved:
            ridge = gram + penalty * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
            solved[penalty] = torch.cholesky_solve(products, torch.linalg.cholesky(ridge))
        return standard(values) @ solved[penalty] + centre

    return predict
