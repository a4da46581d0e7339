from functools import partial

import pytest
import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.models.encoders import GPTAttender, MambaAttender, ResNet18Encoder, S4Encoder, zhuang_graph
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.ops import dispatch

CELLS = ["time-decay", "ugrnn", "gru", "intersection", "lstm"]


def _count(spec):
    with torch.device("meta"):
        return sum(parameter.numel() for parameter in TemporalGraph(spec).parameters())


@pytest.mark.parametrize(
    ("cell", "layer_norm", "parameters"),
    [
        ("time-decay", False, 23_460_072),
        ("ugrnn", False, 30_688_416),
        ("gru", False, 34_302_592),
        ("intersection", False, 37_916_768),
        ("lstm", False, 37_916_768),
        ("intersection", True, 37_928_800),
    ],
)
def test_parameters_equal_the_published_counts(cell, layer_norm, parameters):
    assert _count(zhuang_graph(cell, layer_norm)) == parameters


@pytest.mark.parametrize(("cell", "norms"), [("ugrnn", 2), ("gru", 3), ("lstm", 5)])
def test_layer_norm_adds_a_scale_and_a_shift_per_gate_and_channel(cell, norms):
    channels = 96 + 128 + 256 + 384 + 384 + 256
    assert _count(zhuang_graph(cell, True)) - _count(zhuang_graph(cell)) == 2 * norms * channels


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("cell", CELLS)
def test_the_graph_is_the_published_one_at_either_size(cell, small):
    spec = zhuang_graph(cell, small=small)
    inputs, outputs = spec.shapes()
    feedback = {(edge.source, edge.target) for edge in spec.edges if edge.feedback}
    assert feedback == {(f"conv{a}", f"conv{b}") for a, b in ((3, 2), (4, 2), (4, 3), (5, 3), (5, 4), (6, 4), (6, 5))}
    assert {edge.source for edge in spec.predecessors["fc7"]} == {"conv2", "conv4", "conv6"}
    widths = [18, 24, 48, 72, 72, 48] if small else [96, 128, 256, 384, 384, 256]
    assert [outputs[f"conv{i + 1}"] for i in range(6)] == [(width, 4, 6) for width in widths]
    assert outputs["fc7"] + outputs["fc8"] == ((192, 96) if small else (1024, 512))
    assert inputs["fc7"][0] * 24 == (3456 if small else 18_432)


def test_memory_sits_on_every_node_with_time_decay_and_on_convolutions_with_gates():
    decay, gated = zhuang_graph(), zhuang_graph("gru")
    assert all(node.memory is not None for node in decay.nodes)
    assert [node.name for node in gated.nodes if node.memory is None] == ["fc7", "fc8"]


def test_biases_start_at_zero_and_a_tenth():
    graph = TemporalGraph(zhuang_graph("lstm", small=True))
    assert all(not graph.node(f"conv{i + 1}").operation.bias.any() for i in range(6))
    assert torch.equal(graph.node("fc7").operation.bias, torch.full((192,), 0.1))
    assert all(not module.conv.bias.any() for module in graph.modules() if hasattr(module, "conv"))


def _encoder():
    return ResNet18Encoder(small=True).eval()


def test_parameters_equal_the_published_count():
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in ResNet18Encoder().parameters()) == 11_523_840


def test_every_step_is_seen_alone():
    encoder, x = _encoder(), torch.randn(2, 5, 30, 5, 7)
    changed = x.clone()
    changed[:, 2] += 1.0
    with torch.no_grad():
        before, after = encoder(x), encoder(changed)
    assert (before != after).any(2)[0].tolist() == [False, False, True, False, False]


