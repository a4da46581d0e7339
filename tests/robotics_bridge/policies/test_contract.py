"""Contracts of exported policies: every value out of range is refused in one sentence that names its place."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import asdict

import pytest

from brainbench.core.errors import BrainbenchError, DataError, UsageError
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.tasks.settings import CONTACTS
from tests.factories.mutations import mutate_text
from tests.factories.policies import contract_of
from tests.factories.structures import mutate

NAN, INF = math.nan, math.inf


def _set(contract, place, value):
    *path, last = place.split(".")
    part = contract
    for name in path:
        part = part[name]
    part[last] = value
    return contract


def _read(folder, contract):
    path = folder / "policy.onnx.json"
    path.write_text(json.dumps(contract))
    return PolicyContract.read(path)


def test_a_contract_is_read_as_it_was_written(tmp_path) -> None:
    found = _read(tmp_path, contract_of())
    assert (found.rate, found.joints, found.moved, found.frozen) == (40.0, ("a", "b", "c"), ("a", "c"), {"b": 0.3})
    assert found.inputs == {"proprio": (8,), "command": (1,), "tactile": (5, 2, 3)}
    assert found.action_map["scale"] == (0.5, -0.5)
    assert found.more["contacts"] == CONTACTS["published"]
    firm = _set(contract_of(), "deployment.contacts", asdict(CONTACTS["firm"]))
    assert _read(tmp_path, firm).more["contacts"] == CONTACTS["firm"]


@pytest.mark.parametrize(
    ("place", "values"),
    [
        ("format", ["pickle", 1, None, ["onnx"]]),
        ("inputs", [[], {}, "proprio", [["proprio"]], [["proprio", [8]], ["proprio", [8]]], [[1, [8]]]]),
        ("inputs", [[["proprio", shape]] for shape in ([7], [0], [-8], [8.0], [True], [], [1, 1, 1, 8], "8")]),
        ("inputs", [[["command", [9_000_000]], ["thermal", [9_000_000]]]]),
        ("inputs", [[["tactile", shape]] for shape in ([5, 2], [5, 3, 3], [5, 2, 1], [5, 2, 10**9])]),
        ("deployment.rate", [NAN, INF, -INF, 0, -40, 1e9, 10**400, "40", True, None, [40]]),
        ("deployment.hand", ["", 1, None, "x" * 5000]),
        ("deployment.joints", [[], ["a"], ["a", "b", "b"], ["a", "b", 3], "abc", ["a", "b", "c", "d"], ["j"] * 300]),
        ("deployment.action_map", [[], None, {}]),
        ("deployment.action_map.names", [["a"], ["a", "a"], ["a", "x"], []]),
        ("deployment.action_map.default", [[0.1, NAN], [0.1], [0.1, 100.0], [0.1, "0"], 0.1, [[0.1, 0.1]]]),
        ("deployment.action_map.scale", [[0.5, INF], [0.5, 0.0], [1e6, 0.5], [0.5, True], [None, 0.5]]),
        ("deployment.action_map.low", [[NAN, 0.0], [-1.0, 0.4], [2.0, 0.0], [-INF, 0.0]]),
        ("deployment.action_map.high", [[1.0, INF], [1e3, 0.4], [1.0, NAN]]),
        ("deployment.frozen", [{"b": NAN}, {"b": 1e3}, {"b": "0"}, {}, [], {"b": 0.1, "a": 0.1}, {"x": 0.1}]),
        ("deployment.links", [[], ["l", "l"], ["l"], "l"]),
        ("deployment.observe", ["agg_farce", "bool", 3]),
        ("deployment.sub_steps", [0, -5, 5.0, 10**6, NAN]),
        ("deployment.contacts", [[1], "firm", {"time_constant": NAN}, {"substeps": 2.5}, {"impedance": [0.9]}]),
        ("sha256", [1, None]),
    ],
)  # fmt: skip
def test_values_out_of_range_are_refused_with_their_place(tmp_path, place, values) -> None:
    for value in values:
        with pytest.raises(DataError, match=rf"{place.rpartition('.')[2]}|joints|tactile|default") as caught:
            _read(tmp_path, _set(contract_of(), place, value))
        text = str(caught.value)
        assert len(text) < 450, text
        assert "\n" not in text


@pytest.mark.parametrize("name", ["rate", "hand", "joints", "action_map", "frozen", "twist", "contacts"])
def test_what_a_hand_needs_must_stand_in_it(tmp_path, name) -> None:
    contract = contract_of()
    del contract["deployment"][name]
    with pytest.raises(UsageError, match=name):
        _read(tmp_path, contract)


@pytest.mark.parametrize(
    "text", ["", "[]", "null", "{", "[" * 100_000, '{"a": ' * 100_000, "1" * 5000, "\xff\xfe", "NaN", '{"inputs": 1}']
)
def test_files_that_are_no_contract_are_refused(tmp_path, text) -> None:
    path = tmp_path / "policy.onnx.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=r"policy\.onnx\.json"):
        PolicyContract.read(path)
    with pytest.raises(DataError, match=tmp_path.name):
        PolicyContract.read(tmp_path)


def _check_mutants(folder, cases: int) -> None:
    refused = longest = 0
    for seed in range(cases):
        contract = contract_of()
        path = folder / "policy.onnx.json"
        if seed % 2:
            path.write_bytes(mutate_text(json.dumps(contract).encode(), seed))
        else:
            path.write_text(json.dumps(mutate(copy.deepcopy(contract), seed)))
        try:
            found = PolicyContract.read(path)
        except BrainbenchError as error:
            refused += 1
            longest = max(longest, len(str(error)))
            continue
        numbers = [found.rate, *found.frozen.values(), *(n for row in found.action_map.values() for n in row)]
        assert all(math.isfinite(number) for number in numbers)
        assert 1 <= found.rate <= 1000
        assert all(abs(number) <= 4 * math.pi for number in numbers[1:])
        assert all(0 < math.prod(shape) <= 10_000_000 for shape in found.inputs.values())
        assert found.inputs.get("proprio", (8,)) == (8,)
    assert refused > cases // 3
    assert longest < 600


def test_damaged_contracts_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 30)


@pytest.mark.slow
def test_many_damaged_contracts_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 500)
