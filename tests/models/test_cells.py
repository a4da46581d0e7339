import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.errors import DataError, UsageError
from brainbench.models.cells import CELLS, GRU, LSTM, UGRNN, IntersectionRNN, TimeDecay

GATED = [UGRNN, IntersectionRNN, GRU, LSTM]
VARIANTS = [(cell, layer_norm) for cell in (TimeDecay, *GATED) for layer_norm in (False, True)]


def _unroll(cell, xs):
    state, outputs = None, []
    for x in xs:
        y, state = cell(x, state)
        outputs.append(y)
    return torch.stack(outputs), state


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ("UGRNNCell", UGRNN(3, 3, kernel_size=2)),
        ("IntersectionRNNCell_ln", IntersectionRNN(3, 3, kernel_size=(2, 2), layer_norm=True)),
    ],
)
def test_a_cell_equals_pytorchtnn(reference, name, cell):
    with np.load(reference / "tnn" / "cells.npz") as stored:
        data = dict(stored)
    prefix = f"{name}/w/"
    cell.load_tnn_state({key.removeprefix(prefix): data[key] for key in data if key.startswith(prefix)})
    with torch.no_grad():
        outputs, state = _unroll(cell, torch.from_numpy(data[f"{name}/x"]))
    np.testing.assert_allclose(outputs, data[f"{name}/y"], atol=1e-5)
    np.testing.assert_allclose(state, data[f"{name}/final_state"], atol=1e-5)


def _one_place(convolution):
    """A 1×1 convolution's weight as a matrix [out, in]."""
    return convolution.weight[:, :, 0, 0]


