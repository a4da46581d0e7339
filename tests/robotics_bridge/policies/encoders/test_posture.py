"""The map along the fingers as they are bent."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from robotics_bridge.policies.encoders.posture import PostureTurn
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid


def _poses(grid: TaxelGrid, turns: list[Rotation]) -> torch.Tensor:
    """Poses [1, L, 7] of links that were turned from their reference, about the palm's axes."""
    rows = []
    for link, turn in zip(grid.layout, turns, strict=True):
        rotation, origin = grid.axes.place[link]
        rows.append([*origin, *(turn * Rotation.from_matrix(rotation)).as_quat(scalar_first=True)])
    return torch.tensor([rows], dtype=torch.float32)


@pytest.mark.parametrize("hand", ["xhand1", "sharpa"])
def test_a_site_of_one_link_turns_with_the_link(hand: str) -> None:
    grid = TaxelGrid(hand)
    turn = PostureTurn(grid)
    readings = torch.randn(1, 2, grid.items, 6, generator=torch.Generator().manual_seed(0))
    still = _poses(grid, [Rotation.identity()] * len(grid.layout))
    torch.testing.assert_close(turn(readings, still), readings, atol=1e-5, rtol=1e-5)
    bends = list(Rotation.random(len(grid.layout), rng=np.random.default_rng(0)))
    poses = _poses(grid, bends)
    first = 0
    for number, (bend, probes) in enumerate(zip(bends, grid.layout.values(), strict=True)):
        count = int(probes.active.sum())
        alone = torch.zeros_like(readings)
        alone[:, :, first : first + count] = readings[:, :, first : first + count]
        before, after = (grid(x).unflatten(1, (2, 2, 3)).movedim(3, -1).numpy() for x in (alone, turn(alone, poses)))
        np.testing.assert_allclose(after, before @ bend.as_matrix().T, atol=2e-4, err_msg=str(number))
        first += count
