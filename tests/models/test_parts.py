"""What parts of a network share: layers in turn, sweeps that fit, and the activations that were asked for."""

from __future__ import annotations

import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.parts import (
    AllStepsDecoder,
    check_sweep,
    make_decoder,
    run_layers,
    wanted,
)

LAYERS = (("twice", lambda x: 2 * x), ("less", lambda x: x - 1), ("square", lambda x: x**2))


@pytest.mark.parametrize(
    ("returned", "names"),
    [
        (True, ["twice", "less", "square"]),
        (False, []),
        ((), []),
        ({"less"}, ["less"]),
        (("square", "twice"), ["twice", "square"]),
    ],
)
def test_layers_run_in_turn_and_those_asked_for_are_returned(returned, names):
    answer, activities = run_layers(torch.tensor([3.0]), LAYERS, returned)
    assert answer.item() == 25
    assert list(activities) == names
    truth = {"twice": 6, "less": 5, "square": 25}
    assert {name: value.item() for name, value in activities.items()} == {name: truth[name] for name in names}


def test_all_none_or_the_named_layers_are_wanted():
    names = tuple(name for name, _ in LAYERS)
    assert wanted(names, True) == names
    assert not wanted(names, False)
    assert wanted(names, {"less"}) == {"less"}


@pytest.mark.parametrize("shape", [(2, 4, 6, 5, 7, 1), (4, 6, 5, 7), (2, 4, 6, 7, 5)])
def test_a_sweep_of_another_shape_is_told_with_both_shapes(shape):
    check_sweep(torch.zeros(2, 4, 6, 5, 7), (6, 5, 7), "The encoder")
    with pytest.raises(UsageError) as error:
        check_sweep(torch.zeros(shape), (6, 5, 7), "The encoder")
    assert "The encoder expects [batch, time, 6, 5, 7]" in str(error.value)
    assert str(list(shape)) in str(error.value)


@pytest.mark.parametrize(("name", "parameters"), [("linear", 60_021), ("mlp", 1_110_133)])
def test_parameters_equal_the_published_counts(name, parameters):
    decoder = make_decoder(name, 512)
    assert sum(parameter.numel() for parameter in decoder.parameters()) == parameters
    assert decoder(torch.randn(3, 7, 512)).shape == (3, 7, 117)


def test_the_number_of_classes_can_be_chosen():
    for name in ("linear", "mlp"):
        assert make_decoder(name, 8, 3)(torch.randn(2, 8)).shape == (2, 3)


def test_the_all_steps_decoder_has_the_published_size():
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in AllStepsDecoder(512).parameters()) == 12_120_181


@torch.no_grad()
def test_an_answer_of_all_steps_is_that_of_the_sweep_so_far():
    decoder, features = AllStepsDecoder(6, 3, steps=5), torch.randn(2, 5, 6)
    every, state = decoder.every_step(features), decoder.init_state(2)
    for t in range(5):
        streamed, state = decoder.step(features[:, t], state)
        expected = decoder(features[:, : t + 1])
        torch.testing.assert_close(streamed, expected, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(every[:, t], expected, atol=1e-5, rtol=1e-5)
    with pytest.raises(UsageError, match="received step 6"):
        decoder.step(features[:, 0], state)
    with pytest.raises(UsageError, match="built for 5 steps"):
        decoder(torch.zeros(1, 6, 6))


def test_decoders_are_made_by_name():
    assert make_decoder("linear", 8, 3)(torch.zeros(1, 8)).shape == (1, 3)
    with pytest.raises(UsageError, match=r"'mpl'.*'mlp'"):
        make_decoder("mpl", 8)
    with pytest.raises(UsageError, match=r"classes .*received 1"):
        make_decoder("linear", 8, 1)
