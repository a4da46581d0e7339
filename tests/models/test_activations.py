import gc
import logging
import re
import tracemalloc
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional

from brainbench.core.errors import UsageError
from brainbench.models.activations import extract
from brainbench.models.proof import is_ours, named_layers
from brainbench.models.registry import load_model

K, T = 5, 4


@pytest.fixture
def stimuli():
    scale = np.array(([1e-4] * 3 + [1e-6] * 3) * 5)[:, None, None]
    return (np.random.default_rng(0).standard_normal((K, T, 30, 5, 7)) * scale).astype(np.float32)


class Listed(nn.Module):
    """A loop over time that returns its steps, in a list or as one tensor."""

    def __init__(self, whole):
        super().__init__()
        self.whole, self.linear = whole, nn.Linear(1050, 6)

    def forward(self, x):
        steps = [torch.tanh(self.linear(x[:, step].flatten(1))) for step in range(x.shape[1])]
        return torch.stack(steps, dim=1) if self.whole else steps


def test_a_list_of_steps_is_the_layer_with_its_time_axis(stimuli):
    torch.manual_seed(0)
    listed, whole = Listed(whole=False), Listed(whole=True)
    whole.load_state_dict(listed.state_dict())
    values, expected = (extract(model, stimuli * 1e4)["output"] for model in (listed, whole))
    assert values.shape == (K, T, 6)
    np.testing.assert_array_equal(values, expected)


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
        "norm": (K, T, 1050),
        "cell": (K, T, 6),
        "drop": (K, 1, 6),
        "head": (K, 1, 3),
        "output": (K, 1, 3),
    }
    np.testing.assert_array_equal(activations["cell"][:, -1], activations["drop"][:, 0])


class _Making(nn.Module):
    """A network that makes its first state without saying of what precision or where."""

    def __init__(self) -> None:
        super().__init__()
        self.read, self.cell = nn.Linear(30 * 35, 12), nn.GRUCell(12, 8)

    def forward(self, x):
        state, states = torch.zeros(len(x), 8), []
        for step in x.unbind(1):
            state = self.cell(self.read(step.flatten(1)), state)
            states.append(state)
        return torch.stack(states, 1)


@contextmanager
def _default_precision(kind: torch.dtype) -> Iterator[None]:
    torch.set_default_dtype(kind)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("ours", [True, False])
@pytest.mark.parametrize(
    "program",
    [
        lambda: torch.autocast("cpu", torch.bfloat16),
        torch.inference_mode,
        lambda: torch.device("meta"),
        lambda: _default_precision(torch.float64),
    ],
    ids=["autocast", "inference", "device", "precision"],
)
def test_the_program_around_a_reading_has_no_part_in_it(stimuli, program, ours):
    torch.manual_seed(0)
    model = load_model("zhuang-small", seed=0) if ours else _Making()
    before = extract(model, stimuli)
    with program():
        place = torch.get_default_device(), torch.get_default_dtype(), torch.is_inference_mode_enabled()
        within = extract(model, stimuli)
        assert place == (torch.get_default_device(), torch.get_default_dtype(), torch.is_inference_mode_enabled())
    assert list(within) == list(before)
    for layer, values in before.items():
        np.testing.assert_array_equal(within[layer], values)


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

    spectra = extract(Phases(), stimuli)["output"]
    expected = np.fft.fft(stimuli.reshape(K, T, -1), axis=1)
    assert spectra.shape == (K, 1, expected[0].size * 2), "frequencies are no time steps"
    np.testing.assert_allclose(spectra[:, 0, ::2] + 1j * spectra[:, 0, 1::2], expected.reshape(K, -1), atol=1e-8)


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
    with pytest.raises(UsageError, match=r"'bias' .* cannot be read: does not move with the stimuli"):
        extract(Biased(), stimuli, layers=["bias"])
    with pytest.raises(UsageError, match=r"'unused' .* gave nothing: it did not run"):
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


