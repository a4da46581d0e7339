"""Parameters are drawn from a seed, loaded all or none, and hashed by what they hold."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from brainbench.core.errors import DataError
from brainbench.models.ops.layers import Conv2d, draw_silent_biases
from brainbench.models.ops.parameters import load_named, seeded, weights_hash


def test_silent_biases_lie_where_pytorch_draws_them_and_repeat_with_the_seed():
    def drawn(seed):
        layer = Conv2d(3, 200, kernel_size=(2, 2))
        with seeded(seed):
            draw_silent_biases(nn.Sequential(layer, nn.LayerNorm(2)))
        return layer.bias.detach()

    bound = 12**-0.5
    assert drawn(0).abs().max() <= bound
    assert drawn(0).std() == pytest.approx(bound / 3**0.5, rel=0.1)
    assert torch.equal(drawn(0), drawn(0))
    assert not torch.equal(drawn(0), drawn(1))


def test_parameters_are_loaded_all_or_none():
    targets = {"weight": torch.zeros(2, 3), "bias": torch.zeros(2)}
    given = {"weight": np.ones((2, 3), dtype=np.float32), "bias": torch.full((2,), 2.0)}
    for change, words in (
        ({"bias": torch.zeros(3)}, r"'bias' has shape \[3\], expected \[2\]"),
        ({"wieght": torch.zeros(1)}, "did you mean 'wieght' → 'weight'"),
    ):
        with pytest.raises(DataError, match=words):
            load_named(targets, given | change, what="the layer")
        assert not any(value.any() for value in targets.values())
    with pytest.raises(DataError, match="missing 'bias'"):
        load_named(targets, {"weight": given["weight"]}, what="the layer")
    load_named(targets, given, what="the layer")
    assert targets["weight"].eq(1).all()
    assert targets["bias"].eq(2).all()


def test_the_hash_is_of_values_whatever_drew_them():
    with seeded(3):
        first = torch.nn.Linear(3, 2)
    with seeded(3):
        again = torch.nn.Linear(3, 2)
    assert weights_hash(first) == weights_hash(again)
    half = weights_hash(again.to(torch.bfloat16))
    assert half == weights_hash(again.float())
    with torch.no_grad():
        again.bias[0] += 1
    assert weights_hash(again) != half
