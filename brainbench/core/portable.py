"""Numbers without their last digits, which differ between processors, for hashes that are equal on every machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from brainbench.core.files import to_plain

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

BITS = 34
"""Bits of a number that count, about ten digits."""
SMALLEST = 1e-12
"""Numbers below it (SI) are zero: what a rotation by 90° leaves of it is 6e-17 here and 0 there."""


def without_last_digits(values: ArrayLike) -> NDArray[Any]:
    """Return numbers rounded to :data:`BITS` bits, 0 below :data:`SMALLEST`.

    >>> float(without_last_digits(0.1 + 0.2)) == float(without_last_digits(0.3))
    True
    """
    import numpy as np

    numbers = np.asarray(values, dtype=np.float64)
    # Only exact operations: a power or a logarithm would itself differ in its last digit.
    mantissa, exponent = np.frexp(np.where(np.abs(numbers) < SMALLEST, 0.0, numbers))
    return np.ldexp(np.rint(np.ldexp(mantissa, BITS)), exponent - BITS) + 0.0


def portable(value: Any) -> Any:
    """Return plain values as :func:`brainbench.core.files.to_plain` does, floats without their last digits."""
    return _rounded(to_plain(value))


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        if value and all(type(item) is float for item in value):
            return without_last_digits(value).tolist()
        return [_rounded(item) for item in value]
    return float(without_last_digits(value)) if type(value) is float else value
