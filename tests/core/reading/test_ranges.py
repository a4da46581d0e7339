import math

import pytest

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number, check_numbers


def test_numbers_within_their_bounds_pass():
    check_number("epochs", 1, least=1, whole=True)
    check_number("p", 1.0, least=0, most=1)
    check_number("masking", 0, least=0, below=1)


@pytest.mark.parametrize("value", [0, math.nan, math.inf, -1, True, "3", None, 2.5, [1], 10**30])
def test_whatever_else_is_refused_with_its_name(value):
    with pytest.raises(UsageError, match="epochs"):
        check_number("epochs", value, least=1, most=100, whole=True)


@pytest.mark.parametrize("corner", [(1, 2), [0.0, 1e9]])
def test_several_numbers_have_bounds_for_each(corner: object):
    check_numbers("corner", corner, 2, least=0)


@pytest.mark.parametrize("wrong", [1.0, (1.0,), (1, 2, 3), "12", (1, -1), (1, True), (1, math.nan), (1, "2"), ()])
def test_several_numbers_are_nothing_else(wrong: object):
    with pytest.raises(UsageError, match=r"corner (holds 2 numbers|must be a finite number)"):
        check_numbers("corner", wrong, 2, least=0)
