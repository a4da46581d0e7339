import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.core.reading.tables import read_columns, read_numbers


def test_a_table_of_numbers_names_the_row_that_is_none(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("1,2,\n\nnan,4\r\n")
    np.testing.assert_array_equal(read_numbers(path), [[1, 2], [np.nan, 4]])
    for text, told in (("1,2\n3,x\n", "row 2"), ("1,2\n3\n", "row 2"), ("\n", "no table")):
        path.write_text(text)
        with pytest.raises(DataError, match=told):
            read_numbers(path)


def test_a_table_with_names_has_finite_numbers_alone(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time, p1\n0,1\n1,2\n")
    names, table = read_columns(path, "log")
    assert names == ["time", "p1"]
    np.testing.assert_array_equal(table, [[0, 1], [1, 2]])
    for text, told in (
        ("a,b\n1,nan\n", "'b' in row 2"),
        ("a,b\n1\n", "row 2"),
        ("a,b\n", "no table"),
        ("a,b,a\n1,2,3\n", "columns 'a'"),
        ("", "no table"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=told):
            read_columns(path, "log")
