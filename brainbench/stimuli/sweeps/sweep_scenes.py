"""Passive sweeps: objects brush past a still array, or the array past them, over the conditions of a grid.

The two grids of the thesis (chapter 3, table 3.1) are :data:`GRIDS`. Nothing is built or simulated until a scene is
asked for.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, overload

import numpy as np

from brainbench.core.errors import UsageError, listing, repeats
from brainbench.core.files import content_hash
from brainbench.core.limits import Count, Limit, Positive, Seed, check_value, limited
from brainbench.core.rotations import Angle, euler_matrix
from brainbench.stimuli.motion.trajectories import Still, Translation
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.objects.solid import PlacedObject, Solid
from brainbench.stimuli.scenes.scene import Frames, Head, Scene
from brainbench.stimuli.whiskers.array import WhiskerArray

_HEAD_ONSET = 0.01  # smooth start [s] of a travelling head, whose whiskers would feel a jump of velocity as a blow


@limited(of="{} of a span")
class Span:
    """Values low, low + step, …, high, of which every draw takes one, all equally likely."""

    low: float
    high: float
    step: Positive

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise UsageError(f"A span ascends from low to high; received {self!r}.")

    @property
    def count(self) -> int:
        """Number of values."""
        # A step that is no binary fraction must not lose the last value.
        return math.floor((self.high - self.low) / self.step + 1e-9) + 1

    def draw(self, generator: np.random.Generator) -> float:
        """Return one value."""
        return self.low + self.step * int(generator.integers(self.count))


_Several = Limit(shortest=1)
_Numbers = Annotated[tuple[float, ...], _Several]
_PositiveNumbers = Annotated[tuple[Positive, ...], _Several]
_Angles = Annotated[tuple[Angle, ...], _Several]


@dataclass(frozen=True)
class Sweep:
    """One pass of one object."""

    speed: float
    """Speed of the pass [m/s]."""
    height: float
    """Height z of the object's origin [m, world]."""
    rotation: float
    """Angle of the object about the world's z axis [rad]."""
    distance: float
    """Lowest x of the turned object [m, world]."""
    size: float
    """Bounding-box diagonal of the object before it is turned [m]."""
    draw: int = 0
    """Number of the draw of the sampled quantities that this sweep belongs to."""

    @property
    def label(self) -> str:
        """Conditions in mm, degrees and mm/s, in the manner of the released folders: ``n0_h-5_d5_t30_v30_s40``."""
        lengths = {"h": self.height, "d": self.distance, "v": self.speed, "s": self.size}
        values = {key: value * 1e3 for key, value in lengths.items()} | {"t": math.degrees(self.rotation)}
        return "_".join([f"n{self.draw}", *(f"{key}{round(values[key], 6) + 0.0:g}" for key in "hdtvs")])


