"""Parameters that a fit can estimate: how each changes a trial, its unit, its bounds, its scale and what is published.

A fit works on one dimensionless coordinate u a parameter: the logarithm of its value over the start value where it is
positive by nature, else its difference from the start value over :attr:`Parameter.scale`. u is 0 at the start.
Priors are normal laws, of logarithms for positive parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np

from brainbench.core.errors import UsageError, check_each
from brainbench.core.limits import Count, Limit, Positive, limited
from brainbench.core.reading.ranges import check_number
from brainbench.core.statistics import check_level
from brainbench.stimuli.engines.fidelity import MOST_LINKS
from brainbench.stimuli.fitting.gradients.parameters import WHISKER, JobParameters, whisker_value, with_values
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.whiskers.whisker import Whisker


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


@dataclass(frozen=True)
class Condition:
    """Everything about a trial that a fit may change: values of :data:`PARAMETERS`, as ``condition["base_x"]``."""

    whisker: Whisker
    others: Mapping[str, float] = field(default_factory=dict)
    """Values of parameters that are not the whisker's; displacements that are not named are 0."""

    def __getitem__(self, name: str) -> float:
        """Return the value of a parameter; of a deflection that no trial has NaN."""
        if name in WHISKER:
            return whisker_value(self.whisker, name)
        return self.others.get(name, math.nan if name == "deflection" else 0.0)

    def changed(self, values: Mapping[str, float]) -> Condition:
        """Return a condition with other values of some parameters."""
        material = {name: value for name, value in values.items() if name in WHISKER}
        return Condition(
            with_values(self.whisker, material), {**self.others, **{k: values[k] for k in values if k not in material}}
        )

    def job(self, job: Job) -> Job:
        """Return the job of a trial under this condition, but for what holds its whisker aside."""
        job = replace(job, whisker=self.whisker)
        moves = {PARAMETERS[name].of_job: value for name, value in self.others.items() if value}
        moves.pop("", None)
        return JobParameters([job], tuple(moves)).build(np.array([*moves.values()]))[0] if moves else job


@dataclass(frozen=True)
class Parameter:
    """One parameter that a fit can estimate."""

    name: str
    unit: str
    kind: Literal["log", "linear"]
    """``log``: positive, fitted as the logarithm of its ratio to the start value."""
    low: float
    """Lower bound: a ratio to the start value for ``log``, else in multiples of the scale around the start value."""
    high: float
    what: str
    """What it is, in words."""
    scale: float = 1.0
    """Length of one unit of u: a value for ``linear`` (for ``length`` and ``curvature`` scaled by the whisker)."""
    of_length: int = 0
    """Power of the arc length that ``scale`` is multiplied by."""
    of_job: str = ""
    """Displacement of :class:`brainbench.stimuli.fitting.gradients.JobParameters` that it is."""
    real: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest value of real whiskers, a little wider than what was published."""

    def unit_of(self, whisker: Whisker) -> float:
        """Return what one unit of u is worth, in the parameter's unit; of ``log`` parameters 1."""
        return self.scale * whisker.arc_length**self.of_length

    def value(self, start: float, u: float, whisker: Whisker) -> float:
        """Return the value at coordinate u of a fit that began at ``start``."""
        return start * math.exp(u) if self.kind == "log" else start + u * self.unit_of(whisker)

    def coordinate(self, start: float, value: float, whisker: Whisker) -> float:
        """Return the coordinate u of a value."""
        return math.log(value / start) if self.kind == "log" else (value - start) / self.unit_of(whisker)


def _positive(name: str, unit: str, what: str, low: float = 0.1, high: float = 10.0, **others: Any) -> Parameter:
    return Parameter(name, unit, "log", low, high, what, **others)


def _shift(name: str, what: str, of_job: str) -> Parameter:
    return Parameter(name, "m", "linear", -4.0, 4.0, what, 0.05, 1, of_job)


PARAMETERS: Mapping[str, Parameter] = {
    parameter.name: parameter
    for parameter in (
        _positive("young_modulus", "Pa", "Young's modulus", real=(1e9, 1e10)),
        _positive(
            "density", "kg/m³", "density at the base; the ratio of tip to base is kept", 0.2, 5.0, real=(800.0, 2000.0)
        ),
        _positive("damping_ratio", "", "damping ratio of the first mode", real=(0.01, 1.0)),
        _positive("base_radius", "m", "radius at the base", 0.2, 5.0),
        _positive("tip_radius", "m", "radius at the tip, which sets the taper", 0.05, 20.0),
        _positive("arc_length", "m", "length along the whisker", 0.5, 2.0),
        Parameter("curvature", "1/m", "linear", -30.0, 30.0, "coefficient A of the rest shape y = A x²", 0.1, -1),
        Parameter("friction", "", "linear", -10.0, 10.0, "Coulomb coefficient of the whisker", 0.3),
        # θ turns about the z axis last, so that its change is a turn about z of the whole base.
        Parameter("base_angle", "rad", "linear", -10.0, 10.0, "turn of the base about z", 0.05, of_job="base.theta"),
        *(_shift(f"base_{axis}", f"displacement of the base along {axis}", f"base.{axis}") for axis in "xyz"),
        *(_shift(f"object_{axis}", f"displacement of the objects along {axis}", f"objects.{axis}") for axis in "xyz"),
        _positive("deflection", "m", "deflection of the plucked point before its release", 0.05, 20.0),
    )
}
"""Parameters by name."""


