import logging
import re
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.models.activations import extract
from brainbench.models.registry import load_model

K, T = 5, 4


@pytest.fixture
def stimuli():
    scale = np.array(([1e-4] * 3 + [1e-6] * 3) * 5)[:, None, None]
    return (np.random.default_rng(0).standard_normal((K, T, 30, 5, 7)) * scale).astype(np.float32)


class Recurrent(nn.Module):
    """What a user writes: a cell in a loop, a normalisation, dropout and a head."""

    def __init__(self):
        super().__init__()
        self.flatten = nn.Flatten(2)
        self.norm = nn.BatchNorm1d(1050)
        self.cell = nn.GRUCell(1050, 6)
        self.drop = nn.Dropout(0.5)
        self.head = nn.Linear(6, 3)

    def forward(self, x):
        x = self.norm(self.flatten(x).transpose(1, 2)).transpose(1, 2)
        state = x.new_zeros(len(x), 6)
        for t in range(x.shape[1]):
            state = self.cell(x[:, t], state)
        return self.head(self.drop(state))


def test_every_layer_of_ours_comes_with_its_time_steps(stimuli):
    model = load_model("zhuang-ugrnn-small+gpt")
    activations = extract(model, stimuli)
    assert tuple(activations) == model.layers
    with torch.no_grad():
        expected = model.activations(torch.from_numpy(stimuli))
    for layer, values in activations.items():
        assert values.dtype == np.float32
        np.testing.assert_allclose(values, expected[layer].flatten(2), atol=1e-5, rtol=1e-4)
    assert activations.nonfinite == {}


def test_layers_can_be_chosen_and_unknown_ones_name_the_nearest(stimuli):
    model = load_model("zhuang-small")
    assert list(extract(model, stimuli, layers=["decoder", "encoder.fc7"])) == ["encoder.fc7", "decoder"]
    with pytest.raises(UsageError, match=r"'fc7'.*'encoder\.fc7'"):
        extract(model, stimuli, layers=["fc7"])


@settings(max_examples=10)
@given(chunk=st.integers(1, 9))
def test_the_chunk_changes_nothing(chunk):
    x = torch.from_numpy(np.random.default_rng(1).standard_normal((7, T, 30, 5, 7)).astype(np.float32))
    model = Recurrent().eval()
    whole, parts = extract(model, x, chunk=100), extract(model, x, chunk=chunk)
    assert {name: value.shape for name, value in whole.items()} == {name: v.shape for name, v in parts.items()}
    for name, value in whole.items():
        np.testing.assert_allclose(parts[name], value, atol=1e-5, rtol=1e-4)


def test_a_loops_calls_become_time(stimuli):
    model = Recurrent()
    activations = extract(model, stimuli)
    assert {name: value.shape for name, value in activations.items()} == {
        "flatten": (K, T, 1050),
        "norm": (K, 1, 1050 * T),
        "cell": (K, T, 6),
        "drop": (K, 1, 6),
        "head": (K, 1, 3),
        "output": (K, 1, 3),
    }
    np.testing.assert_array_equal(activations["cell"][:, -1], activations["drop"][:, 0])


def test_the_model_is_left_as_it_was(stimuli):
    model = Recurrent().train()
    model.norm.eval()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    first, second = extract(model, stimuli), extract(model, stimuli)
    np.testing.assert_array_equal(first["output"], second["output"])
    assert model.training
    assert model.drop.training
    assert not model.norm.training
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())
    assert not any(module._forward_hooks for module in model.modules())


def test_an_error_leaves_no_hook_and_no_mode_behind(stimuli):
    model = Recurrent().train()
    with pytest.raises(UsageError):
        extract(model, stimuli[:, :, :6])
    assert not any(module._forward_hooks for module in model.modules())
    assert all(module.training for module in model.modules())


