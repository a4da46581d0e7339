import pytest

from brainbench.core.statistics import wilson_interval
from brainbench.models.training.card import checkpoint_info, model_card
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.evaluation import Evaluation

DATA = {"hash": "0123abcd", "train": 3259, "validation": 405, "test": 407, "left_out": 921, "classes": 2}


def _found(correct, count=400):
    return Evaluation(correct / count, 0.9, wilson_interval(correct, count), count, 2, 0.8, False, "", "feed")


def _card(correct, twin=None, **changes):
    config = TrainingConfig.published("zhuang-small", "simclr", epochs=3)
    start = {"name": "zhuang-small", "seed": 0}
    known = {"epochs_done": 3, "best_epoch": 2, "evaluation": _found(correct), "twin": start}
    info = checkpoint_info(config, ("a", "b"), **known, **changes)
    if twin is not None:
        info["twin_evaluation"] = {
            "top1": twin / 400,
            "interval": {"low": wilson_interval(twin, 400).low, "high": wilson_interval(twin, 400).high},
        }
    return model_card(config, info | {"data": DATA})


def test_a_card_says_what_was_trained_on_what_and_for_how_long():
    text = _card(200)
    assert "3 (published: 100); best: 2" in text
    assert "0123abcd: 3,259 sweeps to train, 405 to validate, 407 of other objects to test; 921 left out" in text
    assert "0.500 [0.451, 0.549] on 400 sweeps (linear probe on the frozen network)" in text
    assert "gradients clipped to a norm of 1" in text


@pytest.mark.parametrize(
    ("correct", "verdict"),
    [(240, "training helped"), (205, "less than these intervals can tell"), (150, "training made it worse")],
)
def test_a_card_does_not_hide_that_the_untrained_twin_is_as_good(correct, verdict):
    assert verdict in _card(correct, twin=200)


def test_a_card_compares_with_the_raw_input_and_random_features():
    controls = {"raw-input": _found(100), "random-features": _found(120), "untrained-twin": _found(180)}
    text = _card(200, controls=controls)
    assert "| raw input | linear probe: top-1 0.250 [0.210, 0.295] |" in text
    assert "| random features | linear probe: top-1 0.300" in text
    assert "zhuang-small, seed 0, linear probe: top-1 0.450" in text


def test_a_card_without_its_twin_claims_nothing():
    assert "| untrained twin | zhuang-small, seed 0 |" in _card(200)
