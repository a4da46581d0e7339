"""The published JSON Schema describes the dataclasses, and our check agrees with the jsonschema package."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from leaderboards.schema import SCHEMA_PATH, first_fault, record_schema

VALIDATOR = Draft202012Validator(record_schema())


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
    assert first_fault(data) is None


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("score", "value"), "high", "score.value is 'high'; expected a number or null"),
        (("score", "status"), "great", "score.status is 'great'; expected one of 'ok', 'unreliable', 'undefined'"),
        (("score", "layers", 1, "layer"), 4, "score.layers[1].layer is 4; expected text"),
        (("score", "layers"), {}, "score.layers is {}; expected a list"),
        (("score", "ceiling"), 3, "score.ceiling is 3; expected an object"),
        (("card", "seed"), 1.5, "card.seed is 1.5; expected an integer or null"),
        (("synthetic",), "no", "synthetic is 'no'; expected true or false"),
        (("baselines", "raw input"), None, "baselines.raw input is None; expected an object"),
        (("score", "colour"), "red", "score has the unknown field 'colour'"),
        (("schema",), True, "schema is True; expected 2"),
        (("score", "p"), float("inf"), "score.p is inf; expected a number or null"),
    ],
)
def test_fault_names_the_place_the_value_and_what_is_allowed(make_record, path, value, message):
    data = json.loads(make_record().to_json())
    _parent(data, path)[path[-1]] = value
    assert first_fault(data) == message


def test_missing_field_is_named(make_record):
    data = json.loads(make_record().to_json())
    del data["score"]["status"]
    assert first_fault(data) == "score lacks 'status'"


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_our_check_agrees_with_jsonschema_on_damaged_records(make_record, data):
    record = json.loads(make_record().to_json())
    path = data.draw(st.sampled_from(list(_paths(record))))
    leaf = st.none() | st.booleans() | st.integers() | st.floats(-9, 9) | st.text(max_size=3) | st.just("ok")
    value = data.draw(leaf | st.lists(leaf, max_size=2) | st.dictionaries(st.text(max_size=3), leaf, max_size=2))
    damaged = copy.deepcopy(record)
    parent = _parent(damaged, path)
    if data.draw(st.booleans()) and isinstance(parent, dict):
        del parent[path[-1]]
    else:
        parent[path[-1]] = value
    assert (first_fault(damaged) is None) == VALIDATOR.is_valid(damaged)


def _parent(data: Any, path: tuple[Any, ...]) -> Any:
    for key in path[:-1]:
        data = data[key]
    return data


def _paths(data: Any, path: tuple[Any, ...] = ()) -> Any:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from _paths(value, (*path, key))
