"""Records survive the disk, concurrent writers and careless hands."""

from __future__ import annotations

import copy
import doctest
import importlib
import inspect
import json
import math
import multiprocessing
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.core.files import read_json
from brainbench.core.records import RECORD_SCHEMA, ResultRecord, Score, record_identity
from leaderboards.store import SCHEMA_PATH, read_record, read_records, write_record
from tests.factories.records import VALIDATOR


def _fault(data: Any) -> str | None:
    try:
        ResultRecord.from_json(data)
    except DataError as error:
        return str(error)
    return None


def _record_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of one record file."""
    schema = msgspec.json.schema(ResultRecord)
    for definition in schema["$defs"].values():
        definition["description"] = inspect.cleandoc(definition["description"]).split("\n\n")[0].replace("\n", " ")
        definition["additionalProperties"] = False
        for described in definition["properties"].values():
            described.pop("default", None)  # NaN among them, which JSON does not have
    schema["$defs"]["ResultRecord"]["required"].append("schema")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:brainbench:result-record:{RECORD_SCHEMA}",
        "title": "brainbench result record",
        **schema,
    }


def test_published_schema_is_the_one_the_dataclasses_give_and_valid():
    assert read_json(SCHEMA_PATH) == _record_schema(), (
        "the dataclasses changed: rewrite the file with brainbench.core.files.write_json(SCHEMA_PATH, _record_schema())"
    )
    Draft202012Validator.check_schema(read_json(SCHEMA_PATH))


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
        (("score", "p"), float("inf"), "'score.p' in 'the record' is inf", "a finite number"),
        (("score", "value"), float("inf"), "'score.value' in 'the record' is inf", "a finite number"),
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


@pytest.mark.slow
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
    # What cannot be true at once is beyond a schema.
    valid = "contradicts itself" in str(fault := _fault(damaged)) or fault is None
    assert valid == VALIDATOR.is_valid(damaged)


def _parent(data: Any, path: tuple[Any, ...]) -> Any:
    for key in path[:-1]:
        data = data[key]
    return data


def _paths(data: Any, path: tuple[Any, ...] = ()) -> Any:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from _paths(value, (*path, key))


def test_a_record_comes_back_as_it_was_written(make_record, tmp_path):
    record = make_record("zhuang-intersection-ln")
    path = write_record(record, tmp_path / "new" / "folder")
    assert path.name == f"zhuang-intersection-ln--{record.identity}.json"
    assert read_record(path) == record
    assert [path.name] == [item.name for item in path.parent.iterdir()]


def test_values_that_do_not_exist_come_back_as_nan(make_record, tmp_path):
    record = make_record(status="undefined", p=math.nan, model_rdm=(math.nan,) * 15)
    back = read_record(write_record(record, tmp_path)).score
    assert math.isnan(back.value)
    assert math.isnan(back.p)
    assert all(map(math.isnan, back.model_rdm))
    assert "NaN" not in next(tmp_path.iterdir()).read_text()


def test_numbers_from_numpy_are_stored_exactly(make_record, tmp_path):
    value = np.float64(1) / 3
    record = make_record(value=value, provenance={"seed": np.int64(4), "file": Path("a")})
    back = read_record(write_record(record, tmp_path))
    assert back.score.value == float(value)
    assert back.score.provenance == {"seed": 4, "file": "a"}


def test_writing_twice_keeps_the_first_file(make_record, tmp_path):
    first, later = make_record(), make_record()
    later = replace(later, score=replace(later.score, provenance={**later.score.provenance, "time": "later"}))
    path = write_record(first, tmp_path)
    before = path.read_bytes()
    assert write_record(later, tmp_path) == path
    assert path.read_bytes() == before


def test_a_damaged_file_is_replaced_on_writing(make_record, tmp_path):
    record = make_record()
    path = tmp_path / record.file_name
    path.write_text("{ truncated")
    assert read_record(write_record(record, tmp_path)) == record


@settings(max_examples=60)
@given(name=st.text())
def test_any_name_gives_a_plain_file_name(name):
    file_name = ResultRecord(Score(name, 0.5, "ok")).file_name
    assert Path(file_name).name == file_name
    assert file_name.isascii()
    assert len(file_name) < 120
    assert not file_name.startswith((".", "-"))


def test_names_that_share_a_slug_do_not_share_a_file(make_record, tmp_path):
    assert write_record(make_record("A/B"), tmp_path) != write_record(make_record("a b"), tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("0.523", "0.923"), "was edited or renamed"),
        (lambda text: text.replace("mouse-a", "mouse-z"), "was edited or renamed"),
        (lambda text: text[:-40], "is not a readable JSON text"),
        (lambda text: text.replace("0.0127", "NaN"), "is nan"),
        (lambda text: text.replace("0.0127", "1e999"), "is inf"),
        (
            lambda text: text.replace('"schema": 2', '"schema": 7'),
            "schema version 7; this brainbench reads version 2; update",
        ),
        (lambda text: text.replace('"schema": 2', '"schema": "x"'), "schema version 'x'"),
        (lambda text: text.replace('"schema": 2', '"schema": 1'), "schema version 1;"),
        (lambda text: text.replace('"status": "ok"', '"status": "fine"'), "one of 'ok'"),
        (lambda text: "[" * 100_000, "is nested too deeply"),
        (lambda text: text.replace('"numpy": "2.3.1"', '"numpy":' + "[" * 9000 + "]" * 9000), "is nested too deeply"),
        (lambda text: "[1, 2]", "the record is [1, 2]"),
        (lambda text: text.replace('"value": 0.523', '"value": null'), "the status is 'ok' but the value is nan"),
        (lambda text: text.replace('"convex-far",', ""), "model_rdm has 15 pairs but 5 stimuli make 10"),
    ],
)
def test_an_edited_or_broken_file_is_refused_with_its_reason(make_record, tmp_path, change, message):
    path = write_record(make_record(), tmp_path)
    path.write_text(change(path.read_text()))
    with pytest.raises(DataError) as caught:
        read_record(path)
    assert message in str(caught.value)
    assert path.name in str(caught.value)


def test_a_renamed_file_is_refused(make_record, tmp_path):
    path = write_record(make_record(), tmp_path)
    with pytest.raises(DataError, match="its content has the hash"):
        read_record(path.rename(tmp_path / "mine.json"))


def test_a_binary_file_is_refused_in_words(tmp_path):
    path = tmp_path / "x.json"
    path.write_bytes(b"\x89HDF\xff\xfe")
    with pytest.raises(DataError, match="utf-8"):
        read_record(path)


def test_a_record_that_contradicts_itself_is_not_written(make_record, tmp_path):
    with pytest.raises(DataError, match="contradicts itself"):
        write_record(make_record(value=math.inf), tmp_path)
    with pytest.raises(DataError, match="model_rdm has 3 pairs but 6 stimuli make 15"):
        write_record(make_record(model_rdm=(1.0, 2.0, 3.0)), tmp_path)
    assert not list(tmp_path.iterdir())


def test_one_bad_file_does_not_end_the_reading(make_record, tmp_path):
    good = write_record(make_record(), tmp_path)
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / ".unfinished.json").write_text("another process writes here")
    (tmp_path / "notes.txt").write_text("not JSON, not looked at")
    stored = read_records(tmp_path)
    assert {item.path.name: item.problem is None for item in stored} == {good.name: True, "broken.json": False}
    assert all((item.record is None) == (item.problem is not None) for item in stored)


def test_folders_merge_by_copying_and_equal_results_count_once(make_record, tmp_path):
    write_record(make_record("a"), tmp_path / "one")
    shared = write_record(make_record("b"), tmp_path / "one")
    (tmp_path / "two" / "deep").mkdir(parents=True)
    shutil.copy(shared, tmp_path / "two" / "deep")
    write_record(make_record("c"), tmp_path / "two")
    names = [
        item.record.score.name for item in read_records([tmp_path / "one", tmp_path / "two", shared]) if item.record
    ]
    assert sorted(names) == ["a", "b", "c"]


def test_missing_and_empty_folders_are_told_apart(tmp_path):
    with pytest.raises(DataFileNotFoundError, match="no file or folder"):
        read_records(tmp_path / "nowhere")
    with pytest.raises(
        DataFileNotFoundError, match=r"No result records \(\*\.json\) in .*brainbench score MODEL --out"
    ):
        read_records(tmp_path)
    with pytest.raises(DataFileNotFoundError, match="There is no result record"):
        read_record(tmp_path / "x.json")


def _write_all(text: str, folder: str) -> None:
    for item in json.loads(text):
        write_record(ResultRecord.from_json(item), folder)


@pytest.mark.slow
def test_concurrent_writers_lose_nothing(make_record, tmp_path):
    records = [make_record(f"model-{index}") for index in range(30)]
    text = json.dumps([json.loads(record.to_json()) for record in records])
    context = multiprocessing.get_context("spawn")
    # Every process writes every record, so that each name is fought over.
    writers = [context.Process(target=_write_all, args=(text, str(tmp_path))) for _ in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(60)
    assert [writer.exitcode for writer in writers] == [0] * 4
    assert sorted(item.name for item in tmp_path.iterdir()) == sorted(record.file_name for record in records)
    assert all(item.problem is None for item in read_records(tmp_path))


@pytest.mark.parametrize("module", ["leaderboards.ranking", "brainbench.core.records"])
def test_the_examples_in_the_docstrings_hold(module):
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0


def test_a_record_that_lacks_a_later_optional_field_is_read_by_the_hash_of_what_it_says(make_record, tmp_path):
    record = make_record()
    data = json.loads(record.to_json())
    del data["card"]["citation"]
    path = tmp_path / f"zhuang--{record_identity(data)}.json"
    path.write_text(json.dumps(data))
    assert read_record(path) == record
