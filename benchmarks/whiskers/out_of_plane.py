"""Curved published whiskers loaded out of their plane, against the Kirchhoff rod; a part of ``validation``."""

from __future__ import annotations

import math
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

from benchmarks.report import table
from brainbench.core.errors import BrainbenchError
from brainbench.stimuli.validation import references
from brainbench.stimuli.validation.out_of_plane import load_aside, push_aside
from brainbench.stimuli.whiskers.array import WhiskerArray

SUBJECTS = ("mouse C2", "mouse C5", "mouse D0", "rat C1", "rat D4", "rat B1")
ARCS = (0.5, 0.8)
OFFSETS = (0.05, 0.1, 0.2)
SETTINGS = ("accurate", "balanced", "fast", "accurate,twist=false")
GATES = {"accurate": 0.005, "balanced": 0.02, "fast": 0.1}
"""Largest relative errors of deflection under a force, and of force and moment on a peg that moves by at most a tenth
of the arc length. Beyond that the contact stands so obliquely to the polygon of links that its direction counts."""


def measure(name: str, backend: str) -> dict[tuple[float, float, str], tuple[float, float, float]]:
    """Errors of one whisker: deflection under a force, force and moment on a peg."""
    species, label = name.split()
    whisker = WhiskerArray.of(species)[label].whisker
    length, straight = whisker.arc_length, replace(whisker, curvature=0.0)
    found = {}
    for at in ARCS:
        for offset in OFFSETS:
            # The force that would bend a straight whisker by the offset.
            force = offset * length / references.point_load_deflection(straight, 1.0, at * length)
            for setting in SETTINGS:
                how = {"backend": backend, "fidelity": setting}
                load = load_aside(whisker, at * length, force, **how)
                try:
                    peg = push_aside(whisker, at * length, offset * length, **how)
                    errors = peg.force_error, peg.moment_error
                except BrainbenchError:
                    errors = math.nan, math.nan
                found[at, offset, setting] = load.deflection / load.reference_deflection - 1, *errors
    return found


def report(pool: Executor, backend: str) -> tuple[str, list[str]]:
    """Return the table and the broken gates."""
    rows, broken = [], []
    for name, found in zip(SUBJECTS, pool.map(partial(measure, backend=backend), SUBJECTS), strict=True):
        for at in ARCS:
            for offset in OFFSETS:
                row = [name, f"{at:g}", f"{offset:g}"]
                for setting in SETTINGS:
                    errors = found[at, offset, setting]
                    gated = setting in GATES and offset <= 0.1
                    peg = "—" if math.isnan(errors[1]) else f"{100 * errors[1]:.2f} / {100 * errors[2]:.2f}"
                    row.append(f"{100 * errors[0]:+.2f}; {peg if offset <= 0.1 or peg == '—' else f'({peg})'}")
                    kept = errors if gated else errors[:1]
                    if setting in GATES and not all(abs(error) <= GATES[setting] for error in kept):
                        broken.append(f"{setting} {name} {at} {offset}: {row[-1]}")
                rows.append(row)
    gates = ", ".join(f"{100 * gate:g} % at `{name}`" for name, gate in GATES.items())
    text = (
        "Curved whiskers, Poisson's ratio .4. First the error in % of the deflection under a force across the plane "
        "that would bend the straight whisker by d; then, of a frictionless peg (radius .25 mm) that moves by d "
        f"across the plane, the error of force / moment at the base. Gates: {gates}; pegs at d/L .2 in brackets and "
        "not gated, — where the rod slips off. Reference: `brainbench.stimuli.validation.kirchhoff`.\n\n"
    )
    text += table(["whisker", "a/L", "d/L", *SETTINGS], rows)
    text += "\n\nBroken gates: " + ("none." if not broken else "\n\n" + "\n".join(f"- {line}" for line in broken))
    return text, broken