def test_activations_are_the_stages_in_order():
    with torch.no_grad():
        y, activations = _encoder()(torch.randn(2, 3, 30, 5, 7), return_activations=True)
    assert tuple(activations) == ResNet18Encoder.layers
    assert {name: tuple(value.shape[2:]) for name, value in activations.items()} == {
        "conv1": (12, 2, 2),
        "layer1": (12, 2, 2),
        "layer2": (24, 1, 1),
        "layer3": (48, 1, 1),
        "layer4": (96, 1, 1),
        "fc": (96,),
    }
    assert torch.equal(activations["fc"], y)


def test_a_residual_block_that_adds_nothing_passes_its_input_on():
    encoder = _encoder()
    block = encoder.layer1[0]
    with torch.no_grad():
        block.norm2.weight.zero_()
        x = torch.rand(2, 12, 2, 2)
        assert torch.equal(block(x), x)


def test_a_wrong_stimulus_is_refused():
    with pytest.raises(UsageError, match=r"received \[1, 2, 6, 5, 7\]"):
        _encoder()(torch.zeros(1, 2, 6, 5, 7))


def test_parameters_equal_the_published_count_of_s4():
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in S4Encoder().parameters()) == 3_434_496


@torch.no_grad()
def test_a_stream_equals_the_convolution():
    encoder, x = S4Encoder(small=True).eval(), torch.randn(2, 60, 30, 5, 7)
    expected, state = encoder(x), encoder.init_state(2)
    for t in range(60):
        y, state = encoder.step(x[:, t], state)
        torch.testing.assert_close(y, expected[:, t], atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_every_block_ends_in_its_norm():
    activations = S4Encoder(small=True).eval()(torch.randn(2, 9, 30, 5, 7), return_activations=True)[1]
    for index in range(1, 5):
        stream = activations[f"block{index}"]
        torch.testing.assert_close(stream.mean(-1), torch.zeros(2, 9), atol=1e-5, rtol=0.0)
        torch.testing.assert_close(stream.var(-1, unbiased=False), torch.ones(2, 9), atol=1e-3, rtol=0.0)


@torch.no_grad()
def test_dropout_acts_in_training_alone():
    encoder, x = S4Encoder(small=True, dropout=0.5).train(), torch.randn(1, 4, 30, 5, 7)
    assert not torch.equal(encoder(x), encoder(x))
    assert torch.equal(encoder.eval()(x), encoder(x))


@torch.no_grad()
def test_the_future_does_not_show():
    encoder, x = S4Encoder(small=True).eval(), torch.randn(1, 9, 30, 5, 7)
    later = x.clone()
    later[:, 6:] += 3.0
    torch.testing.assert_close(encoder(x)[:, :6], encoder(later)[:, :6], atol=1e-5, rtol=1e-5)
    assert not torch.allclose(encoder(x)[:, 6], encoder(later)[:, 6], atol=1e-2)


def test_a_wrong_stimulus_is_refused_of_s4():
    with pytest.raises(UsageError, match=r"received \[1, 30, 5, 7\]"):
        S4Encoder(small=True)(torch.zeros(1, 30, 5, 7))


def _gpt(**options):
    return GPTAttender(12, 16, **({"blocks": 2, "heads": 4, "context": 11} | options)).eval()


@pytest.mark.parametrize(("width", "parameters"), [(512, 25_778_688), (256, 6_532_608)])
def test_parameters_of_attenders_equal_the_published_counts(width, parameters):
    with torch.device("meta"):
        attender = GPTAttender(512, width)
    assert sum(parameter.numel() for parameter in attender.parameters()) == parameters
    assert attender.max_steps == 32


def test_a_pass_equals_pytorchs_transformer():
    attender, gelu = _gpt(), partial(functional.gelu, approximate="tanh")
    layers = nn.ModuleList(
        nn.TransformerEncoderLayer(16, 4, 64, 0.0, gelu, batch_first=True, norm_first=True) for _ in range(2)
    ).eval()
    x, steps = torch.randn(3, 5, 12), 5
    with torch.no_grad():
        for block, layer in zip(attender.blocks, layers, strict=True):
            layer.self_attn.in_proj_weight.copy_(block.query_key_value.weight.mul_(3.0))
            block.mlp[0].weight.mul_(3.0)  # large enough that the two forms differ
            layer.self_attn.in_proj_bias.copy_(block.query_key_value.bias.normal_())
            layer.self_attn.out_proj.load_state_dict(block.project.state_dict())
            layer.linear1.load_state_dict(block.mlp[0].state_dict())
            layer.linear2.load_state_dict(block.mlp[2].state_dict())
            layer.norm1.load_state_dict(block.norm_attention.state_dict())
            layer.norm2.load_state_dict(block.norm_mlp.state_dict())
        tokens = torch.stack((x, attender.action.expand(3, steps, 12)), 2).reshape(3, 2 * steps, 12)
        stream = attender.embed(tokens) + attender.positions[: 2 * steps]
        mask = nn.Transformer.generate_square_subsequent_mask(2 * steps)
        for layer in layers:
            stream = layer(stream, src_mask=mask, is_causal=True)
        stream = functional.layer_norm(stream, (16,), attender.norm.weight, attender.norm.bias)
        expected = functional.linear(stream[:, 1::2], attender.lm_head.weight)
        torch.testing.assert_close(attender(x), expected, atol=1e-5, rtol=1e-4)


def test_the_future_does_not_show_in_attenders():
    attender, x = _gpt(), torch.randn(2, 5, 12)
    later = x.clone()
    later[:, 3:] = 9.0
    with torch.no_grad():
        before, after = attender(x), attender(later)
    torch.testing.assert_close(before[:, :3], after[:, :3], atol=1e-6, rtol=1e-5)
    assert not torch.allclose(before[:, 3], after[:, 3], atol=1e-3)


def test_a_step_equals_the_sweep():
    attender, x = _gpt(), torch.randn(2, 5, 12)
    with torch.no_grad():
        expected, state = attender(x), attender.init_state(2)
        for t in range(5):
            y, state = attender.step(x[:, t], state)
            torch.testing.assert_close(y, expected[:, t], atol=1e-6, rtol=1e-5)
    assert state[0][0].shape[2] == 10


def test_a_full_context_is_announced():
    attender = _gpt()
    with pytest.raises(UsageError, match=r"at most 5 steps .* step 6"):
        attender(torch.zeros(1, 6, 12))
    state = attender.init_state(1)
    for _ in range(5):
        _, state = attender.step(torch.zeros(1, 12), state)
    with pytest.raises(UsageError, match=r"step 6.* init_state"):
        attender.step(torch.zeros(1, 12), state)


def test_activations_are_read_at_the_action_tokens():
    attender, x = _gpt(), torch.randn(2, 5, 12)
    with torch.no_grad():
        y, activations = attender(x, return_activations=True)
    assert {name: tuple(value.shape) for name, value in activations.items()} == {
        "block1": (2, 5, 16),
        "block2": (2, 5, 16),
        "lm_head": (2, 5, 16),
    }
    assert torch.equal(activations["lm_head"], y)
    expected = functional.linear(attender.norm(activations["block2"]), attender.lm_head.weight)
    torch.testing.assert_close(y, expected)


def test_dropout_of_attenders_acts_in_training_alone():
    attender, x = _gpt(dropout=0.5), torch.randn(1, 3, 12)
    assert not torch.equal(attender.train()(x), attender(x))
    assert torch.equal(attender.eval()(x), attender(x))


def test_a_width_that_heads_cannot_share_is_refused():
    with pytest.raises(UsageError, match="4 heads; received 10"):
        GPTAttender(12, 10)
    with pytest.raises(UsageError, match="4 heads; received 0"):
        GPTAttender(12, 0)
    with pytest.raises(UsageError, match=r"received -0\.5"):
        GPTAttender(12, 8, dropout=-0.5)


def _mamba(**options):
    return MambaAttender(12, **({"blocks": 2, "states": 4} | options)).eval()


def test_parameters_of_mamba_equal_the_published_count():
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in MambaAttender(512).parameters()) == 6_784_000


