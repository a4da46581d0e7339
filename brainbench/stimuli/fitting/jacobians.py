"""Jacobians of predicted measurements: a provider turns coordinates of the parameters into derivatives.

The one here is central differences in double precision. All whiskers of a point, two for each parameter and trial, are
jobs of a single run of the engine: on a GPU that is one launch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError

Array = NDArray[np.float64]
Evaluate = Callable[[Sequence[Array]], list[Array]]
"""Coordinates [p] of several parameter sets → residuals [m] of each, NaN where the simulation cannot be trusted."""


class JacobianProvider(Protocol):
    """Computes the derivatives of residuals by the coordinates of the parameters."""

    name: ClassVar[str]
    """How it computes them, for the provenance of a result."""

    def jacobian(self, evaluate: Evaluate, u: Array, limits: tuple[Array, Array]) -> Array:
        """Return the derivatives [m, p] at coordinates u [p] that lie between ``limits``.

        Raises:
            DataError: the simulations around u cannot be trusted.
        """
        ...


@dataclass(frozen=True)
class CentralDifferences:
    """Central differences; one-sided where the other side lies beyond a bound or its simulation is not trusted."""

    step: float = 2e-3
    """Step of the coordinates: truncation is of its square, and rounding of double precision far below."""

    name: ClassVar[str] = "central differences in double precision, all whiskers of a point in one run of the engine"

    def jacobian(self, evaluate: Evaluate, u: Array, limits: tuple[Array, Array]) -> Array:
        """See :meth:`JacobianProvider.jacobian`."""
        count = len(u)
        ends = [np.clip(u + sign * self.step * np.eye(count)[j], *limits) for j in range(count) for sign in (1, -1)]
        values = evaluate(ends)
        columns = []
        for j in range(count):
            above, below = values[2 * j : 2 * j + 2]
            wide = float(ends[2 * j][j] - ends[2 * j + 1][j])
            if not (np.isfinite(above).all() and np.isfinite(below).all()):
                (centre,) = evaluate([u])
                if np.isfinite(above).all():
                    below, wide = centre, float(ends[2 * j][j] - u[j])
                else:
                    above, wide = centre, float(u[j] - ends[2 * j + 1][j])
            if not (np.isfinite(above).all() and np.isfinite(below).all() and wide > 0):
                raise DataError("The whisker becomes unstable on both sides of this point; no derivative exists.")
            columns.append((above - below) / wide)
        return np.stack(columns, axis=1)
