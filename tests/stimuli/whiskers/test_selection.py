import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.stimuli.whiskers.array import WhiskerArray

MOUSE = WhiskerArray.mouse()
BOTH = WhiskerArray.mouse(side="both")


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("C2", ("C2",)),
        ("c2,D1", ("C2", "D1")),
        ("D1, C2", ("C2", "D1")),
        ("C0-C3", ("C0", "C1", "C2", "C3")),
        ("A1-E1", ("A1", "B1", "C1", "D1", "E1")),
        ("A*", ("A0", "A1", "A2", "A3", "A4")),
        ("*6", ("C6", "D6")),
        ("C2,C*", ("C0", "C1", "C2", "C3", "C4", "C5", "C6")),
    ],
)
def test_a_pattern_names_whiskers_in_the_order_of_the_array(pattern, names):
    assert MOUSE.select(pattern).names == names


def test_a_range_skips_gaps():
    assert WhiskerArray.rat().select("A4-E4").names == ("A4", "B4", "C4", "D4", "E4")
    assert MOUSE.select("A5-E5" if "A5" in MOUSE.names else "C5-E5").names == ("C5", "D5", "E5")


def test_with_both_sides_a_bare_name_means_both_and_a_prefix_one():
    assert BOTH.select("C2").names == ("RC2", "LC2")
    assert BOTH.select("RC2").names == ("C2",)
    assert BOTH.select("L*").side == "left"


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("C9", "Unknown whisker 'C9'; did you mean 'C"),
        ("C0-C9", "Unknown whisker 'C9'"),
        ("Z*", "Unknown whisker"),
        ("", "is empty; write 'all'"),
        (" , ", "is empty"),
        ("C3-C0", "must ascend within one row"),
        ("B1-C2", "must ascend within one row"),
    ],
)
def test_a_pattern_that_names_nothing_says_what_is_possible(pattern, message):
    with pytest.raises(UsageError, match=message):
        MOUSE.select(pattern)


@given(st.lists(st.sampled_from(MOUSE.names), min_size=1))
def test_any_list_of_names_selects_exactly_these(names):
    assert set(MOUSE.select(",".join(names)).names) == set(names)


@given(st.sampled_from(["C*", "C0-C3", "*2", "all", "C2,D1"]))
def test_selecting_twice_is_selecting_once(pattern):
    once = MOUSE.select(pattern)
    assert once.select(pattern if pattern != "C0-C3" else "all").names == once.names
