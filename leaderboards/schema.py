"""The JSON Schema of a result record, derived from the dataclasses of :mod:`brainbench.core.records`.

The published file ``leaderboards/record.schema.json`` is :func:`record_schema` written out; a test keeps the two in
step. Records are checked by the dataclasses themselves (:meth:`ResultRecord.from_json`).
"""

from __future__ import annotations

import inspect
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from brainbench.core.records import RECORD_SCHEMA, ResultRecord

SCHEMA_PATH = Path(__file__).with_name("record.schema.json")
"""The published schema, shipped with the package."""


@cache
def record_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of one record file. The result is shared: do not change it."""
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
