"""Accuracy of a whisker simulation: presets, and the cheapest setting for a wanted error.

Errors and costs are measured, not assumed: ``fidelity_table.json`` beside this module is written by
``python -m benchmarks.tradeoffs whisker`` and states how.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import field, replace
from functools import cache, lru_cache
from importlib import resources
from typing import TYPE_CHECKING, Annotated, Literal

from brainbench.core.errors import UsageError, brief, check_name, check_number
from brainbench.core.limits import Limit, Positive, limited, read_pairs, read_value, with_changes
from brainbench.core.tradeoffs import TradeoffPoint, cheapest
from brainbench.stimuli.whiskers.whisker import Chain, Whisker, build_chain

if TYPE_CHECKING:
    from brainbench.stimuli.motion.jobs import Job

logger = logging.getLogger(__name__)

DEFAULT_ENGINE = "rod"  # engine of whatever does not ask for one; it needs no GPU
MOST_LINKS = 100
"""Links per whisker that are allowed; error is far below 0.1 % before. MuJoCo's cost grows with their square."""
LARGEST_DAMPING = 1.15
"""Damping ratio of the steps over what was asked for beyond which a warning comes."""


@limited
class Fidelity:
    """Accuracy knobs of a whisker simulation; a value outside its range is a :class:`UsageError`."""

    links: Annotated[int, Limit(least=2, most=MOST_LINKS)] = 10
    """Links per whisker; the smallest number when ``links_per_mm`` is given."""
    links_per_mm: Positive | None = None
    """Links per millimetre of arc length, so that long whiskers get more; None for ``links`` on every whisker."""
    time_step: Annotated[float, Limit(least=1e-7, most=5e-3, unit="s")] = 1e-4
    """Longest time step [s]."""
    steps_per_period: Annotated[float, Limit(least=4, most=1e4)] | None = None
    """Least number of time steps in one period of a whisker's first mode, so that short, stiff whiskers get shorter
    steps; None for ``time_step`` on every whisker. The frequency of the first mode then comes out low, and its
    damping ratio high by about π / ``steps_per_period``."""
    precision: Literal["single", "double"] = "single"
    """Arithmetic of the ``rod`` backend; the others always use double precision."""
    solver: Literal["dynamic", "quasistatic"] = field(default="dynamic", metadata={"later": True})
    """``quasistatic`` leaves out inertia and damping: whiskers are in balance at every time step. For slow sweeps; of
    the backends ``rod`` alone knows it, and ``steps_per_period`` means nothing in it."""
    twist: bool | None = field(default=None, metadata={"later": True, "before": False})
    """True lets whiskers twist about their axis; one that stays in one plane is computed without in any case. None: as
    the scenes say (:attr:`brainbench.stimuli.scenes.scene.Scene.twist`), where the backend can."""
    contact_line: Literal["links", "rod"] | None = field(default=None, metadata={"later": True})
    """What contacts touch: the straight links, whose direction jumps at each joint, or the centre line of the bent rod,
    as beam theory tells it between the joints: with the same links many times nearer where a whisker is held between
    contacts or slides past one. The backend ``rod`` alone knows it. None: the rod where the backend can."""
    contact_tolerance: Annotated[float, Limit(least=1e-12, most=1e-3)] | None = field(
        default=None, metadata={"later": True}
    )
    """Relative error to which the contact forces of each step are solved, 1e-12 to 1e-3; below 1e-6 only in double
    precision. None: only few iterations, as always before there was this option; with friction this alone changes force
    and moment of some whiskers by several per cent. ``bullet`` solves them to 1e-9 in any case."""

    contact_travel: Annotated[float, Limit(above=0, most=2.5e-4, unit="m")] = field(
        default=2.5e-4, metadata={"later": True}
    )
    """Longest way [m] of any point of a whisker in one step near an object: ``rod`` splits steps to keep it."""
    error: Positive | None = field(default=None, metadata={"later": True})
    """Estimated error (:attr:`brainbench.stimuli.motion.jobs.Trace.error`) that is promised to each whisker: those
    beyond it are simulated again with more links and shorter steps, and those still beyond it have a remark. None:
    nothing is simulated again, and beyond :data:`.error_estimates.LARGEST_ERROR` whiskers have a remark."""

    def __post_init__(self) -> None:
        if self.precision == "single" and (self.contact_tolerance or 1) < FINEST_SINGLE:
            raise UsageError(
                f"contact_tolerance must be at least {FINEST_SINGLE:g} in single precision; received "
                f"{self.contact_tolerance:g}; choose precision=double for less."
            )

    @classmethod
    def preset(cls, name: str) -> Fidelity:
        """Return the preset called ``fast``, ``balanced`` or ``accurate``; any other is a :class:`UsageError`."""
        check_name("fidelity preset", name, _PRESETS)
        return cls(**_PRESETS[name])

    @classmethod
    def of(cls, value: Fidelity | str | None) -> Fidelity:
        """Return a fidelity as it is, one from its text (:meth:`parse`), or ``balanced`` for None."""
        return value if isinstance(value, Fidelity) else cls.parse(value or "balanced")

    @classmethod
    @lru_cache(64)
    def parse(cls, text: str) -> Fidelity:
        """Return a preset with some values replaced, as ``balanced`` or ``fast,links=12,solver=quasistatic``.

        Values stand in SI units, as the fields of this class; ``none`` stands for None. ``auto=0.1`` in place of a
        preset is :meth:`auto`.
        """
        preset, *words = (word.strip() for word in text.split(","))
        changes = read_pairs(words, f"The fidelity {brief(text)}", "links=12")
        name, _, error = (part.strip() for part in preset.partition("="))
        chosen = cls.auto(error=read_value("error", error, float)) if name == "auto" else cls.preset(preset)
        return with_changes(chosen, changes)

    @classmethod
    def auto(cls, *, error: float = 0.1, backend: str = DEFAULT_ENGINE) -> Fidelity:
        """Return a fidelity that promises each whisker an estimated error of at most ``error``.

        It begins with the cheapest measured setting with which half of the whiskers in random contacts err by no more;
        an engine simulates those again, finer, whose own estimate is larger (:attr:`error`). As text: ``auto=0.1``.
        """
        check_number("error (0.05 = 5 %)", error, above=0)
        return cls(**cheapest(measured(backend), error).settings, error=error)

    def resolved(self, twist: bool) -> Fidelity:
        """Return this fidelity with ``twist`` where it leaves that open."""
        return replace(self, twist=twist) if self.twist is None else self

    def touching(self, bodies: Iterable[object]) -> Fidelity:
        """Return this fidelity with what contacts with the bodies of a scene touch, where it leaves that open."""
        if self.contact_line is not None:
            return self
        return replace(self, contact_line="rod" if any(True for _ in bodies) else "links")

    def chain(self, whisker: Whisker) -> Chain:
        """Return the chain of links that stands for a whisker; errors as for :meth:`link_count`."""
        return build_chain(whisker, self.link_count(whisker.arc_length))

    def step_of(self, chain: Chain) -> float:
        """Return the time step [s] of a chain."""
        return self.step(chain.first_frequency / (2 * math.pi), chain.whisker.damping_ratio)

    def step(self, frequency: float, damping_ratio: float = math.inf) -> float:
        """Return the time step [s] of a whisker whose first mode has this frequency [Hz] and is to ring with a ratio.

        A step of h damps a mode ω by ω h/2 by itself, so that no step is longer than what the ratio leaves.
        """
        if self.steps_per_period is None or self.solver == "quasistatic":
            return self.time_step
        return min(self.time_step, 1 / (max(self.steps_per_period, steps_to_ring(damping_ratio)) * frequency))

    def damping_of(self, job: Job) -> float:
        """Return the damping ratio with which a whisker's first mode rings; NaN without inertia."""
        if self.solver == "quasistatic":
            return math.nan
        chain, between = self.chain(job.whisker), job.spacing
        step = self.step_of(chain)
        # Readings end a step.
        return chain.achieved_damping_ratio(step if between == math.inf else between / math.ceil(between / step - 1e-3))

    def warn_overdamped(self, jobs: Sequence[Job]) -> None:
        """Warn of time steps that damp a whisker by :data:`LARGEST_DAMPING` of what was asked for, or more."""
        places = {(job.whisker, job.spacing): job for job in jobs}
        ratios = [(self.damping_of(job), job.whisker.damping_ratio) for job in places.values()]
        over = [pair for pair in ratios if pair[0] > LARGEST_DAMPING * pair[1]]
        if over:
            logger.warning(
                "The time step of %g s damps the first mode of at least one whisker with ratio %.2f instead of %.2f; "
                "its ringing is lost, slow bending is not; choose a smaller step to keep it.",
                self.time_step,
                *max(over),
            )

    def link_count(self, arc_length: float) -> int:
        """Return the number of links of a whisker of this arc length [m]; too many are a :class:`UsageError`."""
        if self.links_per_mm is None:
            return self.links
        count = max(self.links, math.ceil(arc_length * 1e3 * self.links_per_mm))
        if count > MOST_LINKS:
            raise UsageError(
                f"{self.links_per_mm:g} links per mm make {count} links of a whisker of {arc_length * 1e3:.3g} mm; "
                f"at most {MOST_LINKS} are possible; choose fewer per mm."
            )
        return count


