"""Options of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.statistics import check_level
from brainbench.stimuli.engines.fidelity import MOST_LINKS


@dataclass(frozen=True)
@limited
class FitOptions:
    """How a fit simulates, weighs and judges; a value outside its range is a :class:`UsageError`."""

    priors: Literal["none", "published"] = "none"
    """Prior of the parameters: none, or published (means and spreads of measured whiskers)."""
    intervals: Literal["laplace", "profile"] = "laplace"
    """Confidence intervals: laplace (curvature of the likelihood at the best fit), or profile (takes longer)."""
    level: float = 0.95
    """Coverage of the confidence intervals."""
    loss: Literal["linear", "soft_l1", "huber", "cauchy"] = "linear"
    """Loss of a residual: linear (least squares), or soft_l1, huber or cauchy, which outliers pull less."""
    most_iterations: Count = 50
    """Iterations after which a fit counts as not converged."""
    links: Annotated[int, Limit(least=2, most=MOST_LINKS)] = 20
    """Links of each simulated whisker."""
    steps_per_period: Annotated[float, Limit(least=4)] = 400.0
    """Time steps in one period of the whisker's first mode at the start of the fit. Few steps damp higher modes, which
    biases stiffness and taper by more than the noise of a good sensor."""
    time_step: Annotated[float, Limit(above=0, unit="s")] = 1e-4
    """Longest time step (s)."""
    solver: Literal["dynamic", "quasistatic"] = "dynamic"
    """quasistatic leaves out inertia and damping, for slow contact."""
    twist: bool = True
    """Whether whiskers may twist."""

    def __post_init__(self) -> None:
        if self.intervals == "profile" and self.loss != "linear":
            raise UsageError(
                f"Profile intervals follow the squares of the residuals, and the loss {self.loss!r} is another; "
                "use intervals = 'laplace', or the loss 'linear'."
            )
        check_level(self.level)