def test_the_report_names_what_was_not_read(stimuli):
    class Tabled(nn.Module):
        def __init__(self):
            super().__init__()
            self.read, self.table, self.unused = nn.Linear(1050, 4), nn.Embedding(K, 4), nn.Linear(1, 1)

        def forward(self, x):
            return self.read(x.flatten(2)).mean(1) @ self.table(torch.arange(K)).T

    report = extract(Tabled(), stimuli).report
    assert str(report) == "2 of 3 called modules read; not read: table (does not move with the stimuli)"
    assert (report.called, report.read, dict(report.not_read)) == (3, 2, {"table": "does not move with the stimuli"})
    assert type(report).of(report.stated) == report


class InPlace(nn.Module):
    def __init__(self):
        super().__init__()
        self.act, self.read = nn.ReLU(inplace=True), nn.Linear(1050, 3)

    def forward(self, x):
        return self.read(self.act(x.mul_(2)).flatten(2))


@pytest.mark.parametrize("wrap", [np.array, torch.tensor])
def test_a_model_that_works_in_place_changes_no_stimuli_and_is_named_so(stimuli, wrap):
    values = wrap(stimuli)
    layers = extract(InPlace(), values)
    np.testing.assert_array_equal(values, stimuli)
    np.testing.assert_allclose(layers["act"], np.maximum(2 * stimuli.reshape(K, T, -1), 0))
    assert "the model changes its input in place, and was given copies" in str(layers.report)
    assert layers.report.notes == extract(InPlace(), values, chunk=2).report.notes
    assert not extract(nn.Flatten(2), values).report.notes


def test_a_memory_map_is_never_written(stimuli, tmp_path):
    np.save(tmp_path / "stimuli.npy", stimuli)
    before = (tmp_path / "stimuli.npy").read_bytes()
    for mode in ("r+", "r", "c"):
        mapped = np.load(tmp_path / "stimuli.npy", mmap_mode=mode)
        extract(InPlace(), mapped)
        np.testing.assert_array_equal(mapped, stimuli)
    assert (tmp_path / "stimuli.npy").read_bytes() == before


class _Calibrated(nn.Module):
    """Sets its scale to the first batch that it sees, in a buffer, a weight or an attribute."""

    def __init__(self, kind):
        super().__init__()
        self.kind, self.read, self.scale = kind, nn.Linear(1050, 6), nn.Parameter(torch.zeros(6))
        self.register_buffer("ready", torch.zeros(()))
        self.first = None

    def forward(self, x):
        y = self.read(x.flatten(2))
        fresh = {"buffer": self.ready == 0, "weight": not self.scale.any(), "attribute": self.first is None}[self.kind]
        if fresh:
            self.scale.data.copy_(1 / y.flatten(0, 1).std(0))
            self.first = self.ready.fill_(1)
        return y * self.scale


@pytest.mark.parametrize("kind", ["buffer", "weight", "attribute"])
def test_a_normaliser_that_calibrates_itself_on_its_first_batch_is_refused(kind):
    x = torch.randn(21, 4, 30, 5, 7, generator=torch.Generator().manual_seed(0))
    with pytest.raises(UsageError, match="_Calibrated answers the same stimuli otherwise"):
        extract(_Calibrated(kind), x)


def test_a_state_that_only_another_batch_size_resets_is_refused():
    class Leaky(nn.Module):
        def __init__(self):
            super().__init__()
            self.read, self.trace = nn.Linear(210, 6), torch.zeros(0, 6)

        def forward(self, x):
            self.trace = self.trace if len(self.trace) == len(x) else x.new_zeros(len(x), 6)
            for step in self.read(x.flatten(2)).unbind(1):
                self.trace = 0.95 * self.trace + step
            return self.trace

    with pytest.raises(UsageError, match="Leaky answers the same stimuli otherwise"):
        extract(Leaky(), torch.randn(32, 4, 6, 5, 7))


@pytest.mark.parametrize("named", [False, True])
def test_a_state_that_begins_in_a_later_batch_is_refused(named):
    class Warmed(nn.Module):
        def __init__(self):
            super().__init__()
            self.read, self.calls, self.layers = nn.Linear(210, 6), 0, ("read",) if named else None

        def forward(self, x):
            self.calls += 1
            return self.read(x.flatten(2)) + (self.calls > 2)

        def activations(self, x, layers):
            return {"read": self(x)}

    # Neither the copy, which is called twice or thrice, nor the stimuli of the sample tell: the third batch is of five.
    with pytest.raises(UsageError, match="Warmed answers the same stimuli otherwise"):
        extract(Warmed(), torch.randn(37, 4, 6, 5, 7))


