"""From the taxels of a hand to the input of an encoder: one fixed linear map [B, S, N, C] → [B, S·6, 5, 7].

Rows are fingers (thumb, index, middle, ring, pinky; the row of an absent finger stays zero), columns seven sites along
each finger's axis from its tip to the wrist. Sites are quantiles of the arc length of the taxels of the whole hand at
medium resolution, so a spot of skin lights one and the same cell at every placement and resolution; taxels of the palm
belong to the nearest axis. A site carries the sum of its taxels' forces and their moments about its centre,

    F_site = Σ f_i,    M_site = Σ m_i + (x_i − x_site) × f_i,

in the axes of the hand's base (the palm) with the joints at their reference position: a touch gives the same image
however the finger is bent, as a whisker's does, and the map is one matrix product. Channels are
:data:`brainbench.core.contracts.CHANNELS` within sub-steps, as encoders expect: the action of the world on the skin
(N, N·m).

Letters: B batch, S sub-step, N item (an active taxel, or a link of the ``agg_`` types), C channel of the observation.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from brainbench.core.contracts import CHANNELS, GRID_SHAPE
from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.hands import Hand, layouts
from robotics_bridge.hands.layouts import Layout
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.policies.encoders.finger_axes import FingerAxes, finger_axes_of
from robotics_bridge.sensors.probes.placement import Probes

SITES = GRID_SHAPE[0] * GRID_SHAPE[1]
"""Cells of the grid."""


class TaxelGrid(nn.Module):
    """The map of one hand, with taxels at a placement and resolution (:meth:`~robotics_bridge.hands.Hand.layout`).

    Of what they ``observe``, ``force_torque`` and ``proximity`` are wrenches already; the force of ``force`` and the
    displacement of ``elastomer`` act at their taxel; ``bool`` and ``depth`` push there against the normal; values per
    link act at the middle of its taxels.
    """

    matrix: torch.Tensor
    """[SITES·6, N·C]."""
    cells: int = SITES

    def __init__(
        self,
        hand: Hand | str | os.PathLike[str],
        *,
        placement: str = "hand",
        resolution: str = "med",
        observe: str = "force_torque",
    ) -> None:
        super().__init__()
        kind = observation_type(observe)
        if kind.sensor is None:
            raise UsageError(f"The observation type {observe!r} has no touch, so there is nothing to lay on a grid.")
        body: Hand = hand if isinstance(hand, hands.Hand) else hands.load(hand)
        self.layout: Layout = body.layout(resolution, placement)
        """Link → probes, in the order of the items."""
        self.observe = observe
        self.channels: int = kind.channels
        """C."""
        own = resolution not in layouts.RESOLUTIONS
        self.axes: FingerAxes = finger_axes_of(body, body.layout(resolution if own else "med", "hand"))
        parts = [_scatter(self.axes, link, probes, observe) for link, probes in self.layout.items()]
        if not parts:
            raise UsageError(f"The hand {body.name!r} has no taxels at the placement {placement!r}.")
        full = np.concatenate(parts, axis=2)
        self.items: int = full.shape[2]
        """N."""
        matrix = torch.from_numpy(full.reshape(SITES * len(CHANNELS), -1)).float()
        # Not a weight: it follows from the names above, so files of weights need not hold it.
        self.register_buffer("matrix", matrix, persistent=False)

    @property
    def occupied(self) -> torch.Tensor:
        """Cells [5, 7] that any item reaches."""
        return self.matrix.abs().sum(1).view(SITES, len(CHANNELS)).sum(1).view(GRID_SHAPE) > 0

    def forward(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the grid [B, S·6, 5, 7] of readings [B, S, N, C], links in the layout's order and fillers left out."""
        if taxels.ndim != 4 or taxels.shape[2:] != (self.items, self.channels):
            raise UsageError(
                f"The grid reads [batch, sub-step, {self.items} items, {self.channels} channels] of "
                f"{self.observe!r}; received {list(taxels.shape)}."
            )
        # One product for all sites, channels and sub-steps; the transpose puts channels before sites, as encoders read
        # them.
        sites = nn.functional.linear(taxels.flatten(2), self.matrix)
        grid = sites.unflatten(2, (SITES, len(CHANNELS))).transpose(2, 3)
        return grid.reshape(taxels.shape[0], -1, *GRID_SHAPE)

    def wrenches(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the grid as wrenches [B, S, 5, 7, 6]."""
        return self(taxels).unflatten(1, (-1, len(CHANNELS))).movedim(2, -1)


def _scatter(axes: FingerAxes, link: str, probes: Probes, observe: str) -> NDArray[np.float64]:
    """Return the part [SITES, 6, items, C] of a link's items."""
    points, normals = probes.position[probes.active], probes.normal[probes.active]
    if not len(points):
        return np.zeros((SITES, 6, 0, observation_type(observe).channels))
    if observation_type(observe).per_link:
        normal = normals.mean(axis=0, keepdims=True)
        length = np.linalg.norm(normal)
        points, normals = points.mean(axis=0, keepdims=True), normal / length if length > 1e-9 else normals[:1]
    turn, origin = axes.place[link]
    rows, columns = axes.sites(link, points)
    wrench = _WRENCHES[observe](points, normals)
    part = np.zeros((SITES, 6, len(points), wrench.shape[2]))
    for index, (row, column) in enumerate(zip(rows, columns, strict=True)):
        # F = R f and M = R m + (x₀ − x_site) × F: the wrench about the link's origin moved to the middle of its site.
        force = turn @ wrench[index, :3]
        lever = origin - axes.centers[row, column]
        moment = turn @ wrench[index, 3:] + _cross(lever) @ force
        part[row * GRID_SHAPE[1] + column, :, index] = np.concatenate([force, moment])
    return part


def _cross(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _of_force(points: NDArray[np.float64], force: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the maps [N, 6, C] to a wrench about the link's origin of forces [N, 3, C] that act at points [N, 3]."""
    return np.concatenate([force, np.stack([_cross(x) @ f for x, f in zip(points, force, strict=True)])], axis=1)


def _vector(points: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    return _of_force(points, np.tile(axes, (len(points), 1, 1)))


_WRENCHES: Mapping[str, Any] = {
    **dict.fromkeys(("force_torque", "proximity"), lambda points, normals: np.tile(np.eye(6), (len(points), 1, 1))),
    **dict.fromkeys(("force", "elastomer"), lambda points, normals: _vector(points, np.eye(3))),
    **dict.fromkeys(("bool", "depth", "agg_bool"), lambda points, normals: _of_force(points, -normals[:, :, None])),
    # Undoes equation 4.29: axes z, y, x, and outward; its scale is left to the calibration.
    "agg_force": lambda points, normals: _vector(points, -np.eye(3)[::-1]),
}
"""Observation type → the maps [N, 6, C] from its values to wrenches about the link's origin, in its axes."""
