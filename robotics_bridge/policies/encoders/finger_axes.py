"""Axes of fingers from tip to wrist: which of 5 × 7 sites of the hand a point of its skin belongs to.

Lengths in metres, in the frame of the palm with every joint at its reference position. Letters: N point, L link.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import GRID_SHAPE
from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError
from robotics_bridge.hands import Hand
from robotics_bridge.hands.layouts import Layout

mujoco = mujoco_module()

FINGERS = ("thumb", "index", "middle", "ring", "pinky")
"""Rows of the grid, from the radial side on."""
_WORDS = {
    "thumb": ("thumb", "th"),
    "index": ("index", "ff", "fore"),
    "middle": ("middle", "mid", "mf"),
    "ring": ("ring", "rf"),
    "pinky": ("pinky", "little", "lf", "small"),
}
_SAME = 1e-4
"""Points nearer along a finger axis than this (m) are never parted."""


def finger_rows(fingers: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """Return finger → row of the grid; a finger that the hand lacks leaves its row empty.

    Names are read in English or as the usual two letters (``ff``, ``mf``, ``rf``, ``lf``, ``th``). If one of them says
    nothing, the fingers take the rows in their own order.

    >>> finger_rows({"index": (), "thumb": ()})
    {'index': 1, 'thumb': 0}
    """
    if len(fingers) > GRID_SHAPE[0]:
        raise UsageError(f"The grid has rows for {GRID_SHAPE[0]} fingers; this hand has {len(fingers)}.")
    rows: dict[str, int] = {}
    for finger in fingers:
        # Fingers of files are named by their tips: rh_ffdistal, thumbtip.
        parts = [part.removesuffix("distal").removesuffix("tip") for part in re.findall("[a-z]+", finger.lower())]
        found = [row for row, name in enumerate(FINGERS) if any(word in parts for word in _WORDS[name])]
        if len(found) != 1 or found[0] in rows.values():
            return {name: row for row, name in enumerate(fingers)}
        rows[finger] = found[0]
    return rows


@dataclass(frozen=True, eq=False)
class FingerAxes:
    """The fingers of a hand in its reference posture, and where their sites begin (:func:`finger_axes_of`)."""

    place: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    """Link → rotation [3, 3] to the palm's axes and origin [3] (m)."""
    chains: Mapping[int, tuple[str, ...]]
    """Row → links from palm to tip."""
    joints: Mapping[int, NDArray[np.float64]]
    """Row → corners [n, 3] of its axis: the wrist, the origins of its links, and a point beyond the tip."""
    palm: str
    edges: NDArray[np.float64]
    """[5, 6]: lengths along the axis, counted from the far end, at which one site ends and the next begins."""
    centers: NDArray[np.float64]
    """[5, 7, 3]: middle of every site; the palm's origin where a site is empty."""

    def to_palm(self, link: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points [N, 3] of a link's frame in that of the palm."""
        turn, origin = self.place[link]
        return points @ turn.T + origin

    def sites(self, link: str, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows [N] and columns [N] of points [N, 3] on a link (its frame)."""
        rows, lengths = self.locate(link, self.to_palm(link, points))
        # The number of edges that a length lies beyond.
        return rows, (self.edges[rows] <= lengths[:, None]).sum(axis=1)

    def locate(self, link: str, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the row [N] of points (palm frame) and their lengths [N] along it from its far end."""
        for row, chain in self.chains.items():
            if link in chain:
                start = 1 + chain.index(link)
                return np.full(len(points), row), _along(self.joints[row], start, points)[0]
        if link != self.palm:
            raise UsageError(f"The link {link!r} is neither the palm {self.palm!r} nor part of a finger.")
        # A taxel of the palm belongs to the finger axis nearest to it, whose first segment leads over the palm.
        order = sorted(self.chains)
        found = [_along(self.joints[row], 0, points) for row in order]
        nearest = np.argmin([distance for _, distance in found], axis=0)
        lengths = np.stack([length for length, _ in found])[nearest, np.arange(len(points))]
        return np.array(order)[nearest], lengths


def finger_axes_of(hand: Hand, reference: Layout) -> FingerAxes:
    """Return the finger axes of a hand; sites are the seven quantiles of a reference layout's taxels along it."""
    data = mujoco.MjData(hand.model)
    mujoco.mj_kinematics(hand.model, data)
    palm = hand.model.body(hand.palm).id
    turn, origin = data.xmat[palm].reshape(3, 3), data.xpos[palm]
    place = {}
    for link in (hand.palm, *(name for chain in hand.fingers.values() for name in chain)):
        body = hand.model.body(link).id
        place[link] = (turn.T @ data.xmat[body].reshape(3, 3), (data.xpos[body] - origin) @ turn)
    rows = finger_rows(hand.fingers)
    chains = {rows[finger]: tuple(chain) for finger, chain in hand.fingers.items()}
    joints = {row: _corners(chain, place, reference) for row, chain in chains.items()}
    edges = np.full((GRID_SHAPE[0], GRID_SHAPE[1] - 1), np.inf)
    axes = FingerAxes(place, chains, joints, hand.palm, edges, np.zeros((*GRID_SHAPE, 3)))
    _lay_sites(axes, reference)
    return axes


def _corners(chain: tuple[str, ...], place: Mapping[str, Any], reference: Layout) -> NDArray[np.float64]:
    """Return the corners of a finger axis: wrist, joints, and a point beyond the tip in line with the last phalanx."""
    corners = [np.zeros(3), *(place[link][1] for link in chain)]
    steps = [after - before for before, after in pairwise(corners[1:])]
    # Links whose origins coincide have no direction; the last two that differ show where the finger points.
    long = [step for step in steps if np.linalg.norm(step) > _SAME]
    direction = long[-1] if long else corners[-1] - corners[0]
    tip = reference.get(chain[-1])
    if not long and tip is not None:
        turn, origin = place[chain[-1]]
        direction = tip.position[tip.active].mean(axis=0) @ turn.T + origin - corners[-1]
    length = np.linalg.norm(direction)
    unit = direction / length if length > 0 else np.array([0.0, 0.0, 1.0])
    # Half a metre is beyond the tip of any hand, and sites are quantiles: the origin of the length is free.
    return np.array([*corners, corners[-1] + 0.5 * unit])


def _along(
    corners: NDArray[np.float64], segment: int, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far along one segment points [N, 3] lie from the axis's far end, and their distance from it."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    rest = lengths[segment + 1 :].sum()
    step = corners[segment + 1] - corners[segment]
    size = lengths[segment]
    # Nearest point of the segment: projection on it, held between its ends.
    share = np.clip((points - corners[segment]) @ step / size**2, 0, 1) if size > 0 else np.zeros(len(points))
    distance = np.linalg.norm(points - corners[segment] - share[:, None] * step, axis=1)
    return rest + (1 - share) * size, distance


def _lay_sites(axes: FingerAxes, reference: Layout) -> None:
    columns = GRID_SHAPE[1]
    parts = []
    for link, probes in reference.items():
        points = axes.to_palm(link, probes.position[probes.active])
        row, length = axes.locate(link, points)
        parts.append(np.column_stack([row, length, points]))
    table = np.concatenate(parts) if parts else np.zeros((0, 5))
    for row in axes.chains:
        mine = table[table[:, 0] == row]
        if not len(mine):
            continue
        steps = np.round(mine[:, 1] / _SAME)
        values, counts = np.unique(steps, return_counts=True)
        # Taxels at one length stay together, so a quantile is that of their middle rank.
        site = np.floor(columns * (np.cumsum(counts) - counts / 2) / counts.sum()).astype(int)
        for column in range(1, columns):
            before, after = values[site < column], values[site >= column]
            # The edge lies half way between the last taxel before it and the first behind, so that rounding parts no
            # taxels.
            low = before.max() if len(before) else values.min()
            high = after.min() if len(after) else np.inf
            axes.edges[row, column - 1] = _SAME * (low + high) / 2 if len(before) else 0.0
        for column in range(columns):
            members = np.isin(steps, values[site == column])
            if members.any():
                axes.centers[row, column] = mine[members, 2:].mean(axis=0)
