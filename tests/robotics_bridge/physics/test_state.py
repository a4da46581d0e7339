"""A state refuses what does not fit."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics import HandState


def test_states_refuse_what_does_not_fit() -> None:
    state = HandState.empty(2, 3, contacts=1)
    with pytest.raises(UsageError, match="1 contacts; received 2"):
        state.set_contacts([0, 1], [[0, 1], [0, 1]])
    with pytest.raises(UsageError, match=r"shape \(2, 3, 7\)"):
        state.set_pose(np.zeros((3, 3, 7)))
    with pytest.raises(UsageError, match="'colour'"):
        state.set_contacts([0], [[0, 1]], colour=[1])


@pytest.mark.parametrize(
    ("env", "geometries", "options", "told"),
    [
        ([0.5], [[0, 1]], {}, "whole numbers"), ([0], [[0, 1.5]], {}, "whole numbers"),
        ([0], [[0, np.nan]], {}, "whole numbers"), ([0], [0, 1, 2], {}, r"received 1 and 1\.5"),
        ([0], [[0, 1]], {"normal": [1, 0]}, r"normal of contacts .*received \(2,\)"),
    ],
)  # fmt: skip
def test_contacts_are_of_whole_numbers_and_have_their_shapes(env, geometries, options, told) -> None:
    state = HandState.empty(2, 3, contacts=2)
    state.set_contacts([], [])
    state.set_contacts([1.0], [[0, 1]], force=[2.0])
    with pytest.raises(UsageError, match=told):
        state.set_contacts(env, geometries, **options)
