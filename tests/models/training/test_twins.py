import json
import logging

import torch

from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.trainer import train
from brainbench.models.training.twins import describe_twin, draw_twin
from tests.factories.training_sweeps import tiny

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
