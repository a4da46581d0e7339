"""Text around a rendered picture: label, time, scale bar, axes, and what the colours mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.figures.style import DOTS_PER_INCH, INK, PALE, new_figure, save_figure
from brainbench.stimuli.figures import canvas
from brainbench.stimuli.figures.picture import Picture
from brainbench.stimuli.whiskers.selection import ROWS

AXES = ("right", "rostral", "dorsal")


class Annotation:
    """A matplotlib figure that shows one instant of a picture after the other, with text."""

    def __init__(self, picture: Picture) -> None:
        self.picture = picture
        self.width, self.height = picture.style.size
        self.figure = new_figure(self.width, self.height)
        self.axes = self.figure.add_axes((0, 0, 1, 1))
        self.axes.set(xlim=(0, self.width), ylim=(self.height, 0))
        self.axes.axis("off")
        blank = np.full((self.height, self.width, 3), 255, dtype=np.uint8)
        self._image = self.axes.imshow(blank, extent=(0, self.width, self.height, 0), interpolation="nearest")
        self._unit = self.width / 1280
        self._edge = 36 * self._unit
        scene = picture.recording.scene
        self._text(self._edge, self._edge, scene.label, size=26, weight="bold", va="top")
        count, thick = len(scene.mounts), picture.style.thickness
        animals = f"{len(scene.split())} animals" if scene.others else scene.array.species
        caption = f"{animals}, {count} whisker{'s' if count > 1 else ''}"
        caption += "" if thick == 1 else f" drawn {thick:g}× as thick"
        self._text(self._edge, self._edge + 38 * self._unit, caption, size=15, color=PALE, va="top")
        self._time = self._text(self.width - self._edge, self._edge, "", size=22, ha="right", va="top")
        self._scale_bar()
        self._triad()
        if picture.style.color == "moment":
            self._moment_bar()
        else:
            self._row_key()

    def frame(self, index: int) -> NDArray[np.uint8]:
        """Return the annotated picture [H, W, 3] at one instant."""
        self._show(index)
        drawn: Any = self.figure.canvas
        drawn.draw()
        return np.asarray(drawn.buffer_rgba())[..., :3].copy()

    def save(self, path: Path, index: int = 0) -> Path:
        """Write the annotated picture at one instant."""
        self._show(index)
        return save_figure(self.figure, path, dpi=DOTS_PER_INCH)

    def _show(self, index: int) -> None:
        self._image.set_data(self.picture.frame(index))
        times = self.picture.recording.times
        text = f"{times[index] * 1e3:.1f} ms"
        if len(times) > 1:
            slower = 1 / (self.picture.style.frames_per_second * (times[1] - times[0]))
            text += f"   slowed {slower:.3g}×" if slower > 1 else ""
        self._time.set_text(text)

    def _text(self, x: float, y: float, text: str, *, size: float, color: str = INK, **options: Any) -> Any:
        from matplotlib.patheffects import withStroke

        points = size * self._unit * 72 / DOTS_PER_INCH
        halo = [withStroke(linewidth=0.25 * points, foreground="white", alpha=0.8)]
        return self.axes.text(x, y, text, fontsize=points, color=color, path_effects=halo, **options)

    def _line(self, xs: Any, ys: Any, color: str = INK, width: float = 3.0) -> None:
        points = width * self._unit * 72 / DOTS_PER_INCH
        self.axes.plot(xs, ys, color=color, linewidth=points, solid_capstyle="butt")

    def _scale_bar(self) -> None:
        lens = self.picture.lens
        length = canvas.round_length(0.2 * lens.width)
        left, low = self._edge, self.height - self._edge
        self._line([left, left + length * lens.scale], [low, low], width=5)
        label = f"{length * 1e3:g} mm" + ("" if lens.distance is None else " at the centre")
        self._text(left, low - 10 * self._unit, label, size=17, va="bottom")

    def _triad(self) -> None:
        """Draw arrows along the world's axes, as the camera sees them from afar."""
        reach = 58 * self._unit
        flat = (self.picture.lens.axes[:2] * [[1.0], [-1.0]]).T
        # The origin lies so far from the corner that every arrow and its name stay in the picture.
        right, low = self.width - self._edge - 100 * self._unit, self.height - self._edge - 66 * self._unit
        arrow = {"arrowstyle": "-|>", "color": PALE, "lw": 1.6 * self._unit, "shrinkA": 0, "shrinkB": 0}
        for (x, y), name in zip(flat, AXES, strict=True):
            if np.hypot(x, y) < 0.25:
                continue
            self.axes.annotate("", (right + reach * x, low + reach * y), (right, low), arrowprops=arrow)
            side = "center" if abs(x) < 0.3 else "left" if x > 0 else "right"
            height = "center" if abs(x) >= 0.3 else "bottom" if y < 0 else "top"
            place = right + 1.12 * reach * x, low + 1.12 * reach * y
            self._text(*place, name, size=14, color=PALE, ha=side, va=height)

    def _row_key(self) -> None:
        rows = sorted({mount.row for mount in self.picture.recording.scene.mounts})
        top = self._edge + 84 * self._unit
        key = [(f"row {ROWS[row]}", canvas.ROW_COLORS[row]) for row in rows]
        if self.picture.recording.unstable:
            key.append(("unstable, drawn unbent", canvas.UNSTABLE_COLOR))
        for place, (words, color) in enumerate(key):
            y = top + 26 * self._unit * place
            self._line([self._edge, self._edge + 30 * self._unit], [y, y], color, 4)
            self._text(self._edge + 40 * self._unit, y, words, size=15, va="center_baseline")

    def _moment_bar(self) -> None:
        left, top, long, wide = self._edge, self._edge + 84 * self._unit, 220 * self._unit, 16 * self._unit
        ramp = np.linspace(0, 1, 256)[None]
        self.axes.imshow(ramp, cmap=canvas.MOMENT_MAP, extent=(left, left + long, top + wide, top), aspect="auto")
        limit = self.picture.moment_limit * 1e6
        for share in (0.0, 0.5, 1.0):
            side = ("left", "center", "right")[round(2 * share)]
            self._text(left + share * long, top + 22 * self._unit, f"{share * limit:.3g}", size=14, ha=side, va="top")
        self._text(left, top + 46 * self._unit, "bending moment (µN·m)", size=14, color=PALE, va="top")
        self.axes.set(xlim=(0, self.width), ylim=(self.height, 0))
