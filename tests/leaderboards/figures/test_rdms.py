"""Pictures of RDMs exist where there is a matrix, and say what they show."""

from __future__ import annotations

import math

import pytest

from leaderboards.figures.rdms import rdm_picture


@pytest.mark.parametrize(
    ("pairs", "labels"), [((), ()), ((), ("a",)), ((0.1, 0.2), ("a", "b", "c")), ((math.nan,), "ab")]
)
def test_there_is_no_picture_without_a_matrix(pairs, labels):
    assert rdm_picture(pairs, labels) is None


def test_undefined_pairs_are_counted_and_a_constant_matrix_is_drawn():
    picture = rdm_picture((0.5, math.nan, 0.5), ("a", "b", "c"))
    assert picture is not None
    assert "from 0.5 to 0.5" in picture.description
    assert "Undefined pairs: 1." in picture.description
