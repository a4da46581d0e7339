"""Fineness of the cubic pieces that a motion is cut into, and of the steps through them.

Time is divided into cells of :data:`KNOT`. Each is cut into 1, 2, 4 … :data:`MOST_PIECES` equal Hermite pieces until
these follow the motion: its velocity to :data:`SPEED_ERROR` of the greatest and its position to :data:`PLACE_ERROR`.
Corners (jumps of velocity) are kept within one piece of the finest; jumps of position are refused.

A function can be seen only where it is evaluated. One that says nothing about itself is looked at every 8 µs, or once
per time step where that is shorter; what lies wholly between two looks is not seen. One with an attribute ``finest``,
its shortest period (s; twice the width of a pulse), is looked at 16 times in it. Letters: n time, c cell, k coordinate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from brainbench.core.rotations import to_matrices
from brainbench.stimuli.motion.jobs import MILLI, Follicle
from brainbench.stimuli.objects.obstacle import Obstacle, RigidMotion

KNOT = 1e-3  # length of a cell (s); one cubic piece follows whisking at 20 Hz to 1e-7 of its way
SPEED_ERROR = 1e-4  # largest error of the velocity, as a share of the greatest speed of the motion
PLACE_ERROR = 1e-4  # largest error of the position (mm)
MOST_PIECES = 512  # pieces of a cell at most: they follow about 20 kHz
LOOKS = 128  # looks per cell at a motion that says nothing about itself, and wherever one piece does not follow
PIECES_PER_PERIOD = 27
"""Pieces in one period of a sinusoid that are just followed: the velocity of a cubic is wrong by √3/216 (ω h)³."""
LEAST_STEPS = 10  # steps per period of a motion where the fidelity names none
_AT_ONCE = 400_000  # looks at a time: bounds the memory
_SLOW = 1e-6  # speed (mm/ms) whose errors never count
_INSIDE = 16  # parts of a piece in which a corner or a jump is looked for

Path = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Times [n] (s) → coordinates [n, k] (mm; angles times a length)."""
Pose = Callable[[NDArray[np.float64]], tuple[NDArray, NDArray]]
"""Times [n] (s) → places [n, 3] (m) and rotations [n, …] of a base or a body."""


