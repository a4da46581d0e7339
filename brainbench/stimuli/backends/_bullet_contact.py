"""Contacts of one time step with Coulomb friction, solved together with the implicit springs.

Letters: m contact; rows of a contact are its normal and two tangents.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

MOST_SWEEPS = 5000
"""Gauss–Seidel sweeps over the contacts of one step before they count as unsolved."""
TOLERANCE = 1e-9
"""Relative change of the forces in one sweep at which they count as solved."""


def contact_axes(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows [3, 3]: the unit ``normal`` and two tangents that complete a right-handed frame.

    After Duff et al. (2017), Building an orthonormal basis, revisited.
    """
    x, y, z = normal.tolist()
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[x, y, z], [1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]])


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix [3, 3] that, applied to u, gives u × ``vector``."""
    x, y, z = vector.tolist()
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


def solve_contacts(
    yielding: NDArray[np.float64], free: NDArray[np.float64], friction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], bool]:
    """Find the forces [3m] that keep gaps open and obey Coulomb's law, and whether they were found.

    At the end of the step row r has moved to ``free[r] + yielding[r] · f``. A normal row is a gap: it stays
    ≥ 0, its force is ≥ 0 and acts only at 0. Tangent rows are slips: they are 0 while the tangential force
    is at most μ times the normal one, which otherwise opposes the slip.

    Args:
        yielding: symmetric displacement per force [3m, 3m].
        free: gaps and slips [3m] without contact forces.
        friction: Coulomb coefficient of each contact [m].
    """
    force, moved = np.zeros(len(free)), free.copy()
    diagonal = yielding.diagonal()
    for _ in range(MOST_SWEEPS):
        change = 0.0
        for contact, limit in enumerate(friction):
            n = 3 * contact
            step = max(-force[n], -moved[n] / diagonal[n])
            if step:
                force[n] += step
                moved += yielding[:, n] * step
                change = max(change, abs(step))
            if not limit:
                continue
            tangents = slice(n + 1, n + 3)
            block = yielding[tangents, tangents]
            pair = hold_or_slide(block, moved[tangents] - block @ force[tangents], limit * force[n])
            difference = pair - force[tangents]
            if difference.any():
                force[tangents] = pair
                moved += yielding[:, tangents] @ difference
                change = max(change, float(np.abs(difference).max()))
        if change <= TOLERANCE * np.abs(force).max():
            return force, True
    return force, False


def hold_or_slide(yielding: NDArray[np.float64], slip: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """Tangential force [2] of at most ``most`` that stops the slip, or that opposes what slip remains.

    It minimises ½ f·Y f + s·f over the disc of radius ``most``, Y [2, 2] being the ``yielding`` and s [2] the
    ``slip`` without force. A whisker yields a thousand times less along itself than across, so both
    directions are solved at once.
    """
    if not most:
        return np.zeros(2)
    (a, b), (_, c) = yielding.tolist()
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
