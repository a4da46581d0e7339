"""Files of tensors: whole, readable for others, and without a temporary file that another library left."""

from __future__ import annotations

import os

import pytest
import torch
from safetensors import safe_open

from brainbench.core.reading.tensors import read_tensors
from brainbench.core.writing.tensors import write_tensors

TENSORS = {"a": torch.arange(6.0).reshape(2, 3).T, "b": torch.tensor([1.5], dtype=torch.float16)}


def test_tensors_come_back_with_what_is_said_of_them(tmp_path):
    write_tensors(tmp_path / "x.safetensors", TENSORS, step="3")
    found = read_tensors(tmp_path / "x.safetensors")
    assert found["b"].dtype == torch.float16
    assert all(torch.equal(found[name], value) for name, value in TENSORS.items())
    with safe_open(tmp_path / "x.safetensors", "pt") as file:
        assert file.metadata() == {"step": "3"}


def test_the_file_is_as_open_to_others_as_any_other(tmp_path):
    umask = os.umask(0)
    os.umask(umask)
    write_tensors(tmp_path / "x.safetensors", TENSORS)
    assert (tmp_path / "x.safetensors").stat().st_mode & 0o777 == 0o666 & ~umask


def test_what_fails_in_the_middle_leaves_the_old_file_alone(tmp_path, monkeypatch):
    write_tensors(tmp_path / "x.safetensors", TENSORS)
    monkeypatch.setattr("brainbench.core.files.os.fsync", lambda stream: (_ for _ in ()).throw(RuntimeError("stop")))
    with pytest.raises(RuntimeError, match="stop"):
        write_tensors(tmp_path / "x.safetensors", {"a": torch.zeros(1)})
    assert [path.name for path in tmp_path.iterdir()] == ["x.safetensors"]
    assert len(read_tensors(tmp_path / "x.safetensors")) == 2