@torch.no_grad()
def test_a_block_follows_the_published_equations():
    attender, x = _mamba(blocks=1), torch.randn(2, 6, 12)
    block = attender.blocks[0]
    branch, gate = (block.norm(x) @ block.expand.weight.T).chunk(2, -1)
    h, decay = torch.zeros(2, 24, 4), -torch.exp(block.log_decay)
    for t in range(6):
        taps = sum(branch[:, t - lag] * block.convolution.weight[:, 0, 3 - lag] for lag in range(min(t, 3) + 1))
        u = functional.silu(taps + block.convolution.bias)
        rank, drive, readout = (u @ block.select.weight.T).split((1, 4, 4), -1)
        size = functional.softplus(rank @ block.step_size.weight.T + block.step_size.bias)
        h = torch.exp(size[..., None] * decay) * h + (size * u)[..., None] * drive[:, None]
        y = (h @ readout[..., None])[..., 0] + block.skip * u
        expected = x[:, t] + (y * functional.silu(gate[:, t])) @ block.project.weight.T
        torch.testing.assert_close(block(x)[:, t], expected, atol=1e-6, rtol=1e-5)


def test_initial_steps_lie_in_the_published_range():
    bias = MambaAttender(64).blocks[0].step_size.bias
    size = functional.softplus(bias)
    assert size.min() >= 0.999e-3
    assert size.max() <= 1.001e-1


