"""Curved published whiskers loaded out of their plane, against the Kirchhoff rod; a part of ``validation``."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

from benchmarks.report import table
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.out_of_plane import load_aside, push_aside

SUBJECTS = ("mouse C2", "mouse C5", "rat C1", "rat D4")
ARCS = (0.5, 0.8)
OFFSETS = (0.1,)
SETTINGS = ("accurate", "balanced", "fast", "accurate,twist=false")
GATES = {"accurate": 0.005, "balanced": 0.02, "fast": 0.1}
"""Largest relative errors of deflection under a force, and of force and moment on a peg. Where a peg moves farther, it
stands so obliquely to the polygon of links that the direction of its force shows the polygon."""


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
                load = load_aside(whisker, at * length, force, backend=backend, fidelity=setting)
                peg = push_aside(whisker, at * length, offset * length, backend=backend, fidelity=setting)
                stiffness = load.deflection / load.reference_deflection - 1
                found[at, offset, setting] = stiffness, peg.force_error, peg.moment_error
    return found


def report(pool: Executor, backend: str) -> tuple[str, list[str]]:
    """Return the table and the broken gates."""
    rows, broken = [], []
    for name, found in zip(SUBJECTS, pool.map(partial(measure, backend=backend), SUBJECTS), strict=True):
        for at in ARCS:
            for offset in OFFSETS:
                row = [name, f"{at:g}", f"{offset:g}"]
                for setting in SETTINGS:
                    deflection, force, moment = found[at, offset, setting]
                    row.append(f"{100 * deflection:+.2f}; {100 * force:.2f} / {100 * moment:.2f}")
                    worst = max(abs(deflection), force, moment)
                    if setting in GATES and not worst <= GATES[setting]:
                        broken.append(f"{setting} {name} {at} {offset}: {row[-1]}")
                rows.append(row)
    gates = ", ".join(f"{100 * gate:g} % at `{name}`" for name, gate in GATES.items())
    text = (
        "Curved whiskers, Poisson's ratio .4. First the error in % of the deflection under a force across the plane "
        "that would bend the straight whisker by d; then, of a frictionless peg (radius .25 mm) that moves by d "
        f"across the plane, the error of force / moment at the base. Gates: {gates}. "
        "Reference: `tests.factories.kirchhoff`.\n\n"
    )
    text += table(["whisker", "a/L", "d/L", *SETTINGS], rows)
    text += "\n\nBroken gates: " + ("none." if not broken else "\n\n" + "\n".join(f"- {line}" for line in broken))
    return text, broken
