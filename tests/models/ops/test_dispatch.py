"""A graph whose convolutions and gates are our own kernels computes what PyTorch's operations compute."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch.nn import functional

from brainbench.models.export import StreamingStep
from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.ops import dispatch
from brainbench.models.ops.layers import Conv2d
from brainbench.models.registry import load_model


def _unfolded_by_pytorch(inputs: Sequence[torch.Tensor], geometry: dispatch.ConvolutionShape) -> torch.Tensor:
    x = torch.cat([item.float() for item in inputs], 1)
    (top, left), (rows, columns) = geometry.pads, geometry.kernel
    down = geometry.out[0] + rows - 1 - top - x.shape[2]
    right = geometry.out[1] + columns - 1 - left - x.shape[3]
    windows = functional.unfold(functional.pad(x, (left, right, top, down)), geometry.kernel)  # [B, C · taps, places]
    return windows.unflatten(1, (x.shape[1], -1)).permute(0, 3, 2, 1).flatten(2).flatten(0, 1).to(dispatch.HALF)


@pytest.mark.parametrize(
    ("kernel", "padding"), [((2, 2), "same"), ((2, 2), "valid"), ((3, 2), "same"), ((3, 3), (1, 1))]
)
def test_windows_are_those_of_pytorch(kernel: tuple[int, int], padding: Any, single: torch.device) -> None:
    conv = Conv2d(7, 5, kernel_size=kernel, padding=padding).to(single)
    inputs = [torch.randn(3, 4, 4, 6, device=single).to(memory_format=torch.channels_last)]
    inputs.append(torch.randn(3, 3, 4, 6, device=single))
    geometry = dispatch.ConvolutionShape.of(conv, (4, 6))
    windows = dispatch.unfolded(inputs, geometry)
    torch.testing.assert_close(windows, _unfolded_by_pytorch(inputs, geometry).float(), rtol=1e-2, atol=1e-2)
    with torch.no_grad():
        torch.testing.assert_close(dispatch.convolve(conv, inputs), conv(torch.cat(inputs, 1)), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("channels", [(8, 16), (2, 6, 4), (16,), (3, 1, 2, 5, 1, 4)])
def test_windows_of_any_number_of_inputs_lie_side_by_side(channels: tuple[int, ...], single: torch.device) -> None:
    conv = Conv2d(sum(channels), 3, kernel_size=(2, 2), padding="same").to(single)
    # One of single, the others of half precision; one is part of a larger map.
    inputs = [torch.randn(5, 4, 6, count, device=single).permute(0, 3, 1, 2) for count in channels]
    inputs[1:] = [x.bfloat16() for x in inputs[1:]]
    inputs[0] = torch.cat((inputs[0], inputs[0]), 1)[:, : channels[0]]
    geometry = dispatch.ConvolutionShape.of(conv, (4, 6))
    windows = dispatch.unfolded(inputs, geometry)
    assert windows.shape == (5 * 24, 4 * sum(channels))
    expected = _unfolded_by_pytorch(inputs, geometry).float()
    torch.testing.assert_close(windows.float(), expected, rtol=1e-2, atol=1e-2)


def _make_graph(kind: str = "intersection", layer_norm: bool = True) -> TemporalGraph:
    memory = Memory(kind, layer_norm=layer_norm)
    nodes = (
        Node("a", Convolution(4, padding="valid"), memory),
        Node("b", Convolution(5), memory),
        Node("c", Convolution(3), memory),
        Node("d", Dense(6)),
    )
    edges = (Edge("a", "b"), Edge("b", "c"), Edge("c", "d"), Edge("b", "d"), Edge("c", "b", feedback=True))
    torch.manual_seed(3)
    graph = TemporalGraph(GraphSpec(nodes, edges, ("a",), "d", (2, 4, 5)))
    with torch.no_grad():
        for name, value in graph.named_parameters():
            if "norm" in name or "bias" in name:  # defaults of 1 and 0 would hide a mistake
                value.add_(0.3 * torch.randn_like(value))
    return graph


def _gradients(graph: TemporalGraph, x: torch.Tensor, **options: Any) -> list[torch.Tensor]:
    graph.zero_grad()
    x = x.detach().requires_grad_()
    y = graph(x, **options)
    torch.manual_seed(5)
    (y.float() * torch.randn(y.shape).to(y.device)).sum().backward()
    assert x.grad is not None
    return [y.detach(), x.grad, *(p.grad if p.grad is not None else torch.zeros_like(p) for p in graph.parameters())]


def _plainly(work: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> Any:
    with monkeypatch.context() as patch:
        patch.setattr(dispatch, "usable", lambda x: False)
        return work()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "unroll"),
    [("intersection", "biological"), ("intersection", "full"), ("gru", "full"), ("time-decay", "biological")],
)
def test_answers_and_gradients_in_single_precision_are_those_of_pytorch(
    kind: str, unroll: str, single: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The norm of a trace is PyTorch's own and, where a trace is all but constant, magnifies rounding.
    graph = _make_graph(kind, layer_norm=kind != "time-decay").to(single)
    x = torch.randn(2, 4, 2, 4, 5, device=single)
    expected = _plainly(lambda: _gradients(graph, x, unroll=unroll), monkeypatch)
    for ours, theirs in zip(_gradients(graph, x, unroll=unroll), expected, strict=True):
        assert (ours - theirs).norm() <= 1e-4 * theirs.norm() + 1e-6


def test_a_cell_without_norms_has_the_gradients_of_pytorch(
    single: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = _make_graph(layer_norm=False).to(single)
    x = torch.randn(2, 4, 2, 4, 5, device=single)
    expected = _plainly(lambda: _gradients(graph, x), monkeypatch)
    for ours, theirs in zip(_gradients(graph, x), expected, strict=True):
        assert (ours - theirs).norm() <= 1e-4 * theirs.norm() + 1e-6


@pytest.mark.slow
def test_answers_that_only_the_last_step_gives_have_the_gradients_of_pytorch(
    single: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = _make_graph().to(single)
    x = torch.randn(2, 6, 2, 4, 5, device=single)
    expected = _plainly(lambda: _gradients(graph, x, last=True), monkeypatch)
    for ours, theirs in zip(_gradients(graph, x, last=True), expected, strict=True):
        assert (ours - theirs).norm() <= 1e-4 * theirs.norm() + 1e-6


@pytest.mark.slow
def test_frozen_weights_still_pass_gradients_on(single: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = _make_graph().to(single)
    graph.node("b").requires_grad_(False)
    x = torch.randn(2, 4, 2, 4, 5, device=single)
    expected = _plainly(lambda: _gradients(graph, x), monkeypatch)
    for ours, theirs in zip(_gradients(graph, x), expected, strict=True):
        assert (ours - theirs).norm() <= 1e-4 * theirs.norm() + 1e-6


@pytest.mark.slow
def test_half_precision_answers_and_gradients_are_within_its_rounding(
    device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = _make_graph().to(device)
    x = torch.randn(4, 5, 2, 4, 5, device=device)
    single = _plainly(lambda: _gradients(graph, x), monkeypatch)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        half, usual = _gradients(graph, x), _plainly(lambda: _gradients(graph, x), monkeypatch)
    for ours, theirs, exact in zip(half, usual, single, strict=True):
        assert (ours - exact).norm() <= 2 * (theirs - exact).norm() + 0.01 * exact.norm()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["intersection", "lstm"])
def test_streaming_and_sweeps_agree_without_gradients(kind: str, single: torch.device) -> None:
    graph = _make_graph(kind).to(single).eval()
    x = torch.randn(2, 5, 2, 4, 5, device=single)
    with torch.no_grad():
        whole, state = graph(x), graph.init_state(2)
        for t in range(5):
            y, state = graph.step(x[:, t], state)
            torch.testing.assert_close(y, whole[:, t], atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_a_flat_state_streams_with_the_kernels(single: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    step = StreamingStep(load_model("zhuang-intersection-ln-small", seed=1).eval()).to(single)
    x = 1e-4 * torch.randn(2, 2, 30, 5, 7, device=single)

    def run() -> list[torch.Tensor]:
        state, found = step.init_state(2).to(single), []
        with torch.no_grad():
            for sweep in x:
                features, state = step(sweep, state)
                found.append(features)
        return found

    for ours, theirs in zip(run(), _plainly(run, monkeypatch), strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)


def test_a_pass_cannot_be_taken_back_twice(single: torch.device) -> None:
    y = _make_graph().to(single)(torch.randn(2, 3, 2, 4, 5, device=single)).sum()
    y.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="compute it again"):
        y.backward()


def test_no_deferred_gradient_is_left_behind_by_a_pass_that_fails(
    single: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = _make_graph().to(single)
    monkeypatch.setattr(dispatch, "unfolded", lambda *a: (_ for _ in ()).throw(MemoryError()))
    with pytest.raises(MemoryError):
        graph(torch.randn(2, 3, 2, 4, 5, device=single))
    assert all(part.deferred is None for part in graph.modules() if isinstance(part, Conv2d))
