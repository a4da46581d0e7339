"""Limits of the rod solver that depend on one another."""

import pytest

from brainbench.stimuli.engines.rod import limits


def test_longer_chains_solve_more_contacts_together():
    assert [limits.contacts_for(links) for links in (2, 12, 13, 100)] == [8, 8, 14, 14]


def test_a_stated_tolerance_is_kept_with_as_many_iterations_as_it_takes():
    assert limits.contact_iterations(None) == limits.FEW_ITERATIONS
    tolerance, sweeps, inner = limits.contact_iterations(1e-9)
    assert tolerance == 1e-9
    assert min(sweeps, inner) > max(limits.FEW_ITERATIONS[1:])


def test_a_search_keeps_track_of_enough_boxes_for_sixteen_million_triangles():
    # The leaves below the last level hold as many triangles as a node has children.
    assert limits.WIDE ** (limits.LEVELS + 1) >= 16_000_000


@pytest.mark.parametrize("threads", [limits.DISTANCE_GROUP, *(threads for _, threads in limits.GROUPS)])
def test_threads_that_work_together_fill_a_warp_of_the_gpu(threads):
    assert limits.WARP % threads == 0
