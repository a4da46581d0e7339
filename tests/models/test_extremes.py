"""Inputs at the edge of what can happen give finite answers, or a sentence."""

import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.registry import load_model
from tests.factories.training_sweeps import random_sweeps

NAMES = ["zhuang-small", "zhuang-intersection-ln-small", "zhuang-lstm-small+gpt", "resnet18-small+mamba", "s4-small"]


@torch.no_grad()
@pytest.mark.parametrize("bf16", [False, True])
@pytest.mark.parametrize("force", [0.0, 1e-12, 1e6])
@pytest.mark.parametrize("name", NAMES)
def test_no_touch_the_faintest_and_the_strongest_are_finite(name, force, bf16):
    x = torch.full((1, 22, 30, 5, 7), force)
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        assert torch.isfinite(load_model(name)(x)).all()


@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_one_step_is_enough(name):
    assert torch.isfinite(load_model(name)(random_sweeps(1, 1))).all()


@torch.no_grad()
@pytest.mark.parametrize("name", ["s4-small", "zhuang-feedforward-small", "resnet18-small+mamba"])
def test_a_thousand_steps_are_finite(name):
    assert torch.isfinite(load_model(name)(random_sweeps(1, 1000))).all()


@torch.no_grad()
@pytest.mark.slow
@pytest.mark.parametrize("name", ["zhuang-small", "zhuang-intersection-ln-small", "resnet18-small+mamba", "s4-small"])
def test_ten_thousand_steps_in_half_precision_are_finite(name):
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.isfinite(load_model(name)(random_sweeps(1, 10_000))).all()


@torch.no_grad()
def test_more_steps_than_a_transformer_remembers_are_refused():
    with pytest.raises(UsageError, match="at most 32 steps"):
        load_model("zhuang-small+gpt")(torch.zeros(1, 10000, 30, 5, 7))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_stimulus_that_is_not_finite_is_refused(value):
    x = torch.zeros(1, 3, 30, 5, 7)
    x[0, 1, 2, 3, 4] = value
    with pytest.raises(UsageError, match="1 of 3,150 values"):
        load_model("zhuang-small")(x)


@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_a_silent_whisker_changes_the_answer_and_keeps_it_finite(name):
    model, x = load_model(name), random_sweeps(1, 12)
    silent = x.clone()
    silent[..., 2, 3] = 0.0
    assert torch.isfinite(model(silent)).all()
    assert not torch.equal(model(silent), model(x))
