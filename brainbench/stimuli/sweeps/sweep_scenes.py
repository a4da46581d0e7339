"""Passive sweeps: objects brush past a still array, or the array past them, over the conditions of a grid.

The two grids of the thesis (chapter 3, table 3.1) are :data:`GRIDS`. Nothing is built or simulated until a scene is
asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, overload

import numpy as np

from brainbench.core.errors import UsageError, listing, repeats
from brainbench.core.rotations import euler_matrix
from brainbench.stimuli.objects.solid import Solid
from brainbench.stimuli.scenes.frames import Frames
from brainbench.stimuli.scenes.scene import Head, Scene
from brainbench.stimuli.sweeps.grid import Span, SweepGrid
from brainbench.stimuli.whiskers.array import WhiskerArray


class SweepScenes(Sequence[Scene]):
    """Every sweep of every object, built one at a time on request."""

    def __init__(
        self,
        grid: SweepGrid,
        objects: Iterable[Solid] | Mapping[str, Solid | Callable[[], Solid]],
        *,
        whiskers: str = "all",
    ) -> None:
        """Take ``objects`` as solids, or as a mapping from names to solids or to functions that load them."""
        pairs: list[Any] = list(objects.items()) if isinstance(objects, Mapping) else [(o.name, o) for o in objects]
        self._objects: dict[str, Solid | Callable[[], Solid]] = dict(pairs)
        if twice := repeats(name for name, _ in pairs):
            raise UsageError(f"Several objects are called {listing(twice)}; give a mapping from names to objects.")
        if not pairs:
            raise UsageError("Sweeps need at least one object to move past the whiskers.")
        self.grid = grid
        self.array = WhiskerArray.of(grid.species).select(whiskers)
        self.objects = tuple(self._objects)
        """Names of the objects."""
        self._last: tuple[str, Solid] | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the scenes in order; no object is loaded."""
        return tuple(f"{name}/{sweep.label}" for name in self.objects for sweep in self.grid.sweeps(name))

    def __len__(self) -> int:
        return len(self.objects) * self.grid.count

    @overload
    def __getitem__(self, index: int) -> Scene: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Scene, ...]: ...
    def __getitem__(self, index: int | slice) -> Scene | tuple[Scene, ...]:
        """Build one scene, or those of a slice."""
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(len(self))))
        which, within = divmod(range(len(self))[index], self.grid.count)
        name = self.objects[which]
        sweep = self.grid.sweeps(name)[within]
        return self.grid.scene(self.solid(name), sweep, label=f"{name}/{sweep.label}", array=self.array)

    def __repr__(self) -> str:
        return f"SweepScenes({len(self.objects)} objects × {self.grid.count} sweeps = {len(self)} scenes)"

    def solid(self, name: str) -> Solid:
        """Return one of the objects; neighbouring calls for the same object load it once."""
        # Neighbouring scenes share their object, and loading one may mean decomposing a mesh.
        last = self._last
        if last is None or last[0] != name:
            source = self._objects[name]
            # Threads may ask for different objects.
            self._last = last = (name, source if isinstance(source, Solid) else source())
        return last[1]


def counts(scenes: SweepScenes) -> dict[str, Any]:
    """Return how much a recipe enumerates: objects, sweeps per object, scenes, whiskers, draws, and what was published.

    ``bytes`` is the size of all forces as float32 [scene, frame, whisker, channel].
    """
    grid, whiskers = scenes.grid, len(scenes.array)
    return {
        "objects": len(scenes.objects), "sweeps_per_object": grid.count, "scenes": len(scenes), "whiskers": whiskers,
        "draws": grid.draws, "bytes": len(scenes) * grid.frames.count * whiskers * 6 * 4, "published": grid.published,
    }  # fmt: skip


def _thesis_head() -> Head:
    """Return the head of the released sweep scripts, (−6.934, −11.642, −2.598) mm and (0, 15.366, −16.198)°.

    The origin of the array lies at (0, 13, 1.5) mm in the head.
    """
    rotation = (0.0, math.radians(15.366), math.radians(-16.198))
    origin = np.array([-6.934, -11.642, -2.598]) + euler_matrix(rotation) @ np.array([0.0, 13.0, 1.5])
    x, y, z = (origin * 1e-3).tolist()
    return Head((x, y, z), rotation)


def _degrees(*values: float) -> tuple[float, ...]:
    return tuple(map(math.radians, values))


GRIDS: dict[str, SweepGrid] = {
    "thesis-low": SweepGrid(
        speed=(0.030,),
        height=(-0.005, 0.0),
        rotation=_degrees(0, 30, 90, 120),
        distance=(0.005, 0.008),
        size=(0.040,),
        start=0.016,
        head=_thesis_head(),
        frames=Frames(first=0.001, interval=0.009, count=110),
        published="text and lists of table 3.1: 16 sweeps per object (159,696 over 9981 objects); "
        "total printed in table 3.1: 316,192, which is no multiple of 9981",
    ),
    "thesis-high": SweepGrid(
        speed=Span(0.030, 0.060, 0.001),
        height=(-0.003, 0.0, 0.003),
        rotation=Span(0.0, math.radians(89), math.radians(1)),
        distance=(0.005,),
        size=Span(0.020, 0.060, 0.001),
        turns=_degrees(0, 90, 180, 270),
        draws=26,
        heights_per_draw=2,
        start=0.020,
        head=_thesis_head(),
        frames=Frames(first=0.0, interval=1 / 110, count=110),
        published="total of table 3.1: 2,076,048 = 208 per object; entries of table 3.1: 3 heights × 26 draws = 78; "
        "text: 288; released scripts: 26 draws × 3 heights × 4 quarter turns = 312",
    ),
}
"""The published grids, with the released head, start and frame times.

``thesis-high``: 26 draws per object of speed (30–60 mm/s), size (20–60 mm) and rotation (0–89°, in whole mm/s, mm
and degrees, as the released scripts draw them), each at the four quarter turns and at two of the three heights
−3, 0, 3 mm in rotation, at 5 mm: 26 × 4 × 2 = 208, the only whole number of sweeps that agrees with the
published total. Which heights the published set left out is not known. Of the draws the released scripts keep
the last two for testing. The published low-fidelity physics at 110 Hz is not imitated: only the frames are.
"""

DESCRIPTIONS = {
    "thesis-low": "Objects brushed past the right whiskers of a mouse (thesis, table 3.1, set 1: low variation)",
    "thesis-high": "Objects brushed past the right whiskers of a mouse (thesis, table 3.1, set 2: high variation)",
}


def describe_grid(name: str) -> str:
    """Return a grid's description with our count and, beside it, what was published."""
    grid = GRIDS[name]
    return f"{DESCRIPTIONS[name]}. Here: {grid.count} sweeps per object. Published: {grid.published}."
