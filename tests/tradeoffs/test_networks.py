import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.registry import load_model
from brainbench.tradeoffs.networks import ModelSetting, Reduced, round_weights, study
from brainbench.tradeoffs.study import run_study
from tests.factories.training_sweeps import random_sweeps

NAME = "zhuang-ugrnn-ln-small"


def _measure(*settings, steps=10):
    return run_study(study(NAME, settings, random_sweeps(3, steps)))


def test_the_reference_setting_has_no_error():
    (row,) = _measure(ModelSetting(steps=10))
    assert row["error"] == pytest.approx(0.0, abs=1e-6)
    assert 0 < row["ms"] <= row["p99_ms"]


def test_lower_precision_costs_a_little_accuracy_and_saves_memory():
    rows = _measure(*(ModelSetting(name, steps=10) for name in ("float32", "bf16", "int8")))
    _, bf16, int8 = (row["error"] for row in rows)
    assert 0 < bf16 < 0.1
    assert 0 < int8 < 0.2
    sizes = [row["stored_bytes"] for row in rows]
    assert sizes[0] > 1.8 * sizes[1] > 3 * sizes[2]


def test_rounding_to_eight_bits_moves_no_weight_by_more_than_half_a_level():
    model = load_model(NAME)
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    round_weights(model)
    for name, value in model.named_parameters():
        if value.ndim > 1:
            level = before[name].flatten(1).abs().amax(1) / 127
            moved = (value - before[name]).flatten(1).abs().amax(1)
            assert (moved <= 0.501 * level).all()
        else:
            assert torch.equal(value, before[name])


def test_fewer_steps_and_another_unrolling_change_the_answer():
    rows = _measure(ModelSetting(steps=5), ModelSetting(unroll="full", steps=10))
    assert all(row["error"] > 0.01 for row in rows)


def test_a_reduced_network_is_scored_like_the_network():
    reduced, x = Reduced(NAME, ModelSetting("bf16", steps=6)), random_sweeps(3, 10)
    assert reduced.layers == load_model(NAME).layers
    with torch.no_grad():
        assert reduced.activations(x, ["decoder"])["decoder"].shape == (3, 6, 117)


def test_wrong_settings_are_refused():
    with pytest.raises(UsageError, match="precision 'int4'"):
        ModelSetting("int4")
    with pytest.raises(UsageError, match=r"steps must .*received 0"):
        ModelSetting(steps=0)
    with pytest.raises(UsageError, match=r"'s4-small' .*'full'"):
        Reduced("s4-small", ModelSetting(unroll="full"))
    with pytest.raises(UsageError, match="22 steps cannot"):
        _measure(ModelSetting())
