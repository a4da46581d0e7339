"""Force and torque of taxels turned so that the fixed map of a hand shows them along the fingers as they are bent.

:class:`~robotics_bridge.policies.encoders.taxel_grid.TaxelGrid` shows forces in the palm's axes with all joints at
their reference, so that a touch gives one image however its finger is bent. Here forces are in the palm's axes as they
act now; sites keep their cells. With R a link's rotation at the reference, Q R its rotation now, and l the lever from
the middle of a site to the link's origin, the site shows F = Q R f and M = Q (R m + l × R f).

Letters: B batch, S sub-step, N taxel, L link.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from brainbench.core.rotations import conjugate, from_matrices, multiply, rotate
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid


class PostureTurn(nn.Module):
    """What is put before the fixed map of a hand whose taxels measure force and torque."""

    owner: torch.Tensor
    """[N] link of a taxel, in the layout's order."""
    reference: torch.Tensor
    """[N, 4] rotation of its link to the palm's axes at the reference."""
    lever: torch.Tensor
    """[N, 3] from the middle of its site to the origin of its link (m, palm axes at the reference)."""

    def __init__(self, grid: TaxelGrid) -> None:
        super().__init__()
        owner, reference, lever = [], [], []
        for number, (link, probes) in enumerate(grid.layout.items()):
            points = probes.position[probes.active]
            turn, origin = grid.axes.place[link]
            owner += [number] * len(points)
            reference += [from_matrices(turn)] * len(points)
            lever.append(origin - grid.axes.centers[grid.axes.sites(link, points)])
        self.register_buffer("owner", torch.tensor(owner), persistent=False)
        self.register_buffer("reference", torch.from_numpy(np.array(reference)).float(), persistent=False)
        self.register_buffer("lever", torch.from_numpy(np.concatenate(lever)).float(), persistent=False)

    def forward(self, taxels: torch.Tensor, link_pose: torch.Tensor) -> torch.Tensor:
        """Return readings [B, S, N, 6] for the map, of readings [B, S, N, 6] and poses [B, L, 7] of the links.

        Poses are those of the observation ``link_pose``, in the palm's frame (x y z, qw qx qy qz).
        """
        shape = (*taxels.shape[:-1], 4)
        reference = self.reference.expand(shape)
        now = link_pose[:, self.owner, 3:][:, None].expand(shape)
        bent, back = multiply(now, conjugate(reference)), conjugate(reference)
        lever = self.lever.expand(*shape[:-1], 3)
        force, moment = rotate(reference, taxels[..., :3]), rotate(reference, taxels[..., 3:])
        moment = rotate(bent, moment + torch.linalg.cross(lever, force))
        force = rotate(bent, force)
        moment = moment - torch.linalg.cross(lever, force)
        return torch.cat((rotate(back, force), rotate(back, moment)), -1)
