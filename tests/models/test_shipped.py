"""The trained models that come with the package."""

import socket

import pytest
import torch
from safetensors.torch import load_file

from brainbench.models.recipes import Architecture
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.batches import BatchOptions
from brainbench.models.training.checkpoints import CARD, WEIGHTS, read_config, shipped
from tests.factories.training_sweeps import ArrayBatches, sweeps

NAMES = sorted(shipped())
CLASSES = 54


def test_trained_networks_come_with_the_package():
    assert len(NAMES) == 8


def test_they_are_small():
    sizes = {name: sum(path.stat().st_size for path in shipped()[name].iterdir()) for name in NAMES}
    assert max(sizes.values()) <= 3e6
    assert sum(sizes.values()) <= 15e6


@pytest.mark.parametrize("name", NAMES)
def test_its_configuration_and_card_say_how_it_was_trained_and_how_well(name):
    config = read_config(shipped()[name])
    found, twin = config["evaluation"], config["twin_evaluation"]
    assert f"{config['architecture']}.{config['objective']}" == name
    assert 0 < config["epochs"] <= config["published_epochs"] == 100
    assert found["interval"]["low"] <= found["top1"] <= found["interval"]["high"]
    assert found["count"] == twin["count"] == config["data"]["test"]
    assert found["data"] == twin["data"]
    assert len(config["classes"]) == CLASSES
    card = (shipped()[name] / CARD).read_text(encoding="utf-8")
    for stated in (f"{found['top1']:.3f}", f"{twin['top1']:.3f}", config["data"]["hash"], "(published: 100)"):
        assert stated in card
    assert ("**training changed less" in card or "**training made it worse" in card) == (
        found["interval"]["low"] <= twin["interval"]["high"]
    )


@pytest.mark.parametrize("name", NAMES)
def test_it_loads_and_is_not_what_it_was_before_training(name):
    model, architecture = load_model(name), Architecture.parse(name).untrained
    x, _ = next(iter(ArrayBatches(*sweeps(2, 0, steps=22), BatchOptions(2, shuffle=False))))
    with torch.no_grad():
        answers = model(x)
    assert answers.shape == (2, CLASSES)
    assert torch.isfinite(answers).all()
    untrained = load_model(architecture, seed=describe_model(name).trained["seed"], classes=CLASSES).state_dict()
    weights = load_file(shipped()[name] / WEIGHTS)
    assert all(value.isfinite().all() for value in weights.values() if value.is_floating_point())
    changed = [key for key, value in weights.items() if key.startswith("encoder.") and value.ndim > 1]
    moved = [key for key in changed if not torch.allclose(weights[key].float(), untrained[key], atol=1e-3)]
    assert len(moved) > 0.5 * len(changed)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES[:1])
def test_it_is_scored_without_a_network(name, monkeypatch):
    import brainbench

    def refuse(*arguments):
        raise OSError("no network in this test")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    found = brainbench.score(name)
    assert found.status == "ok"
    assert -1 <= found.value <= 1.5
