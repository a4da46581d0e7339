import json

import numpy as np
import pytest
import torch

from brainbench.core.errors import DataError, UsageError
from brainbench.models import export
from brainbench.models.export import READERS, export_model
from brainbench.models.registry import load_model

EVERY_KIND = [
    "zhuang-intersection-ln-small",
    "zhuang-lstm-ln-small",
    "zhuang-gru-small",
    "zhuang-feedforward-small",
    "resnet18-small+mamba",
    "s4-small+gpt",
    "zhuang-small+gpt",
]
SCALE = np.array(([1e-4] * 3 + [1e-6] * 3) * 5, np.float32)[:, None, None]


def _streams_alike(name, path, format):
    model = load_model(name)
    made = export_model(model, path, format=format, name=name)
    x = (np.random.default_rng(0).standard_normal((3, 5, 30, 5, 7)) * SCALE).astype(np.float32)
    run, h = READERS[format](made.path), np.zeros((3, made.state_size), np.float32)
    with torch.no_grad():
        expected = model.encode(torch.from_numpy(x)).numpy()
    for t in range(5):
        features, h = run(x[:, t], h)
        np.testing.assert_allclose(features, expected[:, t], atol=1e-4 * np.abs(expected).max(), rtol=1e-3)
    return made


@pytest.mark.slow
def test_an_onnx_file_computes_what_the_network_does(tmp_path):
    made = _streams_alike("zhuang-ugrnn-ln-small", tmp_path / "model", "onnx")
    assert made.path.suffix == ".onnx"
    contract = json.loads(made.contract.read_text())
    assert contract["inputs"] == {"obs": ["batch", 30, 5, 7], "h_in": ["batch", made.state_size]}
    assert contract["outputs"]["features"] == ["batch", 96]
    assert contract["units"][:4] == ["N", "N", "N", "N·m"]
    assert contract["channels"][6] == "1.Fx"
    assert contract["sample_rate"] == pytest.approx(1000 / 45)
    assert "zeros" in contract["reset"]
    assert contract["full"] is None
    assert contract["latency"] == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY_KIND)
def test_every_kind_of_network_can_be_an_onnx_file(name, tmp_path):
    made = _streams_alike(name, tmp_path / "model", "onnx")
    full = json.loads(made.contract.read_text())["full"]
    assert ("after 32 steps" in full) if "gpt" in name else full is None


@pytest.mark.parametrize("name", ["s4-small", pytest.param("zhuang-small+mamba", marks=pytest.mark.slow)])
def test_an_exported_program_computes_what_the_network_does(name, tmp_path):
    assert _streams_alike(name, tmp_path / "model.pt2", "torch").path.suffix == ".pt2"


def test_a_file_that_differs_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(export, "_write", lambda step, path, format: None)
    monkeypatch.setitem(export.READERS, "torch", lambda path: lambda obs, h: (np.zeros((len(obs), 96)), h))
    with pytest.raises(DataError, match=r"by 1 .*0\.0001"):
        export_model(load_model("resnet18-small"), tmp_path / "model.pt2", format="torch")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_format_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"'onxx'.*'onnx'"):
        export_model(load_model("resnet18-small"), tmp_path / "model", format="onxx")
