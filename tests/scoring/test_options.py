"""Every option of a score is on the command line, in the Python call and in the provenance."""

from dataclasses import fields, replace

import pytest
import typer.main

import brainbench
from brainbench.cli import app
from brainbench.cli.options import SCORE_FLAGS
from brainbench.core.errors import UsageError
from brainbench.core.files import to_plain
from brainbench.scoring import ScoreOptions
from brainbench.stimuli import Fidelity

NAMES = [item.name for item in fields(ScoreOptions)]
ELSEWHERE = {
    "recordings": "recordings",
    "match": "pairs",
    "by": "statistics",
    "explain": "statistics",
    "title": "recordings",
    "strict": "recordings",
    "memory": "",
    "plan": "plan",
    "benchmark": "benchmark",
}
"""Options whose effect stands in another entry of the provenance than its settings, or in none."""


@pytest.mark.parametrize("name", NAMES)
def test_an_option_is_a_flag_with_help_a_keyword_and_a_setting(name: str):
    command = typer.main.get_command(app).commands["score"]  # pyright: ignore[reportAttributeAccessIssue]
    variable = SCORE_FLAGS.get(name, (name,))[0].removeprefix("--").replace("-", "_")
    flag = next(item for item in command.params if item.name == variable)
    assert flag.help
    default = getattr(ScoreOptions(), name)
    assert flag.default == default
    assert ScoreOptions.of({name: default}) == ScoreOptions()
    assert name in ELSEWHERE or name in ScoreOptions().settings


def test_finished_stimuli_state_no_fidelity():
    stated = ScoreOptions(stimuli="set.h5").settings
    assert stated["fidelity"] is None
    # An earlier record stated one that did nothing.
    assert ScoreOptions.stated_in({**stated, "fidelity": "fast"}).fidelity == "balanced"
    assert ScoreOptions.stated_in({**stated, "stimuli": "objects", "fidelity": "fast"}).fidelity == "fast"
    with pytest.raises(UsageError, match="these stimuli are finished"):
        brainbench.score("zhuang-small", stimuli="set.h5", fidelity="fast")


def test_a_layer_is_named_once():
    with pytest.raises(UsageError, match="layers holds at least 1 value"):
        ScoreOptions.of({"layers": []})
    with pytest.raises(UsageError, match="'conv1' more than once"):
        ScoreOptions(layers=("conv1", "fc", "conv1"))


def test_a_wrong_keyword_is_answered_with_the_nearest():
    with pytest.raises(UsageError, match="did you mean 'metric'"):
        brainbench.score("zhuang-small", metrik="rsa")


def test_settings_of_a_record_give_the_options_again():
    options = ScoreOptions(layers=("conv1",), fidelity="fast", weights_seed=3, select="outcome=correct")
    assert ScoreOptions.stated_in({**options.settings, "estimator_version": 1, "layers": ["conv1"]}) == options


def test_the_published_readout_averages_time_itself():
    with pytest.raises(UsageError, match="did you mean 'published'"):
        ScoreOptions(readout="publishd")
    for other in ({"time": "concatenate"}, {"over_time": True}):
        with pytest.raises(UsageError, match="--time"):
            ScoreOptions(readout="published", **other)


@pytest.mark.parametrize(
    "fidelity", [Fidelity.preset("balanced"), replace(Fidelity.preset("fast"), links=9, twist=False)]
)
def test_a_fidelity_of_the_callers_own_comes_back_from_the_settings_of_a_record(fidelity: Fidelity):
    stated = to_plain(ScoreOptions(fidelity=fidelity).settings)
    assert Fidelity.of(ScoreOptions.stated_in(stated).fidelity) == fidelity


@pytest.mark.parametrize("wrong", ["fc", ("fc", 5), 5])
def test_layers_are_a_list_of_names(wrong):
    assert ScoreOptions(layers=["fc"]).layers == ("fc",)
    with pytest.raises(UsageError, match=r"layers holds values|layers must be a text"):
        ScoreOptions(layers=wrong)


@pytest.mark.slow
@pytest.mark.parametrize("option", [{"fidelity": "fast"}, {"whiskers": "C0-C3"}])
def test_a_simulation_cannot_be_chosen_for_features_computed_elsewhere(option):
    with pytest.raises(UsageError, match="computed elsewhere"):
        brainbench.score({"layer": [[1.0]]}, **option)
