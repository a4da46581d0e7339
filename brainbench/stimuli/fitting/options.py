"""Options of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from brainbench.core.errors import UsageError, check_name
from brainbench.core.reading.ranges import check_number
from brainbench.core.statistics import check_level

LOSSES = ("linear", "soft_l1", "huber", "cauchy")
INTERVALS = ("laplace", "profile")
PRIORS = ("none", "published")


@dataclass(frozen=True)
class FitOptions:
    """How a fit simulates, weighs and judges; a value outside its range is a :class:`UsageError`."""

    priors: str = "none"
    """Prior of the parameters: none, or published (means and spreads of measured whiskers)."""
    intervals: str = "laplace"
    """Confidence intervals: laplace (curvature of the likelihood at the best fit), or profile (takes longer)."""
    level: float = 0.95
    """Coverage of the confidence intervals."""
    loss: str = "linear"
    """Loss of a residual: linear (least squares), or soft_l1, huber or cauchy, which outliers pull less."""
    most_iterations: int = 50
    """Iterations after which a fit counts as not converged."""
    links: int = 20
    """Links of each simulated whisker."""
    steps_per_period: float = 400.0
    """Time steps in one period of the whisker's first mode at the start of the fit. Few steps damp higher modes, which
    biases stiffness and taper by more than the noise of a good sensor."""
    time_step: float = 1e-4
    """Longest time step (s)."""
    solver: Literal["dynamic", "quasistatic"] = "dynamic"
    """quasistatic leaves out inertia and damping, for slow contact."""
    twist: bool = True
    """Whether whiskers may twist."""

    def __post_init__(self) -> None:
        check_name("priors of a fit", self.priors, PRIORS)
        check_name("intervals of a fit", self.intervals, INTERVALS)
        check_name("loss of a fit", self.loss, LOSSES)
        if self.intervals == "profile" and self.loss != "linear":
            raise UsageError(
                f"Profile intervals follow the squares of the residuals, and the loss {self.loss!r} is another; "
                "use intervals = 'laplace', or the loss 'linear'."
            )
        check_level(self.level)
        check_number("most_iterations of a fit", self.most_iterations, least=1, whole=True)
        check_number("steps_per_period of a fit", self.steps_per_period, least=4)
        check_number("time_step of a fit (s)", self.time_step, above=0)