class Sequence(nn.Module):
    """An LSTM over the whole sweep, batch or time first; its output is a tuple."""

    def __init__(self, batch_first):
        super().__init__()
        self.batch_first = batch_first
        self.lstm = nn.LSTM(1050, 8, batch_first=batch_first)
        self.each = nn.Linear(8, 2)

    def forward(self, x):
        x = x.flatten(2)
        y, _ = self.lstm(x if self.batch_first else x.transpose(0, 1))
        y = y if self.batch_first else y.transpose(0, 1)
        return {"each": self.each(y.reshape(-1, 8)), "none": None}


@pytest.mark.parametrize("count", [1, T - 1, T, T + 1, 2 * T])
def test_time_is_found_wherever_it_is(count):
    x = torch.randn(count, T, 30, 5, 7)
    first, second = Sequence(True), Sequence(False)
    second.load_state_dict(first.state_dict())
    ours, theirs = extract(first, x), extract(second, x)
    assert {name: value.shape[:2] for name, value in ours.items()} == dict.fromkeys(
        ("lstm", "each", "output"), (count, T)
    )
    for name, value in ours.items():
        np.testing.assert_allclose(theirs[name], value, atol=1e-6, rtol=1e-5)
    with torch.no_grad():
        expected = first.lstm(x.flatten(2))[0]
    np.testing.assert_allclose(ours["lstm"], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("count", [1, 2, T, 7])
@pytest.mark.parametrize("blank", [0, 4])
def test_rows_of_all_steps_of_all_stimuli_are_told_from_rows_of_all_stimuli_of_all_steps(count, blank):
    class Joined(nn.Module):
        def __init__(self, time_first):
            super().__init__()
            self.time_first, self.wide, self.drop = time_first, nn.Linear(1050, 9), nn.Identity()

        def forward(self, x):
            rows = (x.transpose(0, 1) if self.time_first else x).flatten(2).flatten(0, 1)
            return self.drop(self.wide(rows)[: len(x)])

    x = torch.randn(count, T, 30, 5, 7)
    x[:blank] = 0  # alike in every step, they do not tell the order
    ours, theirs = Joined(False), Joined(True)
    theirs.load_state_dict(ours.state_dict())
    with torch.no_grad():
        expected = ours.wide(x.flatten(2))
    for model in (ours, theirs):
        np.testing.assert_allclose(extract(model, x, layers=["wide"], chunk=3)["wide"], expected, atol=1e-5)


def test_a_layer_of_one_number_has_one_feature(stimuli):
    class Sums(nn.Module):
        def __init__(self):
            super().__init__()
            self.steps, self.each, self.all = nn.Identity(), nn.Identity(), nn.Identity()

        def forward(self, x):
            joined = self.steps(x.flatten(2).flatten(0, 1).sum(1)).unflatten(0, x.shape[:2])
            return self.all(torch.stack([self.each(joined[:, t]) for t in range(x.shape[1])], 1).sum(1))

    found = extract(Sums(), stimuli)
    sums = stimuli.reshape(K, T, -1).sum(axis=2)
    for name, expected in (("steps", sums), ("each", sums), ("all", sums.sum(axis=1, keepdims=True))):
        np.testing.assert_allclose(found[name], expected[..., None], rtol=1e-3, atol=1e-6)


def test_complex_activations_keep_both_parts(stimuli):
    class Phases(nn.Module):
        def forward(self, x):
            return torch.fft.fft(x.flatten(2), dim=1)

    found = extract(Phases(), stimuli)["output"]
    expected = np.fft.fft(stimuli.reshape(K, T, -1), axis=1)
    np.testing.assert_allclose(found[..., ::2] + 1j * found[..., 1::2], expected, atol=1e-8)


def test_calls_of_unequal_shape_are_kept_apart(stimuli):
    class Shared(nn.Module):
        def __init__(self):
            super().__init__()
            self.wide, self.narrow, self.relu = nn.Linear(1050, 9), nn.Linear(9, 4), nn.ReLU(inplace=True)

        def forward(self, x):
            return self.relu(self.narrow(self.relu(self.wide(x.flatten(2)))))

    activations = extract(Shared(), stimuli)
    assert activations["relu[0]"].shape == (K, T, 9)
    assert activations["relu[1]"].shape == (K, T, 4)
    assert activations["wide"].min() < 0, "an in-place rectifier must not change what was recorded before it"


def test_submodules_can_be_asked_for_by_name(stimuli):
    model = nn.Sequential(nn.Flatten(2), nn.Sequential(nn.Linear(1050, 4), nn.ReLU()))
    assert list(extract(model, stimuli)) == ["0", "1.0", "1.1", "output"]
    chosen = extract(model, stimuli, layers=["1"])
    np.testing.assert_array_equal(chosen["1"], extract(model, stimuli)["1.1"])
    with pytest.raises(UsageError, match=r"'1\.2'; did you mean '1"):
        extract(model, stimuli, layers=["1.2"])


def test_a_layer_that_knows_no_stimuli_is_an_error_only_when_asked_for(stimuli):
    class Biased(nn.Module):
        def __init__(self):
            super().__init__()
            self.bias, self.head, self.unused = nn.Embedding(7, 3), nn.Linear(1050, 3), nn.Linear(1, 1)

        def forward(self, x):
            return self.head(x.flatten(2)) + self.bias(torch.tensor([1]))

    assert list(extract(Biased(), stimuli)) == ["head", "output"]
    with pytest.raises(UsageError, match=r"'bias' .*\[\[1, 3\]\]"):
        extract(Biased(), stimuli, layers=["bias"])
    with pytest.raises(UsageError, match=r"'unused' .*nothing"):
        extract(Biased(), stimuli, layers=["unused"])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_kept_and_counted(stimuli, value, caplog):
    model = nn.Sequential(nn.Flatten(2), nn.Linear(1050, 3))
    model[1].bias.data[1] = value
    with caplog.at_level(logging.WARNING):
        activations = extract(model, stimuli)
    assert not np.isfinite(activations["output"][..., 1]).any()
    assert activations.nonfinite == {"1": K * T, "output": K * T}
    assert re.search(f"{K * T} of {3 * K * T} .*'1'", caplog.text)


@pytest.mark.parametrize(
    "wrap", [np.asarray, torch.from_numpy, lambda x: SimpleNamespace(input=x), lambda x: x.astype("f8")]
)
def test_stimuli_come_as_array_tensor_or_object(stimuli, wrap):
    model = nn.Flatten(2)
    np.testing.assert_array_equal(extract(model, wrap(stimuli))["output"], stimuli.reshape(K, T, -1))


def test_a_model_of_another_precision_is_fed_in_it(stimuli):
    model = nn.Sequential(nn.Flatten(2), nn.Linear(1050, 3)).double()
    assert extract(model, stimuli)["output"].dtype == np.float32


@pytest.mark.parametrize(
    ("model", "failure"),
    [
        (
            lambda: load_model("zhuang-small"),
            r"EncoderAttenderDecoder .* expects \[batch, time, 30, 5, 7\] .*; received \[5, 4, 6, 5, 7\]",
        ),
        (Recurrent, "Recurrent .* RuntimeError: running_mean"),
        (lambda: nn.Sequential(nn.Flatten(), nn.Linear(7, 1)), "Sequential .* RuntimeError: mat1 and mat2"),
    ],
)
def test_a_stimulus_that_does_not_fit_says_what_was_given_and_what_failed(stimuli, model, failure):
    with pytest.raises(UsageError, match=failure) as caught:
        extract(model(), stimuli[:, :, :6])
    assert "[5, 4, 6, 5, 7] [stimulus, time, channel, row, column]" in str(caught.value)


@pytest.mark.parametrize(
    ("x", "chunk", "told"),
    [
        (np.zeros((0, T, 30, 5, 7)), 4, "[0, 4, 30, 5, 7]"),
        (np.zeros(3), 4, "[3]"),
        (np.zeros((2, T, 3)), 0, "received 0"),
        (np.zeros((2, T, 3)), 1.5, "received 1.5"),
        (np.zeros((2, T, 3), complex), 4, "complex128"),
        ([["a", "b"]], 4, "<U1"),
    ],
)
def test_nothing_to_extract_from_is_an_error(x, chunk, told):
    with pytest.raises(UsageError, match=re.escape(told)):
        extract(nn.Flatten(2), x, chunk=chunk)


def test_a_model_that_forgets_its_stimuli_says_what_to_return(stimuli):
    class Mean(nn.Module):
        def forward(self, x):
            return x.mean()

    with pytest.raises(UsageError, match=r"Nothing in Mean .*\[B, \.\.\.\]"):
        extract(Mean(), stimuli)


def test_a_sweep_too_long_for_the_attender_says_so(stimuli):
    with pytest.raises(UsageError, match="at most 32 steps"):
        extract(load_model("zhuang-small+gpt"), np.zeros((1, 33, 30, 5, 7), np.float32))


def test_activations_and_stimuli_may_lie_on_disk(stimuli, tmp_path):
    model = load_model("zhuang-small", classes=5)
    np.save(tmp_path / "stimuli.npy", np.asarray(stimuli))
    mapped = np.load(tmp_path / "stimuli.npy", mmap_mode="r")
    found = extract(model, mapped, chunk=2, folder=tmp_path / "layers")
    assert all(isinstance(value, np.memmap) for value in found.values())
    for name, expected in extract(model, stimuli).items():
        np.testing.assert_allclose(np.load(tmp_path / "layers" / f"{name}.npy"), expected, rtol=1e-4, atol=1e-6)


def test_on_disk_memory_stays_that_of_a_chunk(tmp_path):
    count, features = 400, 10_000
    stimuli = np.lib.format.open_memmap(tmp_path / "x.npy", mode="w+", dtype=np.float32, shape=(count, 2, 6, 1, 1))
    model = nn.Sequential(nn.Flatten(2), nn.Linear(6, features))
    peaks = []
    for folder in (None, tmp_path / "layers"):
        tracemalloc.start()
        found = extract(model, stimuli, layers=["1"], chunk=8, folder=folder)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert found["1"].nbytes == count * 2 * features * 4  # 32 MB
    assert peaks[0] > found["1"].nbytes > 8 * peaks[1]


class _Unsteady(nn.Module):
    def __init__(self, kind):
        super().__init__()
        self.kind, self.linear, self.state = kind, nn.Linear(6 * 35, 8), 0.0

    def forward(self, x):
        y = self.linear(x.flatten(2))
        if self.kind == "dropout":
            return functional.dropout(y, 0.1)
        if self.kind == "batch norm":
            return functional.batch_norm(y.flatten(1), None, None, training=True)
        self.state = self.state + y.mean().detach()
        return y + self.state


@pytest.mark.parametrize("kind", ["dropout", "batch norm", "state"])
def test_a_model_that_answers_otherwise_when_it_is_run_again_is_refused(kind):
    x = torch.randn(21, 4, 6, 5, 7, generator=torch.Generator().manual_seed(0))
    with pytest.raises(UsageError, match="_Unsteady answers the same stimuli otherwise"):
        extract(_Unsteady(kind), x)


@pytest.mark.parametrize("join", [False, True])
def test_a_part_in_two_places_gives_time_in_each(join):
    class Shared(nn.Module):
        def __init__(self):
            super().__init__()
            self.one, self.two, self.act = nn.Linear(210, 8), nn.Linear(8, 8), nn.ReLU()

        def forward(self, x):
            y = x.flatten(0, 1).flatten(1) if join else x.flatten(2)
            return self.act(self.two(self.act(self.one(y)))).reshape(*x.shape[:2], -1)

    found = extract(Shared(), torch.randn(5, 4, 6, 5, 7))
    assert {name: values.shape for name, values in found.items()} == {
        name: (5, 4, 8) for name in ("one", "two", "act[0]", "act[1]", "output")
    }
    np.testing.assert_array_equal(found["act[1]"], found["output"])
