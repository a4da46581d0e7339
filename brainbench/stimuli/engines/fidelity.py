"""Accuracy of a whisker simulation: presets, and the cheapest setting for a wanted error.

Errors and costs are measured, not assumed: ``fidelity_table.json`` beside this module is written by
``brainbench tradeoff whisker`` (``brainbench/tradeoffs``) and states how.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from typing import Annotated, Literal

from brainbench.core.errors import UsageError, brief, check_name
from brainbench.core.limits import Limit, Positive, limited
from brainbench.core.overrides import read_pairs, read_value, with_changes
from brainbench.core.reading.ranges import check_number
from brainbench.core.tradeoffs import TradeoffPoint, cheapest
from brainbench.stimuli.whiskers.chain import Chain
from brainbench.stimuli.whiskers.whisker import Whisker

DEFAULT_ENGINE = "rod"
"""Engine of whatever does not ask for one; it needs no GPU."""
MOST_LINKS = 100
"""Links per whisker that are allowed; error is far below 0.1 % before. MuJoCo's cost grows with their square."""


@dataclass(frozen=True)
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
    contact_tolerance: Annotated[float, Limit(least=1e-12, most=1e-3)] | None = field(
        default=None, metadata={"later": True}
    )
    """Relative error to which the contact forces of each step are solved, 1e-12 to 1e-3; below 1e-6 only in double
    precision. None: only few iterations, as always before there was this option; with friction this alone changes force
    and moment of some whiskers by several per cent. ``bullet`` solves them to 1e-9 in any case."""

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
    def auto(cls, *, error: float = 0.1, share: float = 0.9, backend: str = DEFAULT_ENGINE) -> Fidelity:
        """Return the cheapest measured setting with which a share of the whiskers err by at most ``error``.

        Measured were mouse and rat whiskers that whisk at 5 to 20 Hz against posts, balls, edges and hollows with
        friction 0 to .8 (:mod:`brainbench.stimuli.validation.contact_scenes`): relative error of base force or moment,
        root mean square over the time. A setting is taken when the measured share stays below :data:`MARGIN` of
        ``error``, so that other scenes keep the promise (benchmarks/RESULTS.md, "Settings chosen for an error"). As
        text: ``auto=0.1``.
        """
        check_number("error (0.05 = 5 %)", error, above=0)
        return cls(**cheapest(measured(backend, share), error).settings)

    def resolved(self, twist: bool) -> Fidelity:
        """Return this fidelity with ``twist`` where it leaves that open."""
        return replace(self, twist=twist) if self.twist is None else self

    def chain(self, whisker: Whisker) -> Chain:
        """Return the chain of links that stands for a whisker; errors as for :meth:`link_count`."""
        from brainbench.stimuli.whiskers.chain import build_chain

        return build_chain(whisker, self.link_count(whisker.arc_length))

    def step_of(self, chain: Chain) -> float:
        """Return the time step [s] of a chain."""
        return self.step(float(chain.frequencies()[0]) / (2 * math.pi))

    def step(self, frequency: float) -> float:
        """Return the time step [s] of a whisker whose first mode has this frequency [Hz]."""
        if self.steps_per_period is None or self.solver == "quasistatic":
            return self.time_step
        return min(self.time_step, 1 / (self.steps_per_period * frequency))

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


FINEST_SINGLE = 1e-6
"""Least ``contact_tolerance`` in single precision, whose rounding is not far below it."""
SHARES = {0.5: "error_50", 0.9: "error_90", 0.95: "error_95"}
"""Shares of whiskers, and the column of the table with the relative error that they stay below."""
MARGIN = 0.85
"""Measured over promised error: the sample of scenes must not decide whether a promise holds."""
RESOLUTION = ("links", "links_per_mm", "time_step", "steps_per_period", "contact_tolerance")
"""Fields that the measured settings differ in."""

_PRESETS = {
    "fast": {"links": 8, "links_per_mm": 0.25, "time_step": 2e-4, "steps_per_period": 10},
    "balanced": {"links": 11, "links_per_mm": 0.4, "time_step": 1e-4, "steps_per_period": 25},
    "accurate": {"links": 20, "time_step": 5e-5, "steps_per_period": 120},
}


def list_presets() -> tuple[str, ...]:
    """Return the names that :meth:`Fidelity.preset` knows, cheapest first."""
    return tuple(_PRESETS)


@cache
def measured(backend: str = DEFAULT_ENGINE, share: float = 0.9) -> tuple[TradeoffPoint, ...]:
    """Return the measured settings of a backend: the error that a share of the whiskers is promised, and the cost.

    Cost is in processor s per whisker-second. A backend or a share that was not measured is a :class:`UsageError`.
    """
    import json

    if share not in SHARES:
        raise UsageError(f"share must be one of {', '.join(map(str, SHARES))}; received {brief(share)}.")
    text = resources.files("brainbench.stimuli").joinpath("fidelity_table.json").read_text(encoding="utf-8")
    points: dict[str, list[TradeoffPoint]] = {}
    for point in json.loads(text)["points"]:
        if not point.get("collision") and point.get("solver", "dynamic") == "dynamic":
            error, cost = (math.inf if point[name] is None else point[name] for name in (SHARES[share], "cost"))
            settings = {name: point.get(name) for name in RESOLUTION}
            points.setdefault(point["backend"], []).append(TradeoffPoint(error / MARGIN, cost, settings))
    check_name("measured backend", backend, points)
    return tuple(points[backend])
