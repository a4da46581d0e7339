"""Folders of students: damage is refused, nothing that is not finite gets through, and no foreign code runs."""

from __future__ import annotations

import json
import time

import pytest
import torch
from safetensors.torch import load_file, save_file

from brainbench.core.errors import BrainbenchError, DataError, UsageError
from robotics_bridge.policies.training.student_files import CONFIG, MODEL, load_student
from tests.factories.mutations import mutate_text
from tests.factories.policies import student_folder
from tests.factories.structures import mutate


def _changed(folder, **changes):
    path = folder / CONFIG
    config = json.loads(path.read_text())
    for name, value in changes.items():
        (config["distill"] if name in config["distill"] else config)[name] = value
    path.write_text(json.dumps(config))
    return folder


def _check_mutants(folder, cases: int) -> None:
    student_folder(folder)
    config, weights = (folder / CONFIG).read_bytes(), (folder / MODEL).read_bytes()
    refused = longest = slowest = 0
    for seed in range(cases):
        values = (json.dumps(mutate(json.loads(config), seed)).encode(), mutate_text(config, seed), config)[seed % 3]
        (folder / CONFIG).write_bytes(values)
        (folder / MODEL).write_bytes(mutate_text(weights, seed) if seed % 3 == 2 else weights)
        begun = time.monotonic()
        try:
            student, _ = load_student(folder)
        except BrainbenchError as error:
            refused, longest = refused + 1, max(longest, len(str(error)))
        else:
            assert all(torch.isfinite(value).all() for value in student.state_dict().values())
        slowest = max(slowest, time.monotonic() - begun)
    assert refused > cases // 3
    assert longest < 800
    assert slowest < 10


def test_damaged_folders_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 30)


@pytest.mark.slow
def test_many_damaged_folders_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 500)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("hidden", [[10**9], [65536, 65536], [], [0], "512", [8, 8]]),
        ("learning_rate", [float("nan"), float("inf"), 0.0, -1.0, 2.0, "fast"]),
        ("teacher_share", [float("nan"), 1.5]),
        ("num_envs", [0, -1, 1.5, 10**30, True]),
        ("encoder_settings", [{"features": 10**9}, {"features": 0}, {"slots": -1}, {"speed": 1}, []]),
        ("actions", [0, 1.0, 10**6, None]),
        ("groups", [[], [["proprio", [10**9]]], [["proprio", [9]], ["command", [1]], ["tactile", [5, 5, 3]]]]),
    ],
)
def test_sizes_and_numbers_out_of_range_are_refused_before_memory_is_taken(tmp_path, name, values) -> None:
    for value in values:
        with pytest.raises(BrainbenchError, match=f"{name}|features|slots|speed|describes|share"):
            load_student(_changed(student_folder(tmp_path), **{name: value}))


def test_weights_that_are_not_finite_are_refused_by_name(tmp_path) -> None:
    student_folder(tmp_path)
    weights = load_file(tmp_path / MODEL)
    weights["mlp.2.bias"][0] = float("nan")
    save_file(weights, tmp_path / MODEL)
    with pytest.raises(DataError, match=r"mlp\.2\.bias"):
        load_student(tmp_path)


@pytest.mark.parametrize("place", ["{folder}/encoder.py:build", "encoder:build", "./encoder.py"])
def test_no_code_of_a_folder_runs(tmp_path, monkeypatch, place) -> None:
    ran = tmp_path / "ran"
    (tmp_path / "encoder.py").write_text(f"open({str(ran)!r}, 'w')\n")
    monkeypatch.syspath_prepend(tmp_path)
    folder = _changed(student_folder(tmp_path / "student"), encoder=place.format(folder=tmp_path))
    with pytest.raises(UsageError, match="encoder"):
        load_student(folder)
    assert not ran.exists()
