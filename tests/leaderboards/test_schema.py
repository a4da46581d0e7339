"""The published JSON Schema describes the dataclasses, and reading a record agrees with the jsonschema package."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from brainbench.core.errors import DataError
from brainbench.core.records import ResultRecord
from leaderboards.schema import SCHEMA_PATH, record_schema
from tests.factories.records import VALIDATOR


def _fault(data: Any) -> str | None:
    try:
        ResultRecord.from_json(data)
    except DataError as error:
        return str(error)
    return None


def test_published_schema_is_the_one_the_dataclasses_give():
    assert json.loads(SCHEMA_PATH.read_text(encoding="utf-8")) == record_schema(), (
        "the dataclasses changed: rewrite the file with brainbench.core.files.write_json(SCHEMA_PATH, record_schema())"
    )


def test_schema_is_itself_valid():
    Draft202012Validator.check_schema(record_schema())


@pytest.mark.parametrize("status", ["ok", "unreliable", "undefined"])
def test_a_written_record_fits_the_schema(make_record, status):
    data = json.loads(make_record(status=status).to_json())
    VALIDATOR.validate(data)
    assert _fault(data) is None


@pytest.mark.parametrize(
    ("path", "value", "place", "allowed"),
    [
        (("score", "value"), "high", "score.value is 'high'", "a number or null"),
        (("score", "status"), "great", "score.status is 'great'", "'ok', 'unreliable', 'undefined'"),
        (("score", "layers", 1, "layer"), 4, "score.layers[1].layer is 4", "text"),
        (("score", "layers"), {}, "score.layers is {}", "a list"),
        (("score", "ceiling"), 3, "score.ceiling is 3", "an object"),
        (("card", "seed"), 1.5, "card.seed is 1.5", "an integer or null"),
        (("card", "top1"), 1.5, "card.top1 is 1.5", "<= 1"),
        (("synthetic",), "no", "synthetic is 'no'", "true or false"),
        (("baselines", "raw input"), None, "entry of baselines", "an object"),
        (("score", "colour"), "red", "score has no field 'colour'", "'ceiling'"),
        (("schema",), True, "schema version True", "version 2"),
        (("score", "p"), float("inf"), "score.p is inf", "<= 1"),
        (("score", "value"), float("inf"), "score.value is inf", "a number or null"),
        (("score", "subjects", 0, "units"), -1, "score.subjects[0].units is -1", ">= 0"),
    ],
)
def test_fault_names_the_place_the_value_and_what_is_allowed(make_record, path, value, place, allowed):
    data = json.loads(make_record().to_json())
    _parent(data, path)[path[-1]] = value
    fault = _fault(data)
    assert fault is not None
    assert place in fault
    assert allowed in fault.partition(place)[2]


def test_missing_field_is_named(make_record):
    data = json.loads(make_record().to_json())
    del data["score"]["status"]
    assert "score lacks 'status'" in str(_fault(data))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_reading_agrees_with_jsonschema_on_damaged_records(make_record, data):
    record = json.loads(make_record().to_json())
    path = data.draw(st.sampled_from(list(_paths(record))))
    # JSON Schema takes 3.0 for an integer, which we do not.
    number = st.integers() | st.floats(-9, 9).filter(lambda value: not value.is_integer())
    leaf = st.none() | st.booleans() | number | st.text(max_size=3) | st.just("ok")
    value = data.draw(leaf | st.lists(leaf, max_size=2) | st.dictionaries(st.text(max_size=3), leaf, max_size=2))
    damaged = copy.deepcopy(record)
    parent = _parent(damaged, path)
    if data.draw(st.booleans()) and isinstance(parent, dict):
        del parent[path[-1]]
    else:
        parent[path[-1]] = value
    assert (_fault(damaged) is None) == VALIDATOR.is_valid(damaged)


def _parent(data: Any, path: tuple[Any, ...]) -> Any:
    for key in path[:-1]:
        data = data[key]
    return data


def _paths(data: Any, path: tuple[Any, ...] = ()) -> Any:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from _paths(value, (*path, key))