def test_lstm_equals_pytorchs_cell_at_one_place():
    channels = 4
    cell, other = LSTM(channels, channels, kernel_size=1), torch.nn.LSTMCell(channels, channels)
    # PyTorch orders the gates i, f, g, o; ours are i, j, f, o with a fixed +1 on f.
    with torch.no_grad():
        rows = {gate: slice(index * channels, (index + 1) * channels) for index, gate in enumerate("ijfo")}
        mine, bias = _one_place(cell.conv), cell.conv.bias.uniform_(-1, 1)
        for index, gate in enumerate("ifjo"):
            target = slice(index * channels, (index + 1) * channels)
            other.weight_ih[target] = mine[rows[gate], :channels]
            other.weight_hh[target] = mine[rows[gate], channels:]
            other.bias_ih[target] = bias[rows[gate]] + (1.0 if gate == "f" else 0.0)
            other.bias_hh[target] = 0.0
        xs = torch.randn(6, 3, channels)
        outputs, state = _unroll(cell, xs[..., None, None])
        hidden = memory = torch.zeros(3, channels)
        for t, x in enumerate(xs):
            hidden, memory = other(x, (hidden, memory))
            torch.testing.assert_close(outputs[t, :, :, 0, 0], hidden, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(state[:, :, 0, 0], torch.cat((memory, hidden), 1), atol=1e-6, rtol=1e-5)


def test_gru_equals_pytorchs_cell_where_the_two_forms_coincide():
    # PyTorch resets after the recurrent product, we before it; with a diagonal recurrent matrix both agree.
    channels = 4
    cell, other = GRU(channels, channels, kernel_size=1), torch.nn.GRUCell(channels, channels)
    with torch.no_grad():
        cell.candidate.weight[:, channels:, 0, 0] = torch.diag(torch.randn(channels))
        gates, candidate = _one_place(cell.conv), _one_place(cell.candidate)
        other.weight_ih[:] = torch.cat((gates[:, :channels], candidate[:, :channels]))
        other.weight_hh[:] = torch.cat((gates[:, channels:], candidate[:, channels:]))
        other.bias_ih[:] = torch.cat((cell.conv.bias, cell.candidate.bias.uniform_(-1, 1)))
        other.bias_ih[:channels] += 1.0
        other.bias_hh[:] = 0.0
        xs = torch.randn(6, 3, channels)
        outputs, _ = _unroll(cell, xs[..., None, None])
        hidden = torch.zeros(3, channels)
        for t, x in enumerate(xs):
            hidden = other(x, hidden)
            torch.testing.assert_close(outputs[t, :, :, 0, 0], hidden, atol=1e-6, rtol=1e-5)


def _normalised(values, norm):
    """LayerNorm over channels written out."""
    mean, var = values.mean(1, keepdim=True), values.var(1, keepdim=True, unbiased=False)
    shape = (1, -1, 1, 1)
    return (values - mean) / torch.sqrt(var + 1e-5) * norm.weight.view(shape) + norm.bias.view(shape)


def _plain_step(cell, x, s):
    """One step of a gated cell, from the equations of Collins 2017, Cho 2014 and Gers 2000."""

    def gate(convolution, inputs, names):
        padded = torch.nn.functional.pad(inputs, (0, 1, 0, 1))
        parts = torch.nn.functional.conv2d(padded, convolution.weight, convolution.bias).chunk(len(names), 1)
        return [_normalised(part, cell.norms[name]) for part, name in zip(parts, names, strict=True)]

    if isinstance(cell, UGRNN):
        g, c = gate(cell.conv, torch.cat((x, s), 1), ("g", "c"))
        s = torch.sigmoid(g + 1) * s + (1 - torch.sigmoid(g + 1)) * torch.tanh(c)
        return s, s
    if isinstance(cell, IntersectionRNN):
        gh, h, gy, y = gate(cell.conv, torch.cat((x, s), 1), ("gh", "h", "gy", "y"))
        through, keep = torch.sigmoid(gy + 1), torch.sigmoid(gh + 1)
        return through * x + (1 - through) * torch.relu(y), keep * s + (1 - keep) * torch.tanh(h)
    if isinstance(cell, GRU):
        r, u = gate(cell.conv, torch.cat((x, s), 1), ("r", "u"))
        (c,) = gate(cell.candidate, torch.cat((x, torch.sigmoid(r + 1) * s), 1), ("c",))
        s = torch.sigmoid(u) * s + (1 - torch.sigmoid(u)) * torch.tanh(c)
        return s, s
    c, h = s.chunk(2, 1)
    i, j, f, o = gate(cell.conv, torch.cat((x, h), 1), ("i", "j", "f", "o"))
    c = _normalised(c * torch.sigmoid(f + 1) + torch.sigmoid(i) * torch.tanh(j), cell.norms["c"])
    h = torch.tanh(c) * torch.sigmoid(o)
    return h, torch.cat((c, h), 1)


@pytest.mark.parametrize("kind", GATED)
def test_a_normalised_cell_follows_its_equations(kind):
    cell = kind(3, 3, kernel_size=2, layer_norm=True)
    with torch.no_grad():
        for parameter in cell.parameters():
            parameter.uniform_(-1, 1)
        state = expected = cell.initial_state(2, 4, 6)
        for x in torch.randn(5, 2, 3, 4, 6):
            y, state = cell(x, state)
            wanted, expected = _plain_step(cell, x, expected)
            torch.testing.assert_close(y, wanted, atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(state, expected, atol=1e-5, rtol=1e-4)


@settings(max_examples=25)
@given(tau=st.floats(-1.5, 1.5), steps=st.integers(1, 8))
def test_time_decay_is_a_geometric_sum_of_its_inputs(tau, steps):
    cell = TimeDecay(2, 2, tau=tau)
    xs = torch.ones(steps, 1, 2, 3, 3)
    outputs, _ = _unroll(cell, xs)
    expected = sum(tau**lag for lag in range(steps))
    torch.testing.assert_close(outputs[-1].detach(), torch.full((1, 2, 3, 3), float(expected)), atol=1e-4, rtol=1e-4)


def test_a_normalised_time_decay_shows_its_trace_but_keeps_it_whole():
    cell, plain = TimeDecay(4, 4, layer_norm=True, tau=0.5), TimeDecay(4, 4, tau=0.5)
    xs = torch.randn(5, 2, 4, 3, 3)
    outputs, state = _unroll(cell, xs)
    traces, trace = _unroll(plain, xs)
    torch.testing.assert_close(state, trace)
    expected = torch.nn.functional.layer_norm(traces[-1].permute(0, 2, 3, 1), (4,)).permute(0, 3, 1, 2)
    torch.testing.assert_close(outputs[-1], expected)


def test_time_decay_starts_without_memory():
    x = torch.randn(1, 2, 3, 3)
    y, _ = TimeDecay(2, 2)(x, torch.randn(1, 2, 3, 3))
    torch.testing.assert_close(y, x)


@pytest.mark.parametrize("kind", [UGRNN, GRU])
@settings(max_examples=15)
@given(scale=st.floats(0.0, 1e4))
def test_a_convex_gate_never_leaves_the_range_of_tanh(kind, scale):
    cell = kind(2, 2, kernel_size=2)
    with torch.no_grad():
        outputs, _ = _unroll(cell, scale * torch.randn(6, 1, 2, 3, 3))
    assert outputs.abs().max() <= 1.0


@pytest.mark.parametrize(("kind", "layer_norm"), VARIANTS)
def test_no_state_means_the_zero_state(kind, layer_norm):
    cell = kind(3, 3, kernel_size=2, layer_norm=layer_norm)
    x = torch.randn(2, 3, 4, 6)
    for got, expected in zip(cell(x, None), cell(x, cell.initial_state(2, 4, 6)), strict=True):
        torch.testing.assert_close(got, expected)


@pytest.mark.parametrize(("kind", "layer_norm"), VARIANTS)
def test_parameters_survive_pytorchtnns_names(kind, layer_norm):
    source, target = (kind(3, 3, kernel_size=2, layer_norm=layer_norm) for _ in range(2))
    with torch.no_grad():
        for parameter in source.parameters():
            parameter.normal_()
    target.load_tnn_state({name: value.detach().numpy() for name, value in source.tnn_parameters().items()})
    for got, expected in zip(target.parameters(), source.parameters(), strict=True):
        assert torch.equal(got, expected)


def test_gated_cells_may_change_the_number_of_channels():
    for kind in (UGRNN, GRU, LSTM):
        y, state = kind(3, 5, kernel_size=2)(torch.randn(2, 3, 4, 6))
        assert y.shape == (2, 5, 4, 6)
        assert state.shape == (2, 10 if kind is LSTM else 5, 4, 6)


def test_wrong_parameters_are_named():
    cell = UGRNN(3, 3, kernel_size=2)
    with pytest.raises(DataError, match=r"'conv.bias'.*'conv.bais' → 'conv.bias'"):
        cell.load_tnn_state({"conv.weight": torch.zeros(6, 6, 2, 2), "conv.bais": torch.zeros(6)})
    with pytest.raises(DataError, match=r"'conv.weight' .*\[6, 6, 3, 3\].*\[6, 6, 2, 2\]"):
        cell.load_tnn_state({"conv.weight": torch.zeros(6, 6, 3, 3), "conv.bias": torch.zeros(6)})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: TimeDecay(3, 4),
            "same channels; received 3 in and 4 out",
        ),
        (lambda: IntersectionRNN(3, 4, kernel_size=2), "same channels; received 3 in and 4 out"),
        (lambda: UGRNN(0, 3, kernel_size=2), "channels of UGRNN must be a whole number, at least 1; received 0"),
        (lambda: UGRNN(3, 3, kernel_size=2)(torch.zeros(1, 4, 5, 7)), r"expects \[batch, 3, rows, columns\]"),
        (
            lambda: LSTM(3, 3, kernel_size=2)(torch.zeros(1, 3, 5, 7), torch.zeros(1, 3, 5, 7)),
            r"expects a state of shape \[1, 6, 5, 7\]; received \[1, 3, 5, 7\]",
        ),
    ],
)
def test_misuse_is_answered_in_one_sentence(make, message):
    with pytest.raises(UsageError, match=message):
        make()


def test_every_cell_has_a_name():
    assert {name: cell.__name__ for name, cell in CELLS.items()} == {
        "time-decay": "TimeDecay",
        "ugrnn": "UGRNN",
        "intersection": "IntersectionRNN",
        "gru": "GRU",
        "lstm": "LSTM",
    }
