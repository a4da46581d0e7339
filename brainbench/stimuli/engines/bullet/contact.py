"""Contacts of one time step with Coulomb friction, solved together with the implicit springs.

Letters: m contact; rows of a contact are its normal and two tangents.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

MOST_SWEEPS = 3000
"""Gauss–Seidel sweeps over the contacts of one step before they count as unsolved."""
SWEEPS = 12
"""Sweeps between two attempts to finish by Newton's method, which needs to know what touches and what slides."""
MOST_ITERATIONS = 12
"""Newton iterations of one attempt."""
TOLERANCE = 1e-9
"""Relative change of the forces in one sweep at which they count as solved."""


def contact_axes(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rows [3, 3]: the unit ``normal`` and two tangents that complete a right-handed frame.

    After Duff et al. (2017), Building an orthonormal basis, revisited.
    """
    x, y, z = normal.tolist()
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[x, y, z], [1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]])


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix [3, 3] that, applied to u, gives u × ``vector``."""
    x, y, z = vector.tolist()
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


def solve_contacts(
    yielding: NDArray[np.float64], free: NDArray[np.float64], friction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], bool]:
    """Find the forces [3m] that keep gaps open and obey Coulomb's law, and whether they were found.

    At the end of the step row r has moved to ``free[r] + yielding[r] · f``, with the symmetric ``yielding`` [3m, 3m]. A
    normal row is a gap: it stays ≥ 0, its force is ≥ 0 and acts only at 0. Tangent rows are slips: they are 0 while the
    tangential force is at most ``friction`` [m] times the normal one, which otherwise opposes the slip.
    """
    force = np.zeros(len(free))
    for _ in range(MOST_SWEEPS // SWEEPS):
        if _sweep(yielding, free, friction, force):
            return force, True
        finished = _finish(yielding, free, friction, force)
        if finished is not None:
            return finished, True
    return force, False


def _sweep(yielding: NDArray, free: NDArray, friction: NDArray, force: NDArray) -> bool:
    """Improve ``force`` in place, one contact after the other; return whether it is solved."""
    moved = free + yielding @ force
    for _ in range(SWEEPS):
        change = 0.0
        for contact, limit in enumerate(friction.tolist()):
            n = 3 * contact
            # At the base point a force has no lever and moves nothing.
            if not yielding[n, n]:
                continue
            # Exact solution of the one normal row, held at a force of zero: one step of projected Gauss–Seidel.
            step = max(-force[n], -moved[n] / yielding[n, n])
            if step:
                force[n] += step
                moved += yielding[:, n] * step
                change = max(change, abs(step))
            if not limit:
                continue
            tangents = slice(n + 1, n + 3)
            # Both tangents together, within the disc of Coulomb's law for the present normal force.
            block = yielding[tangents, tangents]
            pair = hold_or_slide(block, moved[tangents] - block @ force[tangents], limit * force[n])
            difference = pair - force[tangents]
            if difference.any():
                force[tangents] = pair
                moved += yielding[:, tangents] @ difference
                change = max(change, float(np.abs(difference).max()))
        if change <= TOLERANCE * np.abs(force).max():
            return True
    return False


def _finish(yielding: NDArray, free: NDArray, friction: NDArray, start: NDArray) -> NDArray[np.float64] | None:
    """Solve by a semi-smooth Newton method from ``start``; None when it does not converge.

    The unknown zero is f − P(f − w/ρ), P being the projection on Coulomb's cone taken row by row (Alart and
    Curnier 1991), written as w = 0 where a contact holds and as the law of its force elsewhere.
    """
    force, scale = start.copy(), 1 / yielding.diagonal()
    for _ in range(MOST_ITERATIONS):
        moved = free + yielding @ force
        residual, slope = force.copy(), np.eye(len(force))
        missed = 0.0
        for contact, limit in enumerate(friction.tolist()):
            n, tangents = 3 * contact, slice(3 * contact + 1, 3 * contact + 3)
            # Sign of f − w/ρ tells which branch of the projection holds: open, sticking or sliding. Rows of an open
            # contact stay as the identity, which sets its force to zero.
            pressed = force[n] - scale[n] * moved[n]
            missed = max(missed, abs(force[n] - max(pressed, 0.0)))
            if pressed <= 0:
                missed = max(missed, float(np.abs(force[tangents]).max()))
                continue
            residual[n], slope[n] = moved[n], yielding[n]
            if not limit:
                continue
            rate = float(scale[tangents].min())
            pushed = force[tangents] - rate * moved[tangents]
            size, most = float(np.hypot(*pushed)), limit * max(force[n], 0.0)
            if size <= most:
                residual[tangents], slope[tangents] = moved[tangents], yielding[tangents]
                missed = max(missed, rate * float(np.abs(moved[tangents]).max()))
                continue
            way = pushed / size
            residual[tangents] = force[tangents] - most * way
            missed = max(missed, float(np.abs(residual[tangents]).max()))
            # Derivative of the projection on the disc: turning with the slip, growing with the normal force.
            across = most / size * (np.eye(2) - np.outer(way, way))
            slope[tangents] += rate * across @ yielding[tangents]
            slope[tangents, tangents] -= across
            slope[tangents, n] -= limit * way
        if missed <= TOLERANCE * np.abs(force).max():
            rows = force.reshape(-1, 3)
            rows[rows[:, 0] <= 0] = 0.0
            return force
        try:
            force -= np.linalg.solve(slope, residual)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(force).all():
            return None
    return None


def hold_or_slide(yielding: NDArray[np.float64], slip: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """Return the tangential force [2] of at most ``most`` that stops the slip, or that opposes what slip remains.

    It minimises ½ f·Y f + s·f over the disc of radius ``most``, Y [2, 2] being the ``yielding`` and s [2] the
    ``slip`` without force. A whisker yields a thousand times less along itself than across, so both
    directions are solved at once.
    """
    if not most:
        return np.zeros(2)
    (a, b), (_, c) = yielding.tolist()
    # Axes of the 2 × 2 matrix: there the law for a multiplier λ reads f = −s / (Y + λ), one scalar equation for |f| =
    # most.
    turn = 0.5 * math.atan2(2 * b, a - c)
    cosine, sine = math.cos(turn), math.sin(turn)
    middle, half = (a + c) / 2, math.hypot((a - c) / 2, b)
    stiff = (middle + half, max(middle - half, 1e-15 * middle))
    s = (cosine * slip[0] + sine * slip[1], cosine * slip[1] - sine * slip[0])
    shift = 0.0
    # Newton's method on 1/|f(shift)| = 1/most rises to the root from below and never passes it.
    for _ in range(60):
        f = [-s[0] / (stiff[0] + shift), -s[1] / (stiff[1] + shift)]
        size = math.hypot(*f)
        if size <= most * (1 + 1e-14):
            break
        slope = f[0] ** 2 / (stiff[0] + shift) + f[1] ** 2 / (stiff[1] + shift)
        shift += (size / most - 1) * size**2 / slope
    return np.array([cosine * f[0] - sine * f[1], sine * f[0] + cosine * f[1]])
