"""Taxels of a hand by their own graph instead of the 5 × 7 grid: the smoothest patterns on every link.

A graph joins the taxels of a link, each pair with the weight exp(−d²/2ℓ²) of its distance d, where ℓ is the distance to
the nearest taxel in the median of the link. Eigenvectors φ of its Laplacian D − W are patterns over the link: first the
mean of all taxels, then ever finer ones. Those of the smallest eigenvalues in the hand are kept. A pattern carries
Σ √n φ_i (f_i, m_i) of the n taxels of its link, so that the first one is the link's wrench. No link knows of another.

Letters: B batch, S sub-step, N taxel, K pattern.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.csgraph import laplacian
from scipy.spatial.distance import cdist
from torch import nn

from brainbench.core.errors import UsageError
from robotics_bridge.hands.layouts import Layout
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.policies.encoders.taxel_grid import SITES


class TaxelGraph(nn.Module):
    """The smoothest :data:`~robotics_bridge.policies.encoders.taxel_grid.SITES` patterns, or all if there are fewer."""

    patterns: torch.Tensor
    """[K, N]."""
    middle: torch.Tensor
    """[N, 3]: mean of the taxels of a taxel's link, about which moments are taken (m, axes of the link)."""

    def __init__(self, layout: Layout, observe: str = "force_torque") -> None:
        super().__init__()
        if observe != "force_torque":
            observation_type(observe)  # an unknown name has an error of its own
            raise UsageError(f"The graph of taxels reads 'force_torque'; received {observe!r}.")
        points = [probes.position[probes.active] for probes in layout.values()]
        sizes = [len(one) for one in points]
        found: list[tuple[float, NDArray[Any]]] = []
        for number, one in enumerate(points):
            for value, pattern in zip(*_patterns(one), strict=True):
                whole = [np.zeros(size) for size in sizes]
                whole[number] = np.sqrt(len(one)) * pattern
                found.append((value, np.concatenate(whole)))
        # Stable: patterns that are equally smooth keep the order of the links.
        kept = sorted(found, key=lambda item: item[0])[:SITES]
        middle = np.concatenate([np.tile(one.mean(0), (len(one), 1)) for one in points if len(one)])
        # Not weights: they follow from the layout, so files of weights need not hold them.
        self.cells: int = len(kept)
        """K."""
        self.register_buffer("patterns", torch.tensor(np.array([one for _, one in kept])).float(), persistent=False)
        self.register_buffer("middle", torch.from_numpy(middle).float(), persistent=False)

    def wrenches(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the patterns [B, S, K, 6] of readings [B, S, N, 6] (N, N·m)."""
        force, moment = taxels.split(3, -1)
        moment = moment - torch.linalg.cross(self.middle.expand_as(force), force)
        return self.patterns @ torch.cat((force, moment), -1)


def _patterns(points: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return eigenvalues [n], from 0 up, and patterns [n, n] of a link's taxels [n, 3]."""
    if len(points) < 2:
        return np.zeros(len(points)), np.eye(len(points))
    distance = cdist(points, points)
    spacing = np.median(np.sort(distance, axis=1)[:, 1])
    weight = np.exp(-0.5 * (distance / spacing) ** 2)
    np.fill_diagonal(weight, 0.0)
    values, vectors = np.linalg.eigh(laplacian(weight))
    return np.round(values, 9), vectors.T
