"""What parts of a network share: layers in turn, sweeps that fit, and the activations that were asked for."""

from __future__ import annotations

import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.parts import check_sweep, run_layers, wanted

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