@dataclass(frozen=True, eq=False)
class MotionPieces:
    """Pieces of the cells of one motion, from its start."""

    count: NDArray[np.int32]
    """[c] equal pieces into which each cell is cut."""
    needed: NDArray[np.int32]
    """[c] the same without regard to corners: a measure of how fast the motion changes."""
    moves: bool
    """False for a motion that stands still."""

    def times(self, start: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Return the times [n] (s) of all knots, and the first knot of each cell with that of the end [c + 1]."""
        first = np.concatenate([[0], np.cumsum(self.count)]).astype(np.int32)
        cell = np.repeat(np.arange(len(self.count)), self.count)
        within = (np.arange(first[-1]) - first[cell]) / self.count[cell]
        return start + KNOT * np.concatenate([cell + within, [float(len(self.count))]]), first

    def longest_steps(self, step: float, per_period: float | None) -> NDArray[np.float64]:
        """Return the longest step [c] (s) from each cell on, at most ``step``: so many in a period of the motion."""
        limit = np.minimum(step, KNOT / self.needed * (PIECES_PER_PERIOD / (per_period or LEAST_STEPS)))
        limit[self.needed == 1] = step
        # A step that begins before a fast cell must not reach across it.
        before = limit.copy()
        for back in range(1, math.ceil(step / KNOT - 1e-9) + 1):
            limit[:-back] = np.minimum(limit[:-back], before[back:])
        return limit


def side_of(count: NDArray[np.int32] | int) -> NDArray[np.float64]:
    """Return the distance (s) of the instants whose difference is a velocity, where a cell has so many pieces."""
    return np.minimum(1e-5, KNOT / (8 * np.asarray(count, dtype=float)))


def _poses(
    poses: tuple[ArrayLike, ArrayLike], times: NDArray[np.float64], width: int, what: str
) -> tuple[NDArray, NDArray]:
    """Return positions [n, 3] and rotations [n, width] that a motion gave; other shapes are a :class:`UsageError`."""
    place, turn = (np.asarray(values, dtype=float) for values in poses)
    if place.shape != (len(times), 3) or turn.shape != (len(times), width):
        kind = "quaternions" if width == 4 else "angles"
        raise UsageError(
            f"The motion of {what} must give positions [n, 3] and {kind} [n, {width}], one for each of the n = "
            f"{len(times)} times; received the shapes {place.shape} and {turn.shape}."
        )
    return place, turn


def carried_pose(motion: RigidMotion | None, anchor: NDArray[np.float64]) -> Pose:
    """Return the pose, with rotation matrices [n, 3, 3], of the point ``anchor`` [3] (m) of a body that moves."""
    assert motion is not None

    def _pose(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        place, quaternions = _poses(motion(times), times, 4, "an object")
        # Most bodies never turn.
        quaternions = quaternions[: 1 if (quaternions == quaternions[:1]).all() else None]
        zero = ~quaternions.any(axis=1)
        if zero.any():
            first = times[: len(quaternions)][zero].min()
            raise UsageError(
                f"The motion of an object gives a quaternion of zero length at {first:.6g} s; give unit "
                "quaternions (w, x, y, z), (1, 0, 0, 0) for no rotation."
            )
        turn = to_matrices(quaternions)
        return place + turn @ anchor, np.broadcast_to(turn, (len(times), 3, 3))

    return _pose


@dataclass(frozen=True)
class Cutting:
    """When motions are followed, and in which steps. Seconds."""

    start: float
    stop: float
    step: float
    longest_step: float
    """Longest step of all whiskers that may share a motion: the last step looks at the pose so far behind ``stop``."""

    def follicle(self, follicle: Follicle, size: float) -> MotionPieces:
        """Cut the motion of a base whose whisker has the arc length ``size`` (m); errors as :meth:`cut`."""

        def _path(times: NDArray[np.float64]) -> NDArray[np.float64]:
            position, euler = _poses(follicle.pose(times), times, 3, "the base of a whisker")
            return np.concatenate([position, euler * size], axis=1) * MILLI

        return self.cut(_path, getattr(follicle, "finest", None), "the base of a whisker")

    def obstacle(self, obstacle: Obstacle, anchor: NDArray[np.float64]) -> MotionPieces:
        """Cut the motion of an obstacle, by its point ``anchor`` [3] (m) and its turns; errors as :meth:`cut`."""
        pose = carried_pose(obstacle.motion, anchor)
        size = float(np.linalg.norm(obstacle.bounds - anchor, axis=1).max())

        def _path(times: NDArray[np.float64]) -> NDArray[np.float64]:
            place, turn = pose(times)
            # All share the memory of one where it does not turn.
            turns = turn.reshape(-1, 9) * size if turn.strides[0] else np.empty((len(times), 0))
            return np.concatenate([place, turns], axis=1) * MILLI

        return self.cut(_path, getattr(obstacle.motion, "finest", None), "an object")

    def cut(self, path: Path, finest: float | None, what: str) -> MotionPieces:
        """Cut a motion, which is not evaluated before 0 when it starts at 0 or later; ``what`` names it in messages.

        ``finest`` is the shortest period (s) of anything in it, None when unknown.
        """
        cells = sum(max(1, math.ceil(span / KNOT - 1e-9)) for span in (self.stop - self.start, self.longest_step))
        wanted = KNOT / min(self.step, KNOT / LOOKS) if finest is None else 16 * KNOT / finest
        looks = int(2 ** math.ceil(math.log2(min(max(wanted, 4), 4 * MOST_PIECES))))
        motion = _Sampled(path, self.start, what)
        errors, speed = np.empty((2, cells)), 0.0
        some = max(1, _AT_ONCE // looks)
        for first in range(0, cells, some):
            which = np.arange(first, min(first + some, cells))
            place, rate, fastest = motion.errors(which, 1, looks)
            errors[:, which] = place[:, 0], rate[:, 0]
            speed = max(speed, fastest)
        limit = SPEED_ERROR * speed + _SLOW
        count = np.ones(cells, dtype=np.int32)
        needed = count.copy()
        left = np.flatnonzero((errors[0] > PLACE_ERROR) | (errors[1] > limit))
        some = _AT_ONCE // (4 * MOST_PIECES)
        for first in range(0, len(left), some):
            which = left[first : first + some]
            count[which], needed[which] = _refine(motion, which, max(looks, LOOKS), limit)
        return MotionPieces(count, needed, moves=speed > 0)


@dataclass(frozen=True, eq=False)
class _Sampled:
    """A motion where it is evaluated."""

    path: Path
    start: float
    what: str

    def at(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return coordinates [..., k] at times [...] (s)."""
        values = np.asarray(self.path(times.ravel()), dtype=float)
        if not np.isfinite(values).all():
            bad = times.ravel()[~np.isfinite(values).all(axis=1)][0]
            raise UsageError(f"The motion of {self.what} is not finite at {bad:.6g} s; give finite poses at all times.")
        return values.reshape(*times.shape, -1)

    def errors(
        self, cells: NDArray[np.int_], pieces: int, looks: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Return the errors of position [c, piece] (mm) and velocity (mm/ms), and the greatest speed, of some cells."""
        looks = max(looks, 4 * pieces)
        begin = self.start + KNOT * cells[:, None]
        knots = begin + KNOT * np.arange(pieces + 1) / pieces
        side = side_of(pieces)
        early = (self.start >= 0) & (knots < side)
        before = np.where(early, knots, knots - side)
        # All in one call: calls of a motion cost more than its values.
        times = np.concatenate([before, knots + side, begin + KNOT * np.arange(looks + 1) / looks], axis=1)
        x = self.at(np.append(times, knots[early] + 2 * side))
        beyond, x = x[times.size :], x[: times.size].reshape(*times.shape, -1)
        behind, ahead, x = np.split(x, [pieces + 1, 2 * pieces + 2], axis=1)
        slope = (ahead - behind) / (knots + side - before)[..., None]
        # At the very start there is no instant before: the line through two differences.
        slope[early] = 2 * slope[early] - (beyond - behind[early]) / (2 * side)
        each = looks // pieces
        # Coordinates that stand still, as those of a body that does not turn, are followed whatever the pieces.
        moves = (x != x[:1, :1]).any(axis=(0, 1)) | (slope != 0).any(axis=(0, 1))
        slope = slope[..., moves]
        x = x[..., moves][:, np.arange(pieces)[:, None] * each + np.arange(each + 1)]
        u, width = (np.arange(each + 1) / each)[:, None], KNOT / pieces
        a, b = x[:, :, :1], x[:, :, -1:]
        # Cubic Hermite piece through both ends.
        fit = a + (b - a) * u * u * (3 - 2 * u)
        fit += width * u * (1 - u) * (slope[:, :-1, None] * (1 - u) - slope[:, 1:, None] * u)
        miss = x - fit
        rate = np.abs(np.diff(miss, axis=2)).max(axis=(2, 3), initial=0.0) / (width / each) * 1e-3
        speed = float(np.abs(np.diff(x, axis=2)).max(initial=0.0)) / (width / each) * 1e-3
        return np.abs(miss).max(axis=(2, 3), initial=0.0), rate, speed


def _refine(
    motion: _Sampled, cells: NDArray[np.int_], looks: int, limit: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the pieces of cells that one piece does not follow, and those needed without their corners."""
    count = np.full(len(cells), MOST_PIECES, dtype=np.int32)
    needed = np.zeros(len(cells), dtype=np.int32)
    left, tried = np.arange(len(cells)), []
    levels = [2**k for k in range(int(math.log2(MOST_PIECES)) + 1)]
    for pieces in levels:
        place, rate, _ = motion.errors(cells[left], pieces, looks)
        follows = (place <= PLACE_ERROR) & (rate <= limit)
        tried.append((left, follows))
        done = follows.all(axis=1)
        count[left[done]] = needed[left[done]] = pieces
        left = left[~done]
        if not len(left):
            return count, needed
    corner = ~tried[-1][1][np.isin(tried[-1][0], left)]
    _require_corners(motion, cells[left], corner, limit)
    # What else there is in a cell with corners is told by the pieces that hold none.
    for pieces, (rows, follows) in zip(levels, tried, strict=True):
        holds = corner.reshape(len(left), pieces, -1).any(axis=2)
        fits = (follows[np.isin(rows, left)] | holds).all(axis=1) & (needed[left] == 0)
        needed[left[fits]] = pieces
    return count, needed


def _require_corners(motion: _Sampled, cells: NDArray[np.int_], bad: NDArray[np.bool_], limit: float) -> None:
    """Refuse pieces ``bad`` [c, piece] of the finest that hold something else than one corner.

    ``limit`` is the error of the velocity that is allowed (mm/ms).
    """
    row, piece = np.nonzero(bad)
    begin = motion.start + KNOT * (cells[row] + piece / MOST_PIECES)
    width = KNOT / MOST_PIECES
    parts = np.arange(_INSIDE + 1) / _INSIDE
    x = motion.at(begin[:, None] + width * parts)
    way = np.linalg.norm(np.diff(x, axis=1), axis=2)
    # A jump stays as high however closely it is looked at; the way of anything else shrinks.
    at, span = begin, width
    for _ in range(3):
        at = at + span / _INSIDE * way.argmax(axis=1)
        span /= _INSIDE
        way = np.linalg.norm(np.diff(motion.at(at[:, None] + span * parts), axis=1), axis=2)
    jumps = way.max(axis=1) > PLACE_ERROR
    if jumps.any():
        first = int(np.argmax(jumps))
        raise UsageError(
            f"The position of {motion.what} jumps by {way[first].max():.3g} mm at {at[first]:.6g} s; a motion must be "
            "continuous: let it take some time, .1 ms at least."
        )
    bends = np.linalg.norm(np.diff(x, n=2, axis=1), axis=2)
    # A corner between two looks shows in two neighbouring differences.
    share = (bends[:, :-1] + bends[:, 1:]).max(axis=1) / np.maximum(bends.sum(axis=1), 1e-300)
    # Beside a corner that falls on a knot a piece is straight, but for the slope there.
    fast = (share < 0.8) & (bends.sum(axis=1) * _INSIDE / width * 1e-3 > limit)
    if fast.any():
        raise UsageError(
            f"The motion of {motion.what} changes too fast at {begin[np.argmax(fast)]:.6g} s: cubic pieces of "
            f"{1e6 * width:.3g} µs do not follow its velocity to {SPEED_ERROR:.0e} of the greatest; keep it below "
            "20 kHz."
        )
