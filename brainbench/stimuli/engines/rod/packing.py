"""Whiskers, their motions and their jobs as the arrays of the kernel. mg, mm, ms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brainbench.core import rotations
from brainbench.stimuli.engines.protocol import Follicle, Load, base_rotation
from brainbench.stimuli.engines.rod.limits import LIGHT
from brainbench.stimuli.engines.units import MICRO, MILLI
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.whiskers.chain import Chain

KNOT = 1e-3
"""Spacing of the knots of a motion (s); cubic pieces between them follow whisking at 20 Hz to 1e-7 of its way."""
CAPACITIES = (12, 24, 48, 100)
"""Links for which kernels are compiled; a chain takes the smallest that holds it."""
Pose = Callable[[NDArray[np.float64]], tuple[NDArray, NDArray]]
"""Times [n] (s) → places [n, 3] (m) and rotations [n, …] of a base or a body."""
_SIDE = 1e-5
"""Distance (s) of the instants whose difference is a velocity."""


@dataclass
class PackedMotions:
    """Motions as cubic pieces: knots of all tracks one behind the other."""

    first: list[int] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    start: list[float] = field(default_factory=list)
    spacing: list[float] = field(default_factory=list)
    knots: list[NDArray[np.float64]] = field(default_factory=list)
    """Per track [count, 16]: place, velocity, quaternion, angular velocity, angular acceleration (mm, ms)."""

    def add(self, knots: NDArray[np.float64], start: float, spacing: float) -> int:
        """Append a track and return its index; ``start`` and ``spacing`` in ms."""
        self.first.append(self.first[-1] + self.count[-1] if self.first else 0)
        self.count.append(len(knots))
        self.start.append(start)
        self.spacing.append(spacing)
        self.knots.append(knots)
        return len(self.first) - 1

    def add_straight(self, knots: NDArray[np.float64]) -> NDArray[np.int32]:
        """Append bodies [body, 16] that stand or move straight from time 0; return their tracks [body]."""
        new = np.arange(len(self.first), len(self.first) + len(knots), dtype=np.int32)
        begin = self.first[-1] + self.count[-1] if self.first else 0
        self.first.extend(range(begin, begin + len(knots)))
        self.count.extend([1] * len(knots))
        self.start.extend([0.0] * len(knots))
        self.spacing.extend([1.0] * len(knots))
        self.knots.append(knots)
        return new

    def arrays(self) -> dict[str, NDArray]:
        """Return what the kernel's ``MotionArrays`` hold."""
        knots = np.concatenate(self.knots)
        return {
            "first": np.array(self.first, dtype=np.int32),
            "count": np.array(self.count, dtype=np.int32),
            "start": np.array(self.start),
            "spacing": np.array(self.spacing),
            "place": knots[:, :3],
            "velocity": knots[:, 3:6],
            "turn": knots[:, 6:10],
            "spin": knots[:, 10:13],
            "surge": knots[:, 13:16],
        }


def capacity_for(links: int) -> int:
    """Return the smallest compiled capacity that holds a chain."""
    return next(capacity for capacity in CAPACITIES if capacity >= links)


def still_knots(position: NDArray, quaternion: NDArray) -> NDArray[np.float64]:
    """Return the one knot [1, 16] of a body at rest; position in metres."""
    knot = np.zeros((1, 16))
    knot[0, :3] = np.asarray(position) * MILLI
    knot[0, 6:10] = quaternion
    return knot


def follicle_knots(follicle: Follicle, start: float, stop: float) -> tuple[NDArray[np.float64], float]:
    """Return the knots [n, 16] of a follicle between two times (s), and their spacing (ms)."""
    times, spacing = _knot_times(start, stop)
    position, euler = (np.asarray(values, dtype=float) for values in follicle.pose(times))
    if np.ptp(position, axis=0).max() == 0 and np.ptp(euler, axis=0).max() == 0:
        return still_knots(position[0], rotations.from_matrices(base_rotation(euler[:1]))[0]), spacing
    return _knots(follicle.pose, base_rotation, times, start), spacing


def body_knots(obstacle: Obstacle, start: float, stop: float) -> tuple[NDArray[np.float64], float]:
    """Return the knots [n, 16] of an obstacle between two times (s), and their spacing (ms)."""
    if obstacle.motion is None:
        return still_knots(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])), KNOT * MILLI
    times, spacing = _knot_times(start, stop)
    knots = _knots(obstacle.motion, rotations.to_matrices, times, start)
    straight = np.abs(np.diff(knots[:, 3:6], axis=0)).max(initial=0) < 1e-9 and not knots[:, 10:13].any()
    return (knots[:1], spacing) if straight else (knots, spacing)


def _knot_times(start: float, stop: float) -> tuple[NDArray[np.float64], float]:
    # One knot beyond the end: the last step looks at the pose behind it.
    count = max(2, int(np.ceil((stop - start) / KNOT - 1e-9)) + 2)
    return np.asarray(start + KNOT * np.arange(count), dtype=np.float64), KNOT * MILLI


