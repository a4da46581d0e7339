"""What is taken as a model, and what it is shown."""

from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from torch import nn

import brainbench
from brainbench.core.errors import DataFileNotFoundError, UsageError
from brainbench.core.records import ModelCard
from brainbench.models.registry import load_model
from brainbench.scoring.model_responses import ModelResponses, contact_kinematics, resolve_model
from brainbench.scoring.options import ScoreOptions
from brainbench.stimuli import Frames, Scene, Stimuli, WhiskerArray, simulate

LABELS = ("a", "b", "c", "d", "e", "f")


class _Tiny(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.fc = nn.Linear(8, 5)

    def forward(self, x):
        return self.fc(x.flatten(2)).relu().mean(1)


@pytest.fixture
def arrays(tmp_path: Path) -> Path:
    import h5py

    path = tmp_path / "stimuli.h5"
    values = np.random.default_rng(2).normal(size=(6, 4, 2, 2, 2)).astype(np.float32)
    with h5py.File(path, "w") as file:
        file["stimuli"] = values
        file["labels"] = np.array(LABELS, dtype=h5py.string_dtype())
    return path


@pytest.mark.parametrize("normalize", [True, False])
def test_a_network_of_ours_inside_a_module_of_the_users_sees_si_values(normalize: bool):
    network, array = load_model("zhuang-small"), WhiskerArray.of("mouse").select("C2")
    stimuli = simulate([Scene("free", array)], fidelity="fast", cache=False)
    options = ScoreOptions(stimuli=stimuli, normalize=normalize, layers=("output",))
    card = resolve_model(nn.Sequential(network)).respond(options).card
    assert card.input == "SI (N, N·m); normalised inside the model"


def test_the_default_device_of_the_program_has_no_part_in_responses():
    network, array = load_model("zhuang-small"), WhiskerArray.of("mouse").select("C2")
    stimuli = simulate([Scene("free", array)], fidelity="fast", cache=False)
    options = ScoreOptions(stimuli=stimuli, layers=("output",))
    usual = resolve_model(nn.Sequential(network)).respond(options)
    with torch.device("meta"):
        responses = resolve_model(nn.Sequential(network)).respond(options)
    assert list(responses.activations) == list(usual.activations)
    for name, values in usual.activations.items():
        np.testing.assert_array_equal(responses.activations[name], values)


def test_a_module_with_any_spec_is_plain():
    class Spectrum(nn.Module):
        def __init__(self):
            super().__init__()
            self.spec = nn.Linear(1050, 3)

        def forward(self, x):
            return self.spec(x.flatten(2))

    stimuli = simulate([Scene("free", WhiskerArray.of("mouse").select("C2"))], fidelity="fast", cache=False)
    found = resolve_model(Spectrum()).respond(ScoreOptions(stimuli=stimuli))
    assert found.card.input == "forces in 1e-4 N, moments in 1e-6 N·m"


def test_a_module_in_half_precision_has_a_card():
    cards = [resolve_model(nn.Linear(3, 2).to(kind)).card for kind in (torch.bfloat16, torch.float16)]
    assert all(card.weights for card in cards)


@pytest.mark.parametrize(
    ("error", "words"),
    [(0.23, "estimated error of 23%"), (np.inf, "error that cannot be told"), (0.09, ""), (None, "")],
)
def test_a_score_tells_the_error_of_its_stimuli(error, words, recordings, arrays, monkeypatch):
    monkeypatch.setattr(Stimuli, "error", error)
    score = brainbench.score(_Tiny(), recordings=recordings, stimuli=str(arrays), layer="fc")
    reasons = [reason for reason in score.reasons if reason.startswith("the forces of the stimuli")]
    assert score.status == "ok"
    assert [words in reason for reason in reasons] == [True] * bool(words)


def test_a_model_whose_input_does_not_fit_says_what_it_was_given(recordings: xr.Dataset, arrays: Path):
    with pytest.raises(UsageError, match=r"cannot process stimuli of shape \[6, 4, 2, 2, 2\]"):
        brainbench.score(nn.Linear(3, 2), recordings=recordings, stimuli=str(arrays))


def test_a_lazy_layer_without_weights_is_named():
    with pytest.raises(
        UsageError, match=r"Sequential has lazy layers without weights yet \(1\.weight, 1\.bias\): run it"
    ):
        brainbench.score(nn.Sequential(nn.Flatten(), nn.LazyLinear(3)))


def test_a_prefix_of_trained_weights_is_never_code():
    with pytest.raises(DataFileNotFoundError, match=r"There is no config.json in 'mine\.py'"):
        resolve_model("local-dir:mine.py")


def test_other_things_are_no_models():
    with pytest.raises(UsageError, match="received int"):
        brainbench.score(3)
    with pytest.raises(UsageError, match="did you mean 'zhuang'"):
        brainbench.score("zhuagn")
    with pytest.raises(UsageError, match="Unknown time rule 'median'"):
        brainbench.score(_Tiny(), time="median")


@pytest.mark.parametrize(
    ("model", "frames", "told"),
    [
        ("resnet18-small.supervised", Frames(count=10), ""),
        ("resnet18-small.supervised", Frames(interval=1e-3, count=10), "200 time steps per second, there 22.22"),
        ("resnet18-small.supervised", Frames(count=10, axes="follicle"), "follicle axes, there world axes"),
        ("resnet18-small", Frames(interval=1e-3, count=10), ""),
    ],
)
def test_frames_unlike_those_of_the_training_are_told(model: str, frames: Frames, told: str, caplog):
    air = simulate(Scene("air", WhiskerArray.mouse(whiskers="C2"), frames=frames), fidelity="fast", cache=False)
    card = resolve_model(model).respond(ScoreOptions(stimuli=air)).card
    assert card.input == "SI (N, N·m); normalised inside the model" + f"; unlike its training: {told}" * bool(told)
    assert (told in caplog.text) if told else "was trained on" not in caplog.text


def test_contacts_are_their_beginning_duration_and_place():
    contact = np.zeros((2, 4, 2), dtype=bool)
    contact[0, 1:3, 0] = True
    arc = np.where(contact, 0.01, np.nan)
    first = np.array([[0.1, np.nan], [np.nan, np.nan]])
    over_time = ("stimulus", "time", "whisker")
    dataset = xr.Dataset(
        {"contact": (over_time, contact), "contact_arc": (over_time, arc), "first_contact": (over_time[::2], first)},
        coords={"time": [0.0, 0.1, 0.2, 0.3]},
    )
    kinematics = contact_kinematics(dataset)
    np.testing.assert_allclose(kinematics["first contact"], [[0.1, 0.3], [0.3, 0.3]])
    np.testing.assert_allclose(kinematics["contact duration"], [[0.5, 0], [0, 0]])
    np.testing.assert_allclose(kinematics["contact arc"], [[0.01, 0], [0, 0]])
    assert contact_kinematics(dataset.drop_vars("contact")) == contact_kinematics(None) == {}


@pytest.mark.parametrize(
    ("error", "promise", "advice"),
    [
        (0.27, None, "an estimated error of 27%, above 10%: simulate them with a finer --fidelity, or with"),
        (0.27, 0.5, "above 10%: take less than auto=0.5"),
        (0.27, 0.05, "above 10%: auto has no finer setting that helps"),
        (np.inf, None, "an error that cannot be told: simulate them"),
        (0.09, None, ""),
        (None, None, ""),
    ],
)
def test_stimuli_in_doubt_are_not_advised_to_try_what_they_were_made_with(error, promise, advice):
    card = ModelCard("features")
    responses = ModelResponses(card, (), {}, "mean", stimulus_error=error, stimulus_promise=promise)
    assert advice in "".join(responses.doubts)
    assert bool(responses.doubts) == bool(advice)
