"""Force and moment traces on the 5 × 7 layout of the whiskers, one small panel each, all to one scale."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, check_stimulus_set
from brainbench.core.errors import UsageError, check_name, choose_name
from brainbench.core.figures import INK, PALE, check_format, new_figure, save_figure
from brainbench.stimuli.figures.pictures import round_up
from brainbench.stimuli.whiskers.array import ROWS

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")
QUANTITIES = {
    **{channel: (channel,) for channel in CHANNELS},
    "Fxyz": CHANNELS[:3],
    "Mxyz": CHANNELS[3:],
    "F": CHANNELS[:3],
    "M": CHANNELS[3:],
}
"""Quantities that can be plotted: one channel, the three components together, or (``F``, ``M``) their magnitude."""
LINE_COLORS = ("#d1495b", "#35b07f", "#1f3a93")
"""Colours of x, y and z, of different lightness too."""
CONTACT_COLOR = "#f3d9a4"
_UNITS = {"F": ("mN", 1e3), "M": ("µN·m", 1e6)}


def plot(
    dataset: xr.Dataset,
    out: str | os.PathLike[str],
    *,
    channel: str = "Fxyz",
    stimulus: str | None = None,
    window: tuple[float, float] | None = None,
    size: tuple[int, int] = (1600, 960),
) -> tuple[Path, ...]:
    """Draw the traces of every whisker and return the files written.

    All panels of all pictures share one scale, so that stimuli can be compared; where a whisker touches,
    the panel is shaded. Whiskers that became unstable say so.

    Args:
        dataset: a stimulus set with whiskers of one side.
        out: file to write (``.png``, ``.svg``, ``.pdf``). A set of several stimuli makes one file each,
            with the stimulus's label after a hyphen.
        channel: one of :data:`QUANTITIES`.
        stimulus: draw only this one.
        window, size: first and last time to show [s]; width and height in pixels.
    """
    check_stimulus_set(dataset)
    path = Path(out)
    check_format(path, FORMATS)
    check_name("channel", channel, QUANTITIES)
    cells = list(zip(dataset["row"].values.tolist(), dataset["col"].values.tolist(), strict=True))
    if len(set(cells)) < len(cells):
        raise UsageError("The stimulus set has two whiskers in one cell; select one side (or one animal) first.")
    labels = [str(label) for label in dataset["stimulus"].values]
    chosen = labels if stimulus is None else [choose_name("stimulus", stimulus, labels)]
    dataset = _within(dataset, window)
    values = _values(dataset, channel)
    largest = float(np.nanmax(np.abs(values), initial=0.0)) or 1.0
    # Each side ends where its values end, but never so close to 0 that its number would overlap that of 0.
    low, high = (max(float(np.nanmax(side * values, initial=0.0)), 0.2 * largest) for side in (-1, 1))
    limits = (0.0 if channel in _UNITS else -round_up(low), round_up(high))
    several = len(chosen) > 1
    names = [re.sub(r"[^\w.+-]+", "_", label) for label in chosen]
    paths = [path.with_name(f"{path.stem}-{name}{path.suffix}") if several else path for name in names]
    for label, file in zip(chosen, paths, strict=True):
        save_figure(_figure(dataset.isel(stimulus=labels.index(label)), label, channel, limits, size), file)
    return tuple(paths)


def _within(dataset: xr.Dataset, window: tuple[float, float] | None) -> xr.Dataset:
    if window is None:
        return dataset
    times = dataset["time"].values
    inside = (times >= window[0]) & (times <= window[1])
    if inside.sum() < 2:
        raise UsageError(
            f"The window {window[0]:g}–{window[1]:g} s holds fewer than two frames; "
            f"the stimuli last from {times[0]:g} to {times[-1]:g} s."
        )
    return dataset.isel(time=np.flatnonzero(inside))


def _values(dataset: xr.Dataset, channel: str) -> NDArray[np.float64]:
    """Return what is drawn [..., whisker, line] in the unit of the scale."""
    picked = [CHANNELS.index(name) for name in QUANTITIES[channel]]
    values = dataset["wrench"].values[..., picked].astype(float) * _UNITS[channel[0]][1]
    return np.linalg.norm(values, axis=-1, keepdims=True) if channel in _UNITS else values


def _figure(
    stimulus: xr.Dataset, label: str, channel: str, limits: tuple[float, float], size: tuple[int, int]
) -> Figure:
    figure = new_figure(*size)
    rows, cols = GRID_SHAPE
    unit = size[0] / 1600
    points = 0.72 * unit
    room = {"left": 0.055, "right": 0.99, "top": 0.885, "bottom": 0.075, "wspace": 0.08, "hspace": 0.16}
    panels: Any = figure.subplots(rows, cols, sharex=True, sharey=True, gridspec_kw=room)
    cells = list(zip(stimulus["row"].values.tolist(), stimulus["col"].values.tolist(), strict=True))
    values = _values(stimulus, channel)
    for (row, col), panel in np.ndenumerate(panels):
        if (row, col) not in cells:
            panel.axis("off")
            continue
        index = cells.index((row, col))
        _panel(panel, stimulus.isel(whisker=index), values[:, index], f"{ROWS[row]}{col}", points)
        # Only panels at an edge of the layout carry numbers.
        panel.tick_params(labelleft=(row, col - 1) not in cells, labelbottom=(row + 1, col) not in cells)
    times = stimulus["time"].values * 1e3
    lower, upper = limits
    margin = 0.04 * (upper - lower)
    panels[0, 0].set(xlim=(times[0], times[-1]), ylim=(lower - margin, upper + margin))
    panels[0, 0].set_yticks([lower, 0, upper] if lower else [0, upper / 2, upper])
    panels[0, 0].locator_params(axis="x", nbins=4)
    # The attribute begins with the axes, "world axes; …" or "follicle axes; …".
    axes = str(stimulus.attrs.get("frame", "world")).split()[0]
    _legend(figure, label, channel, axes, points)
    return figure


def _panel(panel: Axes, whisker: xr.Dataset, values: NDArray[np.float64], name: str, points: float) -> None:
    times = whisker["time"].values * 1e3
    if "contact" in whisker:
        touching = whisker["contact"].values
        panel.fill_between(
            times, 0, 1, where=touching, step="mid", transform=panel.get_xaxis_transform(), color=CONTACT_COLOR, lw=0
        )
    panel.axhline(0, color=PALE, linewidth=0.8 * points)
    corner: dict[str, Any] = {"transform": panel.transAxes, "va": "top", "ha": "right"}
    stable = "status" not in whisker or str(whisker["status"].values) == "ok"
    colors = LINE_COLORS if values.shape[1] > 1 else (INK,)
    for line, color in zip(values.T, colors, strict=True):
        panel.plot(times, line, color=color, linewidth=1.9 * points)
    panel.text(
        0.03, 0.95, name, transform=panel.transAxes, fontsize=17 * points, fontweight="bold", color=INK, va="top"
    )
    if not stable:
        panel.text(0.97, 0.95, "unstable", fontsize=14 * points, color="#b00020", **corner)
    elif "contact" in whisker and not whisker["contact"].values.any():
        panel.text(0.97, 0.95, "no contact", fontsize=13 * points, color=PALE, **corner)
    panel.tick_params(labelsize=13 * points, length=4 * points, colors=INK)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        panel.spines[side].set(color=PALE, linewidth=0.8 * points)


def _legend(figure: Figure, label: str, channel: str, axes: str, points: float) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    kind = "force" if channel[0] == "F" else "moment"
    unit = _UNITS[channel[0]][0]
    what = f"|{channel}|" if channel in _UNITS else ", ".join(QUANTITIES[channel])
    about = f"{kind} of the whisker on its base, {what} ({unit}), {axes} axes"
    font: dict[str, Any] = {"fontsize": 16 * points}
    figure.text(0.02, 0.965, label, fontsize=26 * points, fontweight="bold", color=INK, va="center")
    figure.text(0.02, 0.92, about, color=PALE, va="center", **font)
    figure.text(0.52, 0.018, "time (ms)", color=INK, ha="center", va="center", **font)
    figure.text(0.014, 0.48, f"{kind} ({unit})", color=INK, rotation=90, va="center", ha="center", **font)
    colors = LINE_COLORS if channel.endswith("xyz") else (INK,)
    names: Sequence[str] = QUANTITIES[channel] if channel.endswith("xyz") else (what,)
    handles: list[Any] = [
        Line2D([], [], color=color, linewidth=3 * points, label=name) for name, color in zip(names, colors, strict=True)
    ]
    handles.append(Patch(color=CONTACT_COLOR, label="contact"))
    figure.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(0.99, 0.99), ncols=4, fontsize=16 * points, frameon=False
    )
