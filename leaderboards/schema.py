"""The JSON Schema of a result record, derived from the dataclasses of :mod:`brainbench.core.records`.

The published file ``leaderboards/record.schema.json`` is :func:`record_schema` written out; a test
keeps the two in step. :func:`first_fault` checks a record against it without the ``jsonschema``
package, which is no core dependency; the tests compare the two validators.
"""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from brainbench.core.records import RECORD_SCHEMA, ResultRecord

SCHEMA_PATH = Path(__file__).with_name("record.schema.json")
"""The published schema, shipped with the package."""

_SIMPLE: dict[Any, dict[str, Any]] = {
    float: {"type": ["number", "null"]},  # null stands for NaN
    int: {"type": "integer"},
    str: {"type": "string"},
    bool: {"type": "boolean"},
    type(None): {"type": "null"},
    Any: {},
}

_NAMES = {"number": "a number", "integer": "an integer", "string": "text", "boolean": "true or false"} | {
    "object": "an object",
    "array": "a list",
    "null": "null",
}


@cache
def record_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of one record file. The result is shared: do not change it."""
    definitions: dict[str, Any] = {}
    _define(ResultRecord, definitions)
    definitions["ResultRecord"]["properties"]["schema"] = {"const": RECORD_SCHEMA}
    definitions["ResultRecord"]["required"].append("schema")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:brainbench:result-record:{RECORD_SCHEMA}",
        "title": "brainbench result record",
        "$ref": "#/$defs/ResultRecord",
        "$defs": definitions,
    }


def first_fault(data: Any) -> str | None:
    """Return where and how parsed JSON departs from the schema, or None when it is a valid record.

    >>> first_fault({"schema": 2, "score": {"name": "net", "value": "high", "status": "ok"}})
    "score.value is 'high'; expected a number or null"
    """
    schema = record_schema()
    return _fault(data, schema, schema["$defs"], "")


def _define(kind: type, definitions: dict[str, Any]) -> dict[str, Any]:
    """Add ``kind`` and the dataclasses inside it to ``definitions`` and return a reference to it."""
    if kind.__name__ not in definitions:
        definitions[kind.__name__] = {}  # present before the fields, so that a cycle ends
        hints = get_type_hints(kind)
        definitions[kind.__name__] = {
            "description": (inspect.getdoc(kind) or "").split("\n\n")[0].replace("\n", " "),
            "type": "object",
            "properties": {item.name: _describe(hints[item.name], definitions) for item in fields(kind)},
            "required": [
                item.name for item in fields(kind) if item.default is MISSING and item.default_factory is MISSING
            ],
            "additionalProperties": False,
        }
    return {"$ref": f"#/$defs/{kind.__name__}"}


def _describe(hint: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in _SIMPLE:
        return dict(_SIMPLE[hint])
    if is_dataclass(hint) and isinstance(hint, type):
        return _define(hint, definitions)
    if origin is Literal:
        return {"enum": list(arguments)}
    if origin is tuple:
        return {"type": "array", "items": _describe(arguments[0], definitions)}
    if origin is Mapping:
        return {"type": "object", "additionalProperties": _describe(arguments[1], definitions)}
    if origin in (Union, types.UnionType):
        parts = [_describe(part, definitions) for part in arguments]
        if all(set(part) == {"type"} for part in parts):
            kinds = [
                kind for part in parts for kind in ([part["type"]] if isinstance(part["type"], str) else part["type"])
            ]
            return {"type": list(dict.fromkeys(kinds))}
        return {"anyOf": parts}
    raise TypeError(f"The record schema cannot describe the type {hint!r}; teach leaderboards.schema about it.")


def _fault(value: Any, schema: Mapping[str, Any], definitions: Mapping[str, Any], where: str) -> str | None:
    """Check the keywords that :func:`record_schema` uses; depth-first, so the first fault is the innermost."""
    if "$ref" in schema:
        return _fault(value, definitions[schema["$ref"].rpartition("/")[2]], definitions, where)
    if "anyOf" in schema:  # an object or null, so the branch that fits the kind gives the helpful message
        branch = next(part for part in schema["anyOf"] if ("$ref" in part) == (value is not None))
        return _fault(value, branch, definitions, where)
    here = where or "the record"
    if "const" in schema and (value != schema["const"] or isinstance(value, bool)):
        return f"{here} is {_short(value)}; expected {schema['const']!r}"
    if "enum" in schema and value not in schema["enum"]:
        return f"{here} is {_short(value)}; expected one of {', '.join(map(repr, schema['enum']))}"
    if "type" in schema:
        kinds = [schema["type"]] if isinstance(schema["type"], str) else schema["type"]
        if not any(_is(value, kind) for kind in kinds):
            return f"{here} is {_short(value)}; expected {' or '.join(_NAMES[kind] for kind in kinds)}"
    if isinstance(value, Mapping):
        return _object_fault(value, schema, definitions, where)
    if isinstance(value, list):
        faults = (_fault(item, schema.get("items", {}), definitions, f"{where}[{i}]") for i, item in enumerate(value))
        return next((fault for fault in faults if fault), None)
    return None


def _object_fault(
    value: Mapping[str, Any], schema: Mapping[str, Any], definitions: Mapping[str, Any], where: str
) -> str | None:
    properties, others = schema.get("properties", {}), schema.get("additionalProperties", {})
    for name in schema.get("required", ()):
        if name not in value:
            return f"{where or 'the record'} lacks {name!r}"
    for name, item in value.items():
        if name not in properties and others is False:
            return f"{where or 'the record'} has the unknown field {name!r}"
        fault = _fault(item, properties.get(name, others), definitions, f"{where}.{name}".lstrip("."))
        if fault:
            return fault
    return None


def _is(value: Any, kind: str) -> bool:
    if isinstance(value, bool):
        return kind == "boolean"
    if kind == "number":
        return isinstance(value, int) or (isinstance(value, float) and math.isfinite(value))
    if kind == "integer":
        return isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    return isinstance(
        value, {"string": str, "object": Mapping, "array": list, "null": type(None), "boolean": bool}[kind]
    )


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
