"""Dense linear systems of one thread, for the contacts of one step."""

from typing import Any

import warp as wp

from ..algebra import reader
from ..delassus import row_size
from ..parameters import real

width = row_size + 2
"""Numbers in a row: the matrix, the right-hand side, and whether the column of this number has a pivot."""
DenseSystem: Any = wp.types.vector(row_size * width, real)
dense_entry = reader((DenseSystem, real))


@wp.func
def solve_dense(system: wp.ref[DenseSystem], size: int) -> int:
    """Solve in place by Gauss-Jordan with pivots; return 1 where the solution is not unique.

    The solution of a column without pivot is 0; :func:`dense_entry` of row c at ``size`` is that of column c.
    """
    largest = real(0.0)
    for r in range(size):
        for c in range(size):
            largest = wp.max(largest, wp.abs(dense_entry(system, r * wp.static(width) + c)))
    degenerate = int(0)
    used = int(0)
    for c in range(size):
        best = used
        pivot = real(0.0)
        for r in range(used, size):
            value = dense_entry(system, r * wp.static(width) + c)
            if wp.abs(value) > wp.abs(pivot):
                best = r
                pivot = value
        has_pivot = real(0.0)
        if wp.abs(pivot) <= real(1e-11) * largest:
            degenerate = 1
        else:
            has_pivot = real(1.0)
            for e in range(c, size + 1):
                kept = dense_entry(system, used * wp.static(width) + e)
                system[used * wp.static(width) + e] = dense_entry(system, best * wp.static(width) + e) / pivot
                if best != used:
                    system[best * wp.static(width) + e] = kept
            for r in range(size):
                factor = dense_entry(system, r * wp.static(width) + c)
                if r != used and factor != real(0.0):
                    for e in range(c, size + 1):
                        at = r * wp.static(width) + e
                        system[at] = (
                            dense_entry(system, at) - factor * dense_entry(system, used * wp.static(width) + e)
                        )  # fmt: skip
            used = used + 1
        system[c * wp.static(width) + size + 1] = has_pivot
    # Rows stand in the order of the pivots; from the last on, each goes to its column.
    for back in range(size):
        c = size - 1 - back
        value = real(0.0)
        if dense_entry(system, c * wp.static(width) + size + 1) == real(1.0):
            used = used - 1
            value = dense_entry(system, used * wp.static(width) + size)
        system[c * wp.static(width) + size] = value
    return degenerate
