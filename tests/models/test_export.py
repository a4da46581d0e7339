from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from torch import nn

from brainbench.core.errors import DataError, UsageError
from brainbench.models import export
from brainbench.models.export import INPUTS, OUTPUTS, READERS, StreamingStep, export_model
from brainbench.models.registry import load_model
from tests.factories.training_sweeps import random_sweeps

NAMES = ["zhuang-intersection-ln-small", "zhuang-lstm-small+gpt", "zhuang-feedforward-small", "resnet18-small",
         "resnet18-small+mamba", "s4-small", "s4-small+gpt", "zhuang-small+mamba"]  # fmt: skip


@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_a_flat_state_streams_the_sweeps_features(name):
    model, x = load_model(name), random_sweeps(2, 6)
    step, expected = StreamingStep(model), model.encode(x)
    h = step.init_state(2)
    for t in range(6):
        features, h = step(x[:, t], h)
        torch.testing.assert_close(features, expected[:, t], atol=1e-4, rtol=1e-4)
    assert h.shape == (2, step.state_size)


@torch.no_grad()
@pytest.mark.parametrize("name", ["zhuang-ugrnn-small+gpt", "s4-small+mamba"])
def test_zeroing_a_row_resets_it_alone(name):
    model, x = load_model(name), random_sweeps(2, 4)
    step = StreamingStep(model)
    h = step.init_state(2)
    for t in range(3):
        _, h = step(x[:, t], h)
    h[0] = 0.0
    features, _ = step(x[:, 3], h)
    torch.testing.assert_close(features[:1], model.encode(x[:1, 3:])[:, 0], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(features[1:], model.encode(x[1:])[:, 3], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("wrong", [-1, 1.5, None, True])
def test_states_are_of_a_whole_number_of_sweeps(wrong):
    model = load_model("zhuang-small")
    for of in (model, StreamingStep(model)):
        with pytest.raises(UsageError, match=f"batch .*{wrong}"):
            of.init_state(wrong)


@torch.no_grad()
def test_a_full_context_gives_nan_until_it_is_reset():
    model = load_model("zhuang-small+gpt")
    step, x = StreamingStep(model), random_sweeps(1, 1)[:, 0]
    h = step.init_state(1)
    for t in range(model.spec.max_steps + 1):
        features, h = step(x, h)
        assert torch.isfinite(features).all() == (t < model.spec.max_steps)
    assert torch.isfinite(step(x, step.init_state(1))[0]).all()


@torch.no_grad()
@pytest.mark.parametrize("turn", [lambda step: step, lambda step: step.eval().double()])
def test_a_state_space_follows_its_weights_and_their_precision(turn):
    model, other, x = load_model("s4-small"), load_model("s4-small", seed=1), random_sweeps(2, 4)
    step = StreamingStep(model)
    model.load_state_dict(other.state_dict())
    turn(step)
    h = step.init_state(2)
    x, other = x.to(h.dtype), other.to(h.dtype)
    for t in range(4):
        features, h = step(x[:, t], h)
    assert features.dtype == h.dtype
    torch.testing.assert_close(features, other.encode(x)[:, 3], atol=1e-4, rtol=1e-4)


def test_a_state_space_learns_through_its_stream():
    model, x = load_model("s4-small"), random_sweeps(2, 3)
    step = StreamingStep(model)
    h = step.init_state(2)
    for t in range(3):
        features, h = step(x[:, t], h)
    features.square().sum().backward()
    memory = model.encoder.blocks[0].memory
    assert all(weight.grad is not None and weight.grad.abs().sum() > 0 for weight in memory.parameters())
    streamed = {name: weight.grad.clone() for name, weight in memory.named_parameters()}
    model.zero_grad()
    model.encode(x)[:, 2].square().sum().backward()
    for name, weight in memory.named_parameters():
        torch.testing.assert_close(streamed[name], weight.grad, rtol=1e-3, atol=1e-3 * weight.grad.abs().max().item())


@pytest.mark.gpu
@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_a_stream_moves_to_a_gpu(name):
    step, x = StreamingStep(load_model(name)), random_sweeps(2, 2)
    expected, h = [], step.init_state(2)
    for t in range(2):
        features, h = step(x[:, t], h)
        expected.append(features)
    step.cuda()
    h = step.init_state(2)
    for t in range(2):
        features, h = step(x[:, t].cuda(), h)
        torch.testing.assert_close(features.cpu(), expected[t], atol=1e-3, rtol=1e-3)


def test_other_networks_are_refused():
    with pytest.raises(UsageError, match="received Linear"):
        StreamingStep(nn.Linear(2, 2))


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


@pytest.mark.parametrize(("number", "sound"), [(-np.inf, True), (np.nan, False)])
def test_a_mask_may_be_infinite_and_what_is_computed_may_not(tmp_path, number, sound):
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 2]) for name in INPUTS]
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 2]) for name in OUTPUTS]
    nodes = [
        helper.make_node("Max", ["obs", "mask"], ["features"]),
        helper.make_node("Identity", ["h_in"], ["h_out"]),
    ]
    mask = helper.make_tensor("mask", TensorProto.FLOAT, [], [number])
    graph = helper.make_graph(nodes, "step", inputs, outputs, [mask])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", export.OPSET)], ir_version=9)
    onnx.save(model, tmp_path / "model.onnx")
    x = np.ones((1, 2), np.float32)
    if sound:
        np.testing.assert_array_equal(READERS["onnx"](tmp_path / "model.onnx")(x, x)[0], x)
    else:
        with pytest.raises(DataError, match=r"model\.onnx' gives values that are not finite"):
            READERS["onnx"](tmp_path / "model.onnx")


@pytest.mark.parametrize("name", ["s4-small", pytest.param("zhuang-small+mamba", marks=pytest.mark.slow)])
def test_an_exported_program_computes_what_the_network_does(name, tmp_path):
    assert _streams_alike(name, tmp_path / "model.pt2", "torch").path.suffix == ".pt2"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_an_error_and_not_the_end_of_the_process():
    # PyTorch's own writer of files ends the process where it cannot finish one.
    step = StreamingStep(load_model("zhuang-small").eval()).eval()
    example = torch.zeros(2, *step.model.spec.input_shape), step.init_state(2)
    with pytest.raises(OSError, match="No space left"):
        export.write_step(step, example, Path("/dev/full"), "torch", (export.BATCH, export.BATCH))


def test_a_file_that_differs_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(export, "write_step", lambda *given: None)
    monkeypatch.setitem(export.READERS, "torch", lambda path: lambda obs, h: (np.zeros((len(obs), 96)), h))
    with pytest.raises(DataError, match=r"by 1 .*0\.0001"):
        export_model(load_model("resnet18-small"), tmp_path / "model.pt2", format="torch")
    assert list(tmp_path.iterdir()) == []


def test_a_name_of_the_other_format_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"is named as a file of the format 'torch', not 'onnx'"):
        export_model(load_model("resnet18-small"), tmp_path / "model.pt2")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_format_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"'onxx'.*'onnx'"):
        export_model(load_model("resnet18-small"), tmp_path / "model", format="onxx")
