"""Checks of the parts of a task: ranges, axes, orientations and places."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from brainbench.core.errors import UsageError, check_each, shown
from brainbench.core.reading.ranges import check_number, check_numbers


def check_range(name: str, value: Any, **bounds: Any) -> None:
    """Raise UsageError unless a value is a range (low, high) of numbers in order that :func:`check_number` takes."""
    fits = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2
    if fits:
        for end in value:
            check_number(f"An end of {name}", end, **bounds)
    if not fits or value[0] > value[1]:
        raise UsageError(f"{name} is a range (low, high); received {shown(value)}.")


def unit_vector(name: str, value: Any, count: int) -> tuple[float, ...]:
    """Return an axis (3 numbers) or a quaternion (4) of unit length; one that has it stays as it is."""
    check_numbers(name, value, count)
    length = math.hypot(*value)
    if not length > 0:
        raise UsageError(f"{name} has no length; received {shown(value)}.")
    # Numbers that are written with a few digits count as they are written.
    return tuple(value) if abs(length - 1) < 1e-6 else tuple(one / length for one in value)


def check_parameters(of: str, function: Callable[..., Any], given: Iterable[str]) -> None:
    """Check that a function of a :class:`~robotics_bridge.tasks.step_context.StepContext` can be called by these names.

    It takes the context first. Messages call it ``of`` (``reward 'work' of task 'mine'``).
    """
    if not callable(function):
        raise UsageError(f"The {of} needs a function of a step; received {shown(function)}.")
    try:
        signature = inspect.signature(function)
    except ValueError:  # Written in C, which tells no parameters.
        return
    own = list(signature.parameters.values())[1:]
    if not any(one.kind is one.VAR_KEYWORD for one in own):
        check_each(f"parameter of {of}", given, [one.name for one in own if one.kind is not one.VAR_POSITIONAL])
    try:
        signature.bind(None, **dict.fromkeys(given))
    except TypeError as error:
        raise UsageError(f"The {of} cannot be called: {error}.") from None
