"""A graph whose convolutions and gates are our own kernels computes what PyTorch's operations compute."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.ops import convolution, dispatch
from brainbench.models.ops.layers import Conv2d
from brainbench.models.registry import load_model
from brainbench.models.streaming import StreamingStep


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
    monkeypatch.setattr(convolution, "unfolded", lambda *a: (_ for _ in ()).throw(MemoryError()))
    with pytest.raises(MemoryError):
        graph(torch.randn(2, 3, 2, 4, 5, device=single))
    assert all(part.deferred is None for part in graph.modules() if isinstance(part, Conv2d))
