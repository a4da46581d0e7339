"""Result of a fit: estimates with intervals, noise, tests of the residuals, and whether any of it can be trusted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.records import Interval, Status
from brainbench.stimuli.fitting.identifiability import Direction
from brainbench.stimuli.fitting.parameters import Prior
from brainbench.stimuli.fitting.residual_tests import ResidualTest
from brainbench.stimuli.whiskers.whisker import Whisker


@dataclass(frozen=True)
class FittedParameter:
    """One fitted parameter."""

    name: str
    unit: str
    value: float
    start: float
    """Value that the fit began with."""
    relative_deviation: float
    """Standard deviation of its coordinate by noise: relative for positive parameters; inf when the data do not tell
    it."""
    relative_error: float
    """Standard deviation of its coordinate by links and steps: how far finer simulations move the estimate."""
    laplace: Interval
    """From the curvature of the likelihood at the best fit, and the error of the simulation."""
    profile: Interval | None = None
    """Where the likelihood, maximised over the other parameters, falls, and the error of the simulation; None when it
    was not asked for."""
    prior: Prior | None = None
    status: Status = "ok"
    """``undefined``: the data do not tell this parameter; ``unreliable``: at a bound, known by its prior only, or
    far from any whisker."""
    reason: str = ""

    @property
    def interval(self) -> Interval:
        """The profile interval, or Laplace's without one."""
        return self.profile or self.laplace


@dataclass(frozen=True, eq=False)
class FitResult:
    """Everything that a fit found."""

    status: Status
    """``ok``; ``unreliable``: the model does not fit, or a parameter is at a bound, known by its prior only or far
    from any whisker;
    ``undefined``: it did not converge, or a parameter cannot be told."""
    reasons: tuple[str, ...]
    """One sentence for each thing that is wrong."""
    estimates: tuple[FittedParameter, ...]
    noise: Mapping[str, float]
    """Standard deviation of a reading of each kind (N, N·m, m)."""
    directions: tuple[Direction, ...]
    """Combinations of parameters, the worst known first."""
    tests: tuple[ResidualTest, ...]
    whisker: Whisker
    """The fitted whisker."""
    residuals: tuple[NDArray[np.float64], ...]
    """Predicted minus measured of each trial: [n, c] (N, N·m) or [n, k, d] (m); NaN where nothing was measured."""
    predicted: tuple[NDArray[np.float64], ...]
    """Prediction of each trial: wrenches [n, c] (N, N·m) or joints and tip [n, N + 1, 3] (m)."""
    covariance: NDArray[np.float64]
    """[p, p] of the coordinates of the parameters."""
    iterations: int = 0
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """How derivatives were computed, with what simulation, how often, versions and machine."""

    def __getitem__(self, name: str) -> FittedParameter:
        """Return the estimate of a parameter."""
        from brainbench.core.errors import check_name

        known = {one.name: one for one in self.estimates}
        check_name("fitted parameter", name, known)
        return known[name]

    def summary(self) -> dict[str, Any]:
        """Return everything but the arrays, for JSON."""
        return {
            "status": self.status,
            "reasons": list(self.reasons),
            "estimates": [vars(one) for one in self.estimates],
            "noise": dict(self.noise),
            "directions": [
                {"words": one.words, "deviation": one.deviation, "identified": one.identified}
                for one in self.directions
            ],
            "residual_tests": [vars(one) for one in self.tests],
            "whisker": self.whisker,
            "iterations": self.iterations,
            "provenance": dict(self.provenance),
        }
