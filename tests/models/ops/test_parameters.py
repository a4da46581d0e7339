"""Parameters are drawn from a seed."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from brainbench.models.ops.layers import Conv2d, draw_silent_biases
from brainbench.models.ops.parameters import seeded


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
