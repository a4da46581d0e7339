"""The look of every chart: matplotlib without a display, one set of colours and sizes, files written whole or not."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import check_name, needing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, PALE = "#22262b", "#6c757d"
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colours of series, told apart by readers with colour blindness too (Okabe & Ito 2008)."""
DOTS_PER_INCH = 100


def new_figure(width: int, height: int) -> Figure:
    """Return an empty white figure of this size in pixels, bound to no display and no global state.

    Without matplotlib it is a :class:`MissingDependencyError`.
    """
    with needing("matplotlib", extra="report", purpose="Drawing pictures"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
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


def panels(rows: int, columns: int, inches: tuple[float, float], **options: Any) -> tuple[Any, Any]:
    """Return a figure of this size in inches and its axes [rows, columns], in the common style.

    Further options are matplotlib's ``subplots``. Without matplotlib it is a :class:`MissingDependencyError`.
    """
    figure = new_figure(*(round(DOTS_PER_INCH * side) for side in inches))
    figure.set_layout_engine("constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for panel in axes.flat:
        style_axes(panel)
    return figure, axes


def style_axes(axes: Any) -> None:
    """Give axes the common sizes, colours and spines, for charts as wide as a page."""
    axes.set_prop_cycle(color=COLORS)
    axes.title.set(fontsize=10, color=INK)
    axes.tick_params(labelsize=8.5, color=PALE, labelcolor=INK)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(fontsize=9.5, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set(color=PALE)


def check_format(path: Path, allowed: Iterable[str]) -> str:
    """Return the lower-case suffix of ``path``; one that is not ``allowed`` is a :class:`UsageError`."""
    suffix = path.suffix.lower()
    check_name("format of a picture", suffix or path.name, allowed, hint="The ending of its name chooses it.")
    return suffix
