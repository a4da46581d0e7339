import json

import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.core.reading.texts import parse_json, parse_toml, read_numbers


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('{"a": [1, {"b": NaN}]}', r"a\[1\]\.b"),
        ('{"a": 1e400}', "'a'.* inf"),
        ('{"a": 99999999999999999999}', r"'a'.*2\^63"),
        (f'{{"a": {"9" * 5000}}}', "file"),
        ("[" * 70 + "]" * 70, "64 levels"),
        ("[" * 100_000, "deep"),
    ],
)
def test_json_is_bounded_in_digits_depth_and_range(text, told):
    with pytest.raises(DataError, match=told):
        parse_json(text, "file")


@pytest.mark.parametrize("text", ["a = nan", "a = inf", "a = 99999999999999999999", "x = " + "[" * 5000, "a = "])
def test_toml_is_bounded_too(text):
    with pytest.raises(DataError, match="file"):
        parse_toml(text, "file")


def test_plain_values_pass_unchanged():
    value = {"a": [1, 2.5, None, True, "NaN"], "b": {"c": -(2**62)}}
    assert parse_json(json.dumps(value), "file") == value


def test_a_table_of_numbers_names_the_row_that_is_none(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("1,2,\n\nnan,4\r\n")
    np.testing.assert_array_equal(read_numbers(path), [[1, 2], [np.nan, 4]])
    for text, told in (("1,2\n3,x\n", "row 2"), ("1,2\n3\n", "row 2"), ("\n", "no table")):
        path.write_text(text)
        with pytest.raises(DataError, match=told):
            read_numbers(path)
