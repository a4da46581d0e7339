"""Ridge regression of the targets on environments left out.

Environments are split into folds: a fold is predicted by a regression on the others, whose penalty is chosen among
these alone. Letters: T control step, B environment, F feature, D number of a target, K draw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from robotics_bridge.policies.readouts.rollout import TARGETS

FOLDS = 5
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
"""Ridge penalties that are tried, per sample."""
_DRAWS = 2000
"""Bootstrap draws of an interval."""


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
        return float(self._r2(target, np.arange(len(self.errors)), np.arange(self.spread.shape[0])))

    def per_draw(self, target: str) -> list[float]:
        """Return R² of each draw."""
        every = np.arange(self.spread.shape[0])
        return [float(self._r2(target, np.array([draw]), every)) for draw in range(len(self.errors))]

    def _r2(self, target: str, draws: NDArray[np.int64], rows: NDArray[np.int64]) -> float:
        first = 3 * TARGETS.index(target)
        columns = slice(first, first + 3)
        lost = self.errors[draws][:, rows, columns].sum(axis=1)
        return float((1 - lost / self.spread[rows, columns].sum(axis=0)).mean())

    def interval(self, target: str, *, less: Readout | None = None, seed: int = 0) -> tuple[float, float]:
        """Return the 95 % interval of R², or of the difference from another arm of the same rollout.

        Bootstrap over environments and draws; both arms of a difference keep the same environments.
        """
        rng, found = np.random.default_rng(seed), []
        for _ in range(_DRAWS):
            rows = rng.integers(self.spread.shape[0], size=self.spread.shape[0])
            value = self._r2(target, rng.integers(len(self.errors), size=len(self.errors)), rows)
            if less is not None:
                value -= less._r2(target, rng.integers(len(less.errors), size=len(less.errors)), rows)
            found.append(value)
        low, high = np.quantile(found, (0.025, 0.975))
        return float(low), float(high)


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
        return ((values[..., used] - mean[used]) / scale[used]).clamp(-10, 10)

    z = standard(rows)
    gram, products = z.T @ z / len(z), z.T @ (aim - centre) / len(z)
    solved: dict[float, torch.Tensor] = {}

    def predict(values: torch.Tensor, penalty: float) -> torch.Tensor:
        if penalty not in solved:
            ridge = gram + penalty * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
            solved[penalty] = torch.cholesky_solve(products, torch.linalg.cholesky(ridge))
        return standard(values) @ solved[penalty] + centre

    return predict