def test_compiled_parts_and_models_are_read_as_written(stimuli):
    plain = nn.Sequential(nn.Flatten(2), nn.Sequential(nn.Linear(1050, 3), nn.ReLU()))
    expected = extract(plain, stimuli)
    whole = torch.compile(plain, backend="eager")
    inside = nn.Sequential(plain[0], torch.compile(plain[1], backend="eager"))
    with torch.no_grad():
        whole(torch.from_numpy(stimuli))
    for model in (whole, inside):
        layers = extract(model, stimuli)
        assert list(layers) == list(expected)
        assert all(np.array_equal(layers[name], values) for name, values in expected.items())


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_the_parts_of_a_scripted_model_are_named_as_not_readable(stimuli):
    plain = nn.Sequential(nn.Flatten(2), nn.Linear(1050, 3))
    layers = extract(torch.jit.script(plain), stimuli)
    np.testing.assert_allclose(layers["output"], extract(plain, stimuli)["output"], atol=1e-9)
    assert "TorchScript" in str(layers.report)


def test_sparse_and_quantised_tensors_give_their_numbers(stimuli):
    class Kinds(nn.Module):
        def __init__(self):
            super().__init__()
            self.sparse, self.quantised = nn.Identity(), nn.Identity()

        def forward(self, x):
            y = x.flatten(2).mean(1)
            self.sparse(y.to_sparse())
            return self.quantised(torch.quantize_per_tensor(y, 1e-7, 0, torch.qint32))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # PyTorch deprecates its quantised tensors
        layers = extract(Kinds(), stimuli)
    expected = stimuli.reshape(K, T, -1).mean(1, keepdims=True)
    np.testing.assert_allclose(layers["sparse"], expected, atol=1e-10)
    np.testing.assert_allclose(layers["quantised"], expected, atol=1e-7)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (nn.Sequential(nn.Flatten(2), nn.Linear(1050, 2, device="meta")), "never loaded.*1.weight"),
        (nn.Sequential(nn.Flatten(2), nn.LazyLinear(2)), "lazy layers.*1.weight"),
    ],
)
def test_weights_that_do_not_exist_are_told(stimuli, model, words):
    with pytest.raises(UsageError, match=words):
        extract(model, stimuli)


def test_layers_are_reduced_while_they_are_produced(stimuli):
    model = Recurrent().eval()
    whole = extract(model, stimuli)
    means = extract(model, stimuli, chunk=2, reduce=lambda rows: rows.mean(axis=1, keepdims=True))
    assert {name: values.shape[1] for name, values in means.items()} == dict.fromkeys(whole, 1)
    for name, values in whole.items():
        np.testing.assert_allclose(means[name][:, 0], values.mean(axis=1), rtol=1e-3, atol=1e-5)


def test_layers_beyond_the_memory_lie_in_files_that_go_with_them(stimuli):
    model = nn.Sequential(nn.Flatten(2), nn.Linear(1050, 500), nn.ReLU())
    whole = extract(model, stimuli)
    size = whole["1"].nbytes / 2**30
    layers = extract(model, stimuli, memory=1.5 * size)
    mapped = {name: values.filename for name, values in layers.items() if isinstance(values, np.memmap)}
    assert mapped
    assert len(mapped) < len(layers)
    for name, values in whole.items():
        np.testing.assert_allclose(layers[name], values, atol=1e-6)
    paths = [Path(name) for name in mapped.values()]
    assert all(path.is_file() for path in paths)
    del layers
    gc.collect()
    assert not any(path.exists() for path in paths)


def test_stimuli_run_once_beyond_the_proof():
    class Counted(nn.Module):
        rows = 0

        def forward(self, x):
            type(self).rows += len(x)
            return x.flatten(2)

    extract(Counted(), torch.randn(40, 4, 6, 5, 7))
    # The probes, the sample, and again two of it at the end.
    assert Counted.rows == 40 + 8 + 5 + 2


