"""Parsed JSON becomes typed values, or a sentence that names the place, the value and what is allowed."""

from __future__ import annotations

import doctest
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.reading import values
from brainbench.core.reading.values import read_table, typed_values


@dataclass(frozen=True)
class _Entry:
    kind: Literal["left", "right"]
    sizes: tuple[Annotated[int, msgspec.Meta(ge=1)], ...] = ()
    rates: dict[str, float] | None = None


def test_values_of_the_type_are_converted():
    assert typed_values(_Entry, {"kind": "left", "sizes": [1, 2]}, "the file") == _Entry("left", (1, 2))


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ([], "the file is []; expected an object."),
        ({}, "the file lacks 'kind'."),
        ({"kind": "up"}, "kind is 'up'; expected one of 'left', 'right'."),
        ({"kind": "left", "sizes": [1, "2"]}, "sizes[1] is '2'; expected an integer."),
        ({"kind": "left", "sizes": [0]}, "sizes[0] is 0; expected an integer >= 1."),
        ({"kind": "left", "rates": {"a": "b"}}, "an entry of rates is wrong: expected a number."),
    ],
)
def test_faults_name_place_value_and_what_is_allowed(data, sentence):
    with pytest.raises(DataError) as caught:
        typed_values(_Entry, data, "the file", choices={"kind": ("left", "right")})
    assert str(caught.value) == sentence


def test_advice_ends_the_message():
    with pytest.raises(DataError, match=r"expected an integer\. Give another file\.$"):
        typed_values(int, "x", "the number", advice=" Give another file.")


def test_the_examples_hold():
    assert doctest.testmod(values).failed == 0


class _Part(msgspec.Struct, frozen=True):
    size: Annotated[int, msgspec.Meta(ge=1)]
    names: tuple[str, ...] = ()


class _Whole(msgspec.Struct):
    first: _Part = _Part(1)
    parts: tuple[_Part, ...] = msgspec.field(default=(), name="part")


def test_tables_within_a_table_become_structures():
    table = read_table(_Whole, {"first": {"size": 2}, "part": [{"size": 3, "names": ["a"]}]}, "the file")
    assert table == _Whole(_Part(2), (_Part(3, ("a",)),))


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ([], "the file must be a table"),
        ({"frist": {}}, "key of the file 'frist'; did you mean 'first'"),
        ({"first": {}}, r"\[first\] of the file needs the key 'size'"),
        ({"first": {"size": 0}}, r"'size' of \[first\] of the file must be a whole number, at least 1"),
        ({"part": [{"size": 1, "names": "a"}]}, r"'names' of \[\[part\]\] of the file holds values; received 'a'"),
        ({"part": {"size": 1}}, "'part' of the file must be a table of tables"),
    ],
)
def test_the_place_of_what_is_wrong_in_a_table_is_named(data, sentence):
    with pytest.raises(UsageError, match=sentence):
        read_table(_Whole, data, "the file")