def steps_to_ring(damping_ratio: float) -> float:
    """Return the fewest steps in a period with which a mode rings with a ratio."""
    return math.pi / max(damping_ratio, LEAST_DAMPING)


FINEST_SINGLE = 1e-6  # least `contact_tolerance` in single precision, whose rounding is not far below it
LEAST_DAMPING = 0.05
"""Damping ratio below which steps are not shortened to keep it; isolated whiskers have .11 to .17."""
RESOLUTION = ("links", "links_per_mm", "time_step", "steps_per_period", "contact_tolerance")
"""Fields that the measured settings differ in."""

_PRESETS = {
    "fast": {"links": 8, "links_per_mm": 0.25, "time_step": 2e-4, "steps_per_period": 10},
    "balanced": {"links": 11, "links_per_mm": 0.4, "time_step": 1e-4, "steps_per_period": 34},
    "accurate": {"links": 20, "time_step": 5e-5, "steps_per_period": 120},
}


def list_presets() -> tuple[str, ...]:
    """Return the names that :meth:`Fidelity.preset` knows, cheapest first."""
    return tuple(_PRESETS)


@cache
def measured(backend: str = DEFAULT_ENGINE) -> tuple[TradeoffPoint, ...]:
    """Return the measured settings of a backend: the error below which half of the whiskers stay, and the cost.

    Both with an object on one side; what errs more elsewhere is for the estimate of each whisker to find. Cost is in
    processor s per whisker-second. A backend that was not measured is a :class:`UsageError`.
    """
    import json

    text = resources.files("brainbench.stimuli").joinpath("fidelity_table.json").read_text(encoding="utf-8")
    points: dict[str, list[TradeoffPoint]] = {}
    for point in json.loads(text)["points"]:
        if not point.get("collision") and point.get("solver", "dynamic") == "dynamic":
            error, cost = (math.inf if point[name] is None else point[name] for name in ("error_50", "cost"))
            settings = {name: point.get(name) for name in RESOLUTION}
            points.setdefault(point["backend"], []).append(TradeoffPoint(error, cost, settings))
    check_name("measured backend", backend, points)
    return tuple(points[backend])