@dataclass(frozen=True)
class FreeParameters:
    """The parameters of one fit, with their start values and bounds."""

    names: tuple[str, ...]
    start: Condition
    """Condition whose values the fit starts from."""
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Bounds of single parameters, in their units; others as in :data:`PARAMETERS`."""

    def __post_init__(self) -> None:
        check_each("parameter of a fit", self.names, PARAMETERS)
        check_each("fitted parameter with bounds", self.bounds, self.names)
        if not self.names or len(set(self.names)) < len(self.names):
            raise UsageError(f"A fit needs at least one parameter, each once; received {list(self.names)}.")
        for name in self.names:
            value = self.start[name]
            if math.isnan(value):
                raise UsageError(f"{name!r} is a parameter of a ring-down, and no trial here is one; leave it out.")
            if PARAMETERS[name].kind == "log" and not value > 0:
                raise UsageError(f"The fit of {name!r} starts at {value:g}; give a positive start value.")

    def __len__(self) -> int:
        return len(self.names)

    def values(self, u: Any) -> tuple[float, ...]:
        """Return the values at coordinates u [p]."""
        whisker = self.start.whisker
        return tuple(
            PARAMETERS[name].value(self.start[name], float(value), whisker)
            for name, value in zip(self.names, u, strict=True)
        )

    def condition(self, u: Any) -> Condition:
        """Return the condition at coordinates u [p]."""
        return self.start.changed(dict(zip(self.names, self.values(u), strict=True)))

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bounds of u [p]; a start value outside its bounds is a :class:`UsageError`."""
        rows = [self._limits(name) for name in self.names]
        low, high = np.array(rows).T
        return low, high

    def _limits(self, name: str) -> tuple[float, float]:
        parameter, start = PARAMETERS[name], self.start[name]
        low, high = parameter.low, parameter.high
        if parameter.kind == "log":
            low, high = math.log(low), math.log(high)
        if name == "friction":
            low = parameter.coordinate(start, 0.0, self.start.whisker)
        if name in self.bounds:
            ends = self.bounds[name]
            if not ends[0] < start < ends[1]:
                raise UsageError(
                    f"The start value of {name!r}, {start:g}, does not lie between its bounds {ends[0]:g} and "
                    f"{ends[1]:g}; change one of them."
                )
            # A logarithm has no bound at 0.
            low, high = (
                parameter.coordinate(start, end, self.start.whisker) if end > 0 or parameter.kind == "linear" else -12.0
                for end in ends
            )
        return low, high


@dataclass(frozen=True)
@limited(of="The {} of a prior")
class Prior:
    """What is known of a parameter before a fit."""

    mean: float
    """Mean, in the parameter's unit; of the logarithm for positive parameters (then the median)."""
    spread: Positive
    """Standard deviation; relative for positive parameters."""
    source: str

    def row(self, name: str, start: float, whisker: Whisker) -> tuple[float, float]:
        """Return the mean and the standard deviation of the coordinate u of a fit that began at ``start``."""
        parameter = PARAMETERS[name]
        if parameter.kind == "log":
            check_number(f"The mean of the prior of {name!r}", self.mean, above=0)
        spread = self.spread if parameter.kind == "log" else self.spread / parameter.unit_of(whisker)
        return parameter.coordinate(start, self.mean, whisker), spread


def _log_spread(mean: float, deviation: float) -> float:
    """Return the standard deviation of the logarithm of a log-normal law with this mean and standard deviation."""
    return math.sqrt(math.log1p((deviation / mean) ** 2))


PUBLISHED: Mapping[str, Prior] = {
    "young_modulus": Prior(
        3.34e9, _log_spread(3.34, 1.48), "Quist et al. (2011), J. Biomech. 44, 2775-2781: 3.34 ± 1.48 GPa"
    ),
    "density": Prior(
        1260.0,
        0.15,
        "Yang, Belli & Hartmann (2019), J. Neurophysiol. 121, 1879-1895: 1260 (base) to 1690 kg/m³ (tip); "
        "the spread is half of that range",
    ),
    "damping_ratio": Prior(
        math.sqrt(0.11 * 0.17),
        math.log(0.17 / 0.11) / 2,
        "isolated whiskers ring with .11 to .17, taken as ± 1 "
        "standard deviation; a whisker in its follicle may be damped more",
    ),
    "friction": Prior(
        0.48, 0.15, "rat whisker on stainless steel, IEEE Trans. Haptics (2017), PMC5753595: .48; the spread is ours"
    ),
}
"""Priors by parameter; others have none."""
