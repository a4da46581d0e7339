import math
import re
from dataclasses import dataclass

import pytest

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_fields, check_number


def test_numbers_within_their_bounds_pass():
    check_number("epochs", 1, least=1, whole=True)
    check_number("p", 1.0, least=0, most=1)
    check_number("masking", 0, least=0, below=1)


@pytest.mark.parametrize("value", [0, math.nan, math.inf, -1, True, "3", None, 2.5, [1], 10**30])
def test_whatever_else_is_refused_with_its_name(value):
    with pytest.raises(UsageError, match="epochs"):
        check_number("epochs", value, least=1, most=100, whole=True)


@dataclass
class Options:
    seed: int | None = 0
    epochs: int | None = None
    rate: float = 0.1
    corner: tuple[float, float] | None = None


def test_none_passes_where_the_type_of_a_field_allows_it():
    check_fields(Options(), "seed", "epochs", least=0, whole=True)
    with pytest.raises(UsageError, match=r"rate .*received None"):
        check_fields(Options(rate=None), "rate", above=0)  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [-1, True, float("nan"), float("inf"), "3", 1.5])
def test_the_culprit_is_named_with_its_bound(wrong: object):
    with pytest.raises(UsageError, match="epochs must be a whole number, at least 0; received"):
        check_fields(Options(epochs=wrong), "seed", "epochs", least=0, whole=True)  # type: ignore[arg-type]


@pytest.mark.parametrize("corner", [(1, 2), [0.0, 1e9], None])
def test_a_field_of_several_numbers_has_bounds_for_each(corner: object):
    check_fields(Options(corner=corner), "corner", items=2, least=0)  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [1.0, (1.0,), (1, 2, 3), "12", (1, -1), (1, True), (1, math.nan), (1, "2"), ()])
def test_a_field_of_several_numbers_takes_nothing_else(wrong: object):
    with pytest.raises(UsageError, match=r"corner (holds 2 numbers|must be a finite number)"):
        check_fields(Options(corner=wrong), "corner", items=2, least=0)  # type: ignore[arg-type]


@pytest.mark.parametrize("own", ["a}b", "{0}", "{name!x}"])
def test_braces_in_what_a_user_named_are_told_as_they_are(own: str):
    with pytest.raises(UsageError, match=re.escape(f"rate of {own!r} must be")):
        check_fields(Options(rate=-1.0), "rate", of=f"{{}} of {own!r}", least=0)