def test_a_model_of_one_batch_size_is_read_in_it():
    class Fixed(nn.Module):
        def __init__(self):
            super().__init__()
            self.read = nn.Linear(210, 3)

        def forward(self, x):
            return self.read(x.reshape(8, 4, 210))

    x = torch.randn(16, 4, 6, 5, 7)
    model = Fixed()
    with torch.no_grad():
        expected = model.read(x.flatten(2))
    np.testing.assert_allclose(extract(model, x, chunk=8)["read"], expected, atol=1e-5)


class _Named(nn.Module):
    layers: Any = ("first", "second")

    def __init__(self, answer):
        super().__init__()
        self.answer, self.read = answer, nn.Linear(210, 9)

    def forward(self, x):
        return self.read(x.flatten(2))

    def activations(self, x, layers):
        return self.answer(self(x))


def test_layers_that_a_model_of_others_names_are_proven_too():
    x = torch.randn(12, 4, 6, 5, 7)
    model = _Named(lambda y: {"first": y, "second": y.transpose(1, 2)})
    with torch.no_grad():
        expected = model(x).numpy()
    layers = extract(model, x)  # time is where it moves, not where it is said to be
    np.testing.assert_array_equal(layers["first"], expected)
    np.testing.assert_array_equal(layers["second"], expected)
    assert list(extract(model, x, layers=["second"])) == ["second"]
    mixes = _Named(lambda y: {"first": y, "second": y - y.mean(0)})
    with pytest.raises(UsageError, match=r"_Named answers the same stimuli otherwise .* \(layer 'second'\)"):
        extract(mixes, x)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (lambda y: {"first": y, "second": y.new_ones(len(y), 4, 9)}, "does not move with the stimuli"),
        (lambda y: {"first": y, "second": None}, "gives no tensor of numbers"),
        (lambda y: {"first": y}, "gives no tensor of numbers"),
    ],
)
def test_a_layer_that_a_model_of_others_names_and_that_is_none_is_left_out_with_its_reason(answer, reason):
    x = torch.randn(12, 4, 6, 5, 7)
    layers = extract(_Named(answer), x)
    assert list(layers) == ["first"]
    assert layers.report.not_read == {"second": reason}
    with pytest.raises(UsageError, match=f"Layer 'second' of _Named cannot be read: {reason}"):
        extract(_Named(answer), x, layers=["second"])


def test_a_model_of_others_that_names_layers_returns_a_mapping():
    with pytest.raises(UsageError, match="gives a mapping from layers to tensors; it gave a list"):
        extract(_Named(lambda y: [y, y]), torch.randn(12, 4, 6, 5, 7))


def test_a_list_of_modules_that_is_called_layers_names_none():
    class Stack(nn.Module):
        def __init__(self):
            super().__init__()
            self.layers, self.activations = nn.ModuleList([nn.Linear(210, 9)]), nn.ReLU()

        def forward(self, x):
            return self.activations(self.layers[0](x.flatten(2)))

    assert named_layers(Stack()) is None
    assert list(extract(Stack(), torch.randn(12, 4, 6, 5, 7))) == ["layers.0", "activations", "output"]


def test_a_network_of_ours_with_a_part_of_others_is_proven():
    class Counter(nn.Module):
        calls = 0

        def forward(self, x):
            self.calls += 1
            return x + self.calls

    model = load_model("zhuang-feedforward-small", classes=5)
    x = torch.randn(12, 6, 30, 5, 7) * 1e-4
    assert is_ours(model)
    before = extract(model, x)["decoder"]
    model.decoder = nn.Sequential(model.decoder, nn.Identity())
    np.testing.assert_array_equal(extract(model, x)["decoder"], before)
    model.decoder[1] = Counter()
    with pytest.raises(UsageError, match="EncoderAttenderDecoder answers the same stimuli otherwise"):
        extract(model, x)


def test_decisions_and_counts_are_numbers_too(stimuli):
    class Decided(nn.Module):
        def __init__(self):
            super().__init__()
            self.above, self.count = nn.Identity(), nn.Identity()

        def forward(self, x):
            return self.count(self.above(x.flatten(2) > 0).sum(2))

    layers = extract(Decided(), stimuli)
    above = stimuli.reshape(K, T, -1) > 0
    np.testing.assert_array_equal(layers["above"], above)
    np.testing.assert_array_equal(layers["count"], above.sum(2)[..., None])
