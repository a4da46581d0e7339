"""Patterns of the taxels of every link, in place of the grid of fingers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.fft import idct

from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.policies.encoders.taxel_graph import TaxelGraph
from robotics_bridge.policies.encoders.taxel_grid import SITES
from robotics_bridge.sensors.probes.placement import Probes


def _line(count: int) -> Probes:
    points = np.zeros((count, 3))
    points[:, 0] = 2e-3 * np.arange(count)
    return Probes(points, np.tile([0.0, 0.0, 1.0], (count, 1)), 1e-3)


@pytest.mark.parametrize("hand", ["xhand1", "sharpa"])
def test_the_first_patterns_are_the_wrenches_of_the_links_about_the_middle_of_their_taxels(hand: str) -> None:
    layout = hands.load(hand).layout("med", "hand")
    graph = TaxelGraph(layout)
    felt = torch.randn(2, 3, graph.patterns.shape[1], 6, generator=torch.Generator().manual_seed(0))
    found = graph.wrenches(felt)
    assert found.shape == (2, 3, SITES, 6) == (2, 3, graph.cells, 6)
    first = 0
    for number, probes in enumerate(layout.values()):
        points = probes.position[probes.active]
        part = felt[:, :, first : first + len(points)].double()
        first += len(points)
        force, moment = part[..., :3].sum(2), part[..., 3:].sum(2)
        moment = moment - torch.linalg.cross(torch.from_numpy(points.mean(0)).expand_as(force), force)
        sign = torch.sign(found[0, 0, number, 0] * force[0, 0, 0])
        torch.testing.assert_close(
            sign * found[:, :, number].double(), torch.cat((force, moment), -1), atol=1e-4, rtol=0
        )


def test_patterns_of_a_link_are_smooth_and_of_equal_power() -> None:
    layout = hands.load("xhand1").layout("med", "hand")
    graph = TaxelGraph(layout)
    first = 0
    for probes in layout.values():
        count = int(probes.active.sum())
        part = graph.patterns[:, first : first + count]
        own = part[part.abs().amax(1) > 0]
        torch.testing.assert_close(own @ own.mT, count * torch.eye(len(own)), atol=1e-3, rtol=0)
        # No pattern reaches over two links.
        assert float(graph.patterns[part.abs().amax(1) > 0].square().sum()) == pytest.approx(count * len(own), rel=1e-5)
        first += count


def test_a_chain_of_taxels_has_cosines() -> None:
    # With neighbours alone they are those of the discrete cosine transform; farther taxels weigh little.
    count = 9
    found = TaxelGraph({"link": _line(count)}).patterns.double().numpy() / np.sqrt(count)
    for number in range(4):
        pure = idct(np.eye(count)[number], norm="ortho")
        assert abs(found[number] @ pure) > 0.99


def test_few_taxels_have_few_patterns_and_another_sense_has_none() -> None:
    assert TaxelGraph({"link": _line(1)}).patterns.tolist() == [[1.0]]
    assert TaxelGraph({"a": _line(2), "b": _line(3)}).cells == 5
    with pytest.raises(UsageError, match="reads 'force_torque'; received 'bool'"):
        TaxelGraph({"link": _line(2)}, "bool")
