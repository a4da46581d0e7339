import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets.trials.conditions import Conditions, joined_labels, natural_vocabulary


def test_conditions_are_a_table_and_columns():
    parsed = Conditions.parse("trials: stimulus , servo_position")
    assert (parsed.table, parsed.columns) == ("trials", ("stimulus", "servo_position"))
    assert Conditions.parse(str(parsed)) == parsed
    assert Conditions.parse("behavior/poke:side").table == "behavior/poke"


@pytest.mark.parametrize("source", ["stimulus", "trials:", ":stimulus", "trials:a,,b"])
def test_unreadable_conditions_show_the_form(source):
    with pytest.raises(UsageError, match=rf"'{source}' .*TABLE:COLUMN,COLUMN"):
        Conditions.parse(source)


def test_a_column_is_named_once():
    with pytest.raises(UsageError, match="'a' more than once"):
        Conditions.parse("trials:a,a")


def test_a_missing_value_leaves_no_label():
    assert joined_labels(np.array([["a", "1"], ["b", ""]])) == ["a-1", ""]


def test_vocabulary_sorts_column_by_column_and_numbers_as_numbers():
    rows = [("b", "10"), ("a", "9"), ("b", "9"), ("a", "10")]
    assert natural_vocabulary(rows) == ("a-9", "a-10", "b-9", "b-10")
    assert natural_vocabulary(reversed(rows)) == natural_vocabulary(rows)


def test_combinations_that_read_alike_are_refused():
    with pytest.raises(DataError, match="both read 'a-b-c'"):
        natural_vocabulary([("a-b", "c"), ("a", "b-c")])
