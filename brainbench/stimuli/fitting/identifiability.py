"""Which parameters the data can tell: the Fisher information, its singular directions, and these in words.

With whitened residuals of Jacobian J [m, p] the Fisher information is JᵀJ (Seber & Wild 2003, Nonlinear Regression,
chapter 2). A direction v with singular value s is known with a standard deviation of 1/s: along it, coordinates may
change by that much without the data noticing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.fitting.parameters import PARAMETERS

Array = NDArray[np.float64]
UNKNOWN = 0.7
"""Standard deviation along a direction, in coordinates (a factor of 2), from which it counts as not identified."""
MEMBER = 0.1
"""Share of the largest component of a direction from which a parameter belongs to it."""


@dataclass(frozen=True, eq=False)
class Direction:
    """A combination of parameters that the data tell to a known precision."""

    deviation: float
    """Standard deviation along it, in coordinates: relative for positive parameters; inf when nothing is known."""
    members: tuple[str, ...]
    """Parameters that take part, the most first."""
    components: tuple[float, ...]
    """Their components, the largest 1 or −1."""
    identified: bool
    words: str
    """What it means."""


def directions(jacobian: Array, names: Sequence[str], noise: float = 1.0) -> tuple[Direction, ...]:
    """Return the singular directions of a whitened Jacobian [m, p], the worst known first.

    ``noise`` multiplies the standard deviations: the residuals' own, where whitening took another.
    """
    _, singular, rows = np.linalg.svd(np.nan_to_num(jacobian), full_matrices=False)
    least = singular.max(initial=0.0) * 1e-10
    found = []
    for value, row in zip(singular[::-1], rows[::-1], strict=True):
        deviation = noise / value if value > max(least, 1e-300) else math.inf
        found.append(_direction(deviation, row, names))
    return tuple(found)


def _direction(deviation: float, row: Array, names: Sequence[str]) -> Direction:
    order = np.argsort(-np.abs(row))
    order = order[np.abs(row[order]) > MEMBER * np.abs(row).max()]
    components = row[order] / row[order[0]]
    members = tuple(names[int(index)] for index in order)
    known = deviation < UNKNOWN
    return Direction(deviation, members, tuple(components.tolist()), known, _words(deviation, members, components))


def _words(deviation: float, members: Sequence[str], components: Array) -> str:
    known = deviation < UNKNOWN
    if len(members) == 1:
        if not known:
            return f"The data hardly depend on {members[0]}."
        return f"{members[0]} is known to {_size(members[0], deviation)}."
    # An example that one can check: the first parameter grows by a tenth, or by one unit of its scale.
    ratio = math.log(1.1) if PARAMETERS[members[0]].kind == "log" else 1.0
    changes = [
        f"{name} × {math.exp(ratio * share):.3g}"
        if PARAMETERS[name].kind == "log"
        else f"{name} {ratio * share:+.2g} of its scale"
        for name, share in zip(members, components, strict=True)
    ]
    together = ", ".join(changes[:-1]) + f" together with {changes[-1]}"
    if not known:
        return f"The data cannot tell {_listed(members)} apart: {together} leaves them as they are."
    return f"The combination {together} is known to {_size(members[0], deviation * abs(components[0]))}."


def _size(name: str, deviation: float) -> str:
    return f"{100 * deviation:.2g} %" if PARAMETERS[name].kind == "log" else f"{deviation:.2g} of its scale"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + f" and {names[-1]}"


def unknown_parameters(found: Sequence[Direction]) -> dict[str, Direction]:
    """Return the parameters that take part in a direction that is not identified, each with the worst such "
    "direction."""
    worst: dict[str, Direction] = {}
    for direction in found:
        if not direction.identified:
            for name, share in zip(direction.members, direction.components, strict=True):
                norm = math.sqrt(sum(one**2 for one in direction.components))
                if not math.isfinite(direction.deviation) or abs(share) / norm * direction.deviation > UNKNOWN / 2:
                    worst.setdefault(name, direction)
    return worst
