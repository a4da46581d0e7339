from __future__ import annotations

import json
import logging

import pytest
import torch

from brainbench.core.statistics import wilson_interval
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.card import checkpoint_info, describe_twin, draw_twin, model_card
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.evaluation import Evaluation
from brainbench.models.training.trainer import train
from tests.factories.training_sweeps import tiny

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


MODEL = "s4-small"


def _train(out, **options):
    config = TrainingConfig.published(
        MODEL, epochs=2, batch_size=8, augmentation="none", probe_epochs=2, seed=5, precision="float32"
    )
    return train(config, tiny(), out=out, device="cpu", **options)


def test_a_checkpoint_says_how_to_get_the_network_that_its_training_started_from(tmp_path):
    folder = _train(tmp_path).folder
    stated = describe_model(f"local-dir:{folder}").trained
    model, told = draw_twin(stated["twin"], stated["options"])
    assert told == ""
    plain = load_model(stated["twin"]["name"], seed=stated["twin"]["seed"])
    assert torch.equal(plain.encoder.embed.bias, model.encoder.embed.bias)
    assert not torch.equal(load_model(f"local-dir:{folder}").encoder.embed.bias, model.encoder.embed.bias)


def test_the_hash_knows_names_shapes_and_every_bit():
    first = describe_twin(MODEL, 0, load_model(MODEL, classes=3))
    assert first == describe_twin(MODEL, 0, load_model(MODEL, classes=3))
    changed = load_model(MODEL, classes=3)
    with torch.no_grad():
        weight = changed.encoder.embed.weight
        weight[0, 0] = torch.nextafter(weight[0, 0], torch.tensor(1.0))
    others = (changed, load_model(MODEL, classes=3, seed=1), load_model(MODEL, classes=4))
    assert len({describe_twin(MODEL, 0, model)["state"] for model in others} | {first["state"]}) == 4


def test_a_twin_that_is_drawn_otherwise_elsewhere_is_noticed():
    here = describe_twin(MODEL, 0, load_model(MODEL, classes=3))
    _, told = draw_twin(here | {"state": "0" * 32, "torch": "1.0"}, {"classes": 3})
    assert "1.0" in told
    assert torch.__version__ in told


def test_a_resumed_run_keeps_the_twin_that_it_started_from(tmp_path, caplog):
    _train(tmp_path, stop_after=0.0)
    run = json.loads((tmp_path / "run.json").read_text())
    run["twin"] |= {"state": "0" * 32, "torch": "1.0"}
    (tmp_path / "run.json").write_text(json.dumps(run))
    with caplog.at_level(logging.WARNING):
        folder = _train(tmp_path).folder
    stated = json.loads((folder / "config.json").read_text())["twin"]
    assert stated["state"] == "0" * 32
    assert "without its untrained twin" in caplog.text
    controls = json.loads((tmp_path / "controls.json").read_text())["controls"]
    assert set(controls) == {"raw-input", "random-features"}