def _knots(pose: Pose, to_matrices: Callable[[NDArray], NDArray], times: NDArray, start: float) -> NDArray[np.float64]:
    """Return knots [n, 16] of a pose from its places and rotations just before, at and just after the knot times."""
    around = []
    for side in (-_SIDE, 0.0, _SIDE):
        place, turn = pose(np.maximum(times + side, 0.0) if start >= 0 else times + side)
        around.append((np.asarray(place, dtype=float), to_matrices(np.asarray(turn, dtype=float))))
    (place0, turn0), (place, turn), (place1, turn1) = around
    # At the very start there may be no instant before: the difference is then one-sided.
    clipped = start >= 0
    back = np.where(clipped & (times < _SIDE), times, _SIDE)[:, None]
    span = back + _SIDE
    spin0, spin1 = _spin(turn0, turn) / np.maximum(back, 1e-12), _spin(turn, turn1) / _SIDE
    spin0 = np.where(back > 0, spin0, spin1)
    knots = np.empty((len(times), 16))
    knots[:, :3] = place * MILLI
    # Central differences over 20 µs, whose error is of second order; m per s are mm per ms.
    knots[:, 3:6] = (place1 - place0) / span
    knots[:, 6:10] = _continuous(rotations.from_matrices(turn))
    knots[:, 10:13] = _spin(turn0, turn1) / span / MILLI
    knots[:, 13:16] = (spin1 - spin0) / (span / 2) / MILLI**2
    return knots


def _spin(before: NDArray, after: NDArray) -> NDArray[np.float64]:
    """Return the rotation vectors [n, 3] (rad, world) between rotations [n, 3, 3]; small angles."""
    turn = after @ np.swapaxes(before, -1, -2)
    # Antisymmetric part of the relative rotation, sin(angle) times the axis; angles between neighbours are tiny.
    return np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=-1
    ) / 2  # fmt: skip


def _continuous(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Choose signs so that neighbours never jump to the antipode."""
    # q and −q are the same rotation, but a cubic from one to the other would turn all the way round or vanish.
    flips = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0))
    return quaternion * np.concatenate([[1.0], flips])[:, None]


def pack_chains(capacity: int, chains: Sequence[Chain], quasistatic: bool, hinges: int) -> dict[str, NDArray]:
    """Return what the kernel's ``ChainArrays`` hold: whiskers as chains, [link, whisker] of ``capacity`` links."""
    count = len(chains)
    mass = LIGHT if quasistatic else 1.0
    build, inertia, taper = (np.zeros((capacity, count, width)) for width in (4, 2 + hinges, 4))
    for w, chain in enumerate(chains):
        n = chain.links
        # kg to mg, kg·m² to mg·mm², N·m to µN·m.
        # A joint that twists does so between two halves of its rest bend.
        bends = chain.rest_angles / np.where((chain.torsion > 0) & (hinges == 3), 2, 1)
        build[:n, w] = np.stack(
            [chain.lengths * MILLI, np.cos(bends), np.sin(bends), chain.masses * (mass * MICRO)], axis=1
        )
        springs = (chain.stiffness * MICRO, chain.torsion * MICRO)[: hinges - 1]
        inertia[:n, w] = np.stack(
            [chain.centres * MILLI, *(chain.inertias.T * (mass * MICRO * MILLI**2)), *springs], axis=1
        )
        radii = chain.whisker.radius(chain.nodes) * MILLI
        taper[:n, w] = np.stack([radii[:-1], radii[1:], chain.nodes[:-1] * MILLI, np.diff(chain.nodes) * MILLI], axis=1)
    # Damping ratio ζ of the first mode ω₁ as stiffness-proportional damping, β = 2 ζ / ω₁.
    beta = [0 if quasistatic else 2 * c.whisker.damping_ratio / c.frequencies()[0] * MILLI for c in chains]
    return {
        "links": np.array([c.links for c in chains], dtype=np.int32),
        "beta": np.array(beta),
        "friction": np.array([c.whisker.friction for c in chains]),
        "length": np.array([c.whisker.arc_length * MILLI for c in chains]),
        "build": build,
        "inertia": inertia,
        "taper": taper,
    }


@dataclass
class PackedJobs:
    """Jobs of a launch: the whisker and the scene of each, and the place of its results. Letters: job."""

    whisker: NDArray[np.int32]
    """[job] index of the chain."""
    scene: NDArray[np.int32]
    """[job] index of the shapes."""
    base: NDArray[np.int32]
    """[job] motion of the base."""
    row: NDArray[np.int32]
    """[job] first index of the results."""
    column: NDArray[np.int32]
    """[job] second index of the results."""
    loads: Sequence[Sequence[Load]] = ()
    """[job] point forces; none for any when empty."""

    def __len__(self) -> int:
        return len(self.whisker)

    def arrays(self, chains: Sequence[Chain], step: NDArray[np.float64]) -> dict[str, NDArray]:
        """Return what the kernel's ``JobArrays`` hold, with the longest ``step`` [job] (ms) of each job."""
        counts = [len(loads) for loads in self.loads] or [0] * len(self)
        loads = [(load, chains[which]) for which, some in zip(self.whisker, self.loads, strict=False) for load in some]
        # A load at a joint belongs to the link before it.
        links = [min(max(int(np.searchsorted(c.nodes, load.arc)) - 1, 0), c.links - 1) for load, c in loads]
        shares = [
            (load.arc - c.nodes[link]) / (c.nodes[link + 1] - c.nodes[link])
            for (load, c), link in zip(loads, links, strict=True)
        ]
        return {
            **{name: getattr(self, name) for name in ("whisker", "scene", "base", "row", "column")},
            "step": step,
            "load_first": np.cumsum([0, *counts], dtype=np.int32),
            "load_link": np.array(links, dtype=np.int32),
            "load_share": np.array(shares),
            "load_force": np.array([np.multiply(load.force, MILLI) for load, _ in loads]).reshape(-1, 3),
            "load_stop": np.minimum([load.stop * MILLI for load, _ in loads], 1e30),
        }
