"""Ranges of options and numbers, checked before anything slow."""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterable
from typing import Any

from brainbench.core.errors import UsageError, brief


def check_number(
    name: str,
    value: Any,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    above: float = -math.inf,
    below: float = math.inf,
    whole: bool = False,
) -> None:
    """Raise a :class:`UsageError` unless ``value`` is a finite number within all bounds, and whole if asked for."""
    kind = issubclass(type(value), numbers.Integral if whole else numbers.Real) and not isinstance(value, bool)
    if kind and -math.inf < value < math.inf and least <= value <= most and above < value < below:
        return
    bounds = {"at least": least, "at most": most, "above": above, "below": below}
    words = " and ".join(f"{word} {bound:,}" for word, bound in bounds.items() if math.isfinite(bound))
    raise UsageError(
        f"{name} must be a {'whole' if whole else 'finite'} number{words and ', '}{words}; received {brief(value)}."
    )


def check_numbers(name: str, value: Any, count: int, **bounds: Any) -> None:
    """Raise a :class:`UsageError` unless ``value`` holds so many numbers that :func:`check_number` takes."""
    values = list(value) if isinstance(value, Iterable) else []
    if len(values) != count:
        raise UsageError(f"{name} holds {count} numbers; received {brief(value)}.")
    for number in values:
        check_number(name, number, **bounds)