@torch.no_grad()
def test_a_stream_equals_the_sweep():
    attender, x = _mamba(), torch.randn(2, 30, 12)
    expected, state = attender(x), attender.init_state(2)
    for t in range(30):
        y, state = attender.step(x[:, t], state)
        torch.testing.assert_close(y, expected[:, t], atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_activations_are_the_blocks_and_the_norm():
    attender, x = _mamba(), torch.randn(2, 3, 12)
    y, activations = attender(x, return_activations=True)
    assert tuple(activations) == ("block1", "block2", "norm")
    assert torch.equal(activations["norm"], y)
    assert list(attender(x, return_activations=["block2"])[1]) == ["block2"]


def test_sizes_are_positive():
    with pytest.raises(UsageError, match=r"blocks of a Mamba attender .*received 0"):
        MambaAttender(12, blocks=0)


def _selective_scan(u, delta, A, B, C, D, *, z, delta_bias, delta_softplus):
    """What mamba_ssm documents its kernel to compute: u, delta, z [B, D, L], A [D, N], B and C [B, N, L], D [D]."""
    assert delta_softplus
    size = functional.softplus(delta + delta_bias[:, None])
    state, outputs = u.new_zeros(*u.shape[:2], A.shape[1]), []
    for t in range(u.shape[2]):
        state = torch.exp(size[:, :, t, None] * A) * state + (size * u)[:, :, t, None] * B[:, None, :, t]
        outputs.append((state * C[:, None, :, t]).sum(-1))
    return (torch.stack(outputs, 2) + D[:, None] * u) * functional.silu(z)


def test_a_kernel_that_does_what_mamba_ssm_documents_changes_neither_answers_nor_gradients(monkeypatch):
    attender, x = _mamba(), torch.randn(2, 7, 12)

    def results():
        attender.zero_grad()
        y = attender(x)
        y.square().sum().backward()
        return [y.detach(), *(parameter.grad.clone() for parameter in attender.parameters())]

    plain = results()
    monkeypatch.setattr(dispatch, "selective_scan", lambda x: _selective_scan)
    torch.testing.assert_close(results(), plain, atol=1e-4, rtol=1e-4)


def test_without_cuda_no_kernel_is_looked_for(monkeypatch):
    monkeypatch.setattr(dispatch, "_mamba_kernel", lambda: pytest.fail("asked for a CUDA kernel"))
    _mamba()(torch.randn(1, 3, 12))
