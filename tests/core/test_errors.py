import doctest
import math

import pytest

from brainbench.core import errors
from brainbench.core.errors import (
    DataError,
    FileWriteError,
    UsageError,
    check_number,
    check_numbers,
    look_alike,
    visible,
    visible_lines,
    visible_name,
)


def test_examples_in_the_docstrings_hold():
    result = doctest.testmod(errors)
    assert result.attempted > 0
    assert result.failed == 0


def test_a_far_off_name_gets_no_wild_guess():
    assert errors.nearest("qqqq", ["zhuang", "resnet18"]) is None
    assert "did you mean" not in str(errors.unknown_name("model", "qqqq", ["zhuang"]))


def test_the_nearest_name_ignores_case_and_returns_the_allowed_spelling():
    assert errors.nearest("uggrnn", ["UGRNN", "LSTM"]) == "UGRNN"


def test_a_missing_package_names_the_extra_that_installs_it():
    error = errors.missing_dependency("pynwb", extra="nwb", purpose="Checking a file")
    assert "pip install -c constraints.txt '.[nwb]'" in str(error)
    assert isinstance(error, ImportError)


@pytest.mark.parametrize(
    ("kind", "status"),
    [
        (errors.UsageError, 2),
        (errors.DataFileNotFoundError, 2),
        (errors.DataError, 1),
        (errors.MissingDependencyError, 1),
    ],
)
def test_exit_status_tells_a_wrong_request_from_a_failed_job(kind: type[errors.BrainbenchError], status: int):
    assert kind.exit_code == status


@pytest.mark.parametrize(
    "mark",
    ["\x00", "\n", "\r", "\x1b", "\x7f", "\x85", "\x9b", "\u061c", "\u200b", "\u2028", "\u202e", "\u2066", "\ufeff",
     "\U000e0041", "\udcff"],
)  # fmt: skip
def test_no_control_character_of_others_is_shown(mark):
    text = visible(f"a{mark}b")
    assert mark not in text
    assert text.startswith("a\\")
    assert text.encode().endswith(b"b")
    assert (mark in visible_lines(f"a{mark}b")) == (mark == "\n")


@pytest.mark.parametrize("text", ["::error::x", "  ::set-output name=x::y", "##[error]x", " edge", "edge "])
def test_text_of_others_begins_no_command_and_has_no_blanks_at_its_edges(text):
    shown = visible(text)
    assert not shown.startswith(("::", "##[", " "))
    assert not shown.endswith(" ")


def test_plain_text_is_shown_as_it_is():
    for text in ("zhuang-intersection-ln+gpt.simclr", "Zürich, 0.5 – 0.7 µN → 東京", "a::b", ""):
        assert visible(text) == visible_lines(text) == text


def test_styles_stay_where_a_terminal_has_some():
    text = "\x1b[1mhead\x1b[0m\x1b]0;title\x07"
    assert visible_lines(text, styled=True) == "\x1b[1mhead\x1b[0m\\x1b]0;title\\x07"
    assert "\x1b" not in visible_lines(text)


@pytest.mark.parametrize(
    "rival",
    [
        "s4\u2010small", "s4\u2212small", "s4-small ", "s4-\u200bsmall", "\uff534-small", "S4_small", "s4-sm\u0430ll",
        "\u0405\u0034-small", "s4-sma\u04cfl", "s4-sm\u03b1ll", "s4-s\u034fmall", "s4-\u1160small",
        "s4-smalⅼ", "\u13da4-small",
    ],
)  # fmt: skip
def test_names_that_read_alike_are_equal_when_compared_and_differ_when_shown(rival):
    assert look_alike(rival) == look_alike("s4-small")
    assert visible_name(rival) != visible_name("s4-small") == "s4-small"
    assert visible_name(rival).isascii()


def test_names_in_another_script_are_shown_as_they_are_unless_they_mix_or_pretend():
    for name in ("東京-s4", "модель", "Zürich", "नेट", "réseau"):
        assert look_alike(name) != look_alike("s4-small")
    assert visible_name("東京-s4") == "東京-s4"
    assert visible_name("Zürich") == "Zürich"
    assert visible_name("ждфю") == "ждфю"
    assert visible_name("s4-ж") == "s4-\\u0436"
    assert visible_name("\u0440\u0435\u0442").isascii()  # all of its letters are twins of p, e and t
    assert look_alike("Zu\u0308rich") == look_alike("Zürich") == look_alike("Zurich")


def test_a_long_message_keeps_its_beginning_and_what_to_do():
    error = DataError(f"The file {'x' * 900} is damaged; copy it again.")
    assert len(str(error)) <= 400
    assert str(error).startswith("The file xxx")
    assert str(error).endswith("copy it again.")
    missing = FileWriteError("y" * 900)
    assert len(str(missing)) <= 400


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
