"""Common parts of pictures: matplotlib without a display, colours of the rows, round lengths for scale bars."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import UsageError, listing, missing_dependency, nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROW_COLORS = ("#3466ac", "#1b9aa0", "#d1495b", "#7b4fa3", "#e08e1b")
"""Colours of the whisker rows A to E."""
UNSTABLE_COLOR = "#111111"
"""Colour of whiskers whose simulation cannot be trusted."""
MOMENT_MAP = "plasma"
"""Colour map of bending moments, by its name in matplotlib."""
INK, PALE = "#22262b", "#6c757d"
DOTS_PER_INCH = 100


def new_figure(width: int, height: int) -> Figure:
    """Return an empty white figure of this size in pixels, bound to no display and no global state.

    Without matplotlib it is a :class:`MissingDependencyError`.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_dependency("matplotlib", extra="report", purpose="Drawing pictures") from error
    figure = Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH), dpi=DOTS_PER_INCH, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path, **options: Any) -> Path:
    """Write a figure in the format of the path's suffix, so that readers see the old file or the new one."""
    from matplotlib import rc_context

    from brainbench.core.files import atomic_path

    suffix = path.suffix.lower().lstrip(".")
    # Without a date and with a fixed salt, equal pictures are equal files.
    stamp = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(suffix)
    with atomic_path(path) as temporary, rc_context({"svg.hashsalt": "brainbench"}):
        figure.savefig(temporary, format=suffix, metadata=stamp, **options)
    return path


def check_format(path: Path, allowed: Iterable[str]) -> str:
    """Return the lower-case suffix of ``path``; one that is not ``allowed`` is a :class:`UsageError`."""
    choices = list(allowed)
    suffix = path.suffix.lower()
    if suffix not in choices:
        guess = nearest(suffix, choices)
        hint = f"; did you mean {guess!r}?" if guess else "."
        received = f"the name {path.name!r} ends in {suffix!r}" if suffix else f"the name {path.name!r} has no ending"
        raise UsageError(f"A picture's name ends in its format; {received}{hint} Allowed: {listing(choices)}.")
    return suffix


def round_up(value: float) -> float:
    """Return the least of a few round numbers that is not below ``value``, for the end of a scale.

    >>> round_up(0.308)
    0.4
    """
    power = 10.0 ** math.floor(math.log10(value))
    steps = (1, 1.2, 1.6, 2, 2.4, 3, 4, 5, 6, 8, 10)
    return float(f"{next(step for step in steps if step * power >= value * (1 - 1e-9)) * power:.3g}")


def round_length(length: float) -> float:
    """Return the longest of 1, 2, 5 times a power of ten that is not above ``length``.

    >>> round_length(0.0073)
    0.005
    """
    power = 10.0 ** math.floor(math.log10(length) + 1e-9)
    return max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9))
