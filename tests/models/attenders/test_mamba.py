import pytest
import torch
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.models.attenders.mamba import MambaAttender
from brainbench.models.ops import dispatch


def _attender(**options):
    return MambaAttender(12, **({"blocks": 2, "states": 4} | options)).eval()


def test_parameters_equal_the_published_count():
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in MambaAttender(512).parameters()) == 6_784_000


@torch.no_grad()
def test_a_block_follows_the_published_equations():
    attender, x = _attender(blocks=1), torch.randn(2, 6, 12)
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
    attender, x = _attender(), torch.randn(2, 30, 12)
    expected, state = attender(x), attender.init_state(2)
    for t in range(30):
        y, state = attender.step(x[:, t], state)
        torch.testing.assert_close(y, expected[:, t], atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_activations_are_the_blocks_and_the_norm():
    attender, x = _attender(), torch.randn(2, 3, 12)
    y, activations = attender(x, return_activations=True)
    assert tuple(activations) == ("block1", "block2", "norm")
    assert torch.equal(activations["norm"], y)
    assert list(attender(x, return_activations=["block2"])[1]) == ["block2"]


def test_sizes_are_positive():
    with pytest.raises(UsageError, match="features 12, blocks 0"):
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
    attender, x = _attender(), torch.randn(2, 7, 12)

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
    _attender()(torch.randn(1, 3, 12))