@limited(of="{} of a sweep grid")
class SweepGrid:
    """A frozen set of sweep conditions; lists are combined, spans are sampled once per draw and object."""

    speed: _PositiveNumbers | Span = (0.030,)
    """[m/s]"""
    height: _Numbers | Span = (0.0,)
    """[m]"""
    rotation: _Angles | Span = (0.0,)
    """[rad]"""
    distance: _Numbers | Span = (0.005,)
    """[m]"""
    size: _PositiveNumbers | Span = (0.040,)
    """[m]"""
    turns: _Angles = (0.0,)
    """Angles [rad] added to each rotation."""
    draws: Count = 1
    """Number of times that the spans are sampled."""
    heights_per_draw: Count | None = None
    """Number of the listed heights that each draw uses, in rotation, so that all are used alike; None for all."""
    seed: Seed = 0
    """Seed of the draws; each object has draws of its own, named by seed and object name."""
    start: Annotated[float, Limit(unit="m")] = 0.016
    """Start of the object along y [m]; see ``placing``."""
    placing: Literal["clear", "released"] = "clear"
    """``clear``: the face that leads has y = ``start`` at t = 0, in front of the whiskers. ``released``: the origin
    lies at start + (lowest y of the turned object), as the published simulator computes it; large objects then
    start *inside* the array, and what the whiskers feel is no brushing."""
    mover: Literal["object", "head"] = "object"
    """``object``: it travels towards −y past a still array. ``head``: the array travels towards +y past a still
    object; the relative motion is the same, with a smooth start of 10 ms."""
    species: str = "mouse"
    head: Head = field(default_factory=Head)
    """Pose of the array; its motion must be :class:`Still`."""
    frames: Frames = field(default_factory=Frames)
    published: str = ""
    """Published numbers of this grid, printed beside our counts."""

    def __post_init__(self) -> None:
        for name in ("speed", "height", "rotation", "distance", "size", "turns"):
            values = getattr(self, name)
            if not isinstance(values, Span):
                object.__setattr__(self, name, tuple(map(float, values)))
            elif name in ("speed", "size", "rotation"):
                limit = _Angles if name == "rotation" else _PositiveNumbers
                check_value(f"{name} of a sweep grid", (values.low, values.high), limit)
        if self.heights_per_draw is not None and (
            isinstance(self.height, Span) or not 1 <= self.heights_per_draw <= len(self.height)
        ):
            raise UsageError(
                f"heights_per_draw must lie between 1 and the number of listed heights; got {self.heights_per_draw!r}."
            )
        if not isinstance(self.head.motion, Still):
            raise UsageError("The head of a sweep grid stands still at first; choose mover='head' to let it travel.")

    @property
    def count(self) -> int:
        """Sweeps per object."""
        heights = self.heights_per_draw or _choices(self.height)
        others = (self.speed, self.rotation, self.distance, self.size)
        return self.draws * heights * len(self.turns) * math.prod(map(_choices, others))

    def sweeps(self, name: str = "") -> tuple[Sweep, ...]:
        """Return the sweeps of the object called ``name``, [count], equal on every machine.

        The name matters only where something is sampled.
        """
        generator = np.random.default_rng(int(content_hash(["sweeps", self.seed, name]), 16))
        sweeps = []
        for draw in range(self.draws):
            # The order of the draws belongs to the grid: another order would give other sweeps for the same seed.
            speed, rotation, distance, size = (
                _values(values, generator) for values in (self.speed, self.rotation, self.distance, self.size)
            )
            heights = self._heights(draw, generator)
            combined = itertools.product(heights, rotation, self.turns, distance, speed, size)
            sweeps += [Sweep(v, h, r + turn, d, s, draw) for h, r, turn, d, v, s in combined]
        return tuple(sweeps)

    def scene(
        self, solid: Solid, sweep: Sweep, *, label: str | None = None, array: WhiskerArray | None = None
    ) -> Scene:
        """Return one sweep as a scene, ready for :func:`brainbench.stimuli.simulate`.

        The solid is scaled about its origin to ``sweep.size``. The label is the object's name and the conditions when
        None, the array the right side of the grid's species.
        """
        scaled = solid.to_diagonal(sweep.size)
        angles = (0.0, 0.0, sweep.rotation)
        body = Obstacle(scaled.parts, surface=scaled.surface if scaled.mesh is None else scaled.mesh)
        low = body.moved(euler_matrix(angles), np.zeros(3)).bounds[0]
        # Objects travel towards −y, so their lowest y leads.
        y = self.start - low[1] if self.placing == "clear" else self.start + low[1]
        forward = Translation((0.0, sweep.speed, 0.0), _HEAD_ONSET)
        backward = Translation((0.0, -sweep.speed, 0.0), 0.0)
        moves = self.mover == "object"
        placed = PlacedObject(
            scaled, (sweep.distance - float(low[0]), float(y), sweep.height), angles, backward if moves else Still()
        )
        head = self.head if moves else Head(self.head.position, self.head.rotation, forward)
        chosen = WhiskerArray.of(self.species) if array is None else array
        name = f"{solid.name}/{sweep.label}" if label is None else label
        return Scene(name, chosen, (placed,), Still(), head, self.frames)

    def _heights(self, draw: int, generator: np.random.Generator) -> tuple[float, ...]:
        values = _values(self.height, generator)
        if self.heights_per_draw is None:
            return values
        # Each draw goes on where the last one stopped.
        first = draw * self.heights_per_draw
        return tuple(values[(first + i) % len(values)] for i in range(self.heights_per_draw))


def _choices(values: Sequence[float] | Span) -> int:
    return 1 if isinstance(values, Span) else len(values)


def _values(values: tuple[float, ...] | Span, generator: np.random.Generator) -> tuple[float, ...]:
    return (values.draw(generator),) if isinstance(values, Span) else values


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
