import json
import sys
import types

import pytest
import torch

from brainbench.core.errors import DataError, DataFileNotFoundError, MissingDependencyError, UsageError
from brainbench.models import registry
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.checkpoints import find_folder, save_checkpoint

NAME = "resnet18-small"


@pytest.fixture
def folder(tmp_path):
    model = load_model(NAME, seed=3, classes=7)
    return save_checkpoint(
        tmp_path / "mine", model, architecture=NAME, options={"classes": 7}, info={"objective": "ae"}, card="# Mine\n"
    )


def _equal(first, second):
    return all(torch.equal(value, second.state_dict()[name]) for name, value in first.state_dict().items())


def test_a_folder_is_a_model(folder):
    loaded = load_model(f"local-dir:{folder}")
    assert not loaded.training
    assert loaded.spec.outputs == 7
    assert _equal(load_model(NAME, seed=3, classes=7), loaded)
    assert sorted(item.name for item in folder.iterdir()) == ["README.md", "config.json", "model.safetensors"]
    described = describe_model(f"local-dir:{folder}")
    assert described.trained["objective"] == "ae"
    assert described.family == "resnet18"


def test_a_network_states_the_time_steps_and_axes_of_its_training(tmp_path):
    model = load_model("zhuang-small")
    told = {"data": {"hash": "a", "time_step": 0.02, "axes": "follicle"}}
    folder = save_checkpoint(tmp_path, model, architecture="zhuang-small", options={}, info=told)
    spec = load_model(f"local-dir:{folder}").spec
    assert spec.sample_rate == 50
    assert spec.frame == model.spec.frame.replace("world", "follicle")


def test_a_folder_can_stand_for_a_tag(folder):
    assert _equal(load_model(f"{NAME}.ae", pretrained=folder), load_model(f"local-dir:{folder}"))


def test_shipped_weights_are_found_by_name(folder, monkeypatch):
    monkeypatch.setattr(registry, "shipped", lambda: {f"{NAME}.simclr": folder})
    assert _equal(load_model(f"{NAME}.simclr"), load_model(f"local-dir:{folder}"))
    assert describe_model(f"{NAME}.simclr").name == f"{NAME}.simclr"
    with pytest.raises(UsageError, match="train resnet18-small --objective"):
        load_model(f"{NAME}.supervised")


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_half_precision_halves_the_file_and_loads_as_float32(folder, dtype):
    size = (folder / "model.safetensors").stat().st_size
    model = load_model(f"local-dir:{folder}")
    save_checkpoint(folder, model, architecture=NAME, options={"classes": 7}, dtype=dtype)
    assert (folder / "model.safetensors").stat().st_size < 0.55 * size
    loaded = load_model(f"local-dir:{folder}")
    assert all(parameter.dtype == torch.float32 for parameter in loaded.parameters())
    for name, value in model.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value, rtol=2**-8, atol=1e-4)
    assert torch.equal(loaded.normaliser.scale, model.normaliser.scale)


def test_weights_that_are_not_finite_are_not_written(tmp_path):
    model = load_model(NAME)
    with torch.no_grad():
        model.decoder.weight[0, 0] = 1e30
    with pytest.raises(DataError, match=r"'decoder.weight' .* float16"):
        save_checkpoint(tmp_path / "bad", model, architecture=NAME, options={}, dtype="float16")
    with pytest.raises(UsageError, match="weights 'float8'"):
        save_checkpoint(tmp_path / "bad", model, architecture=NAME, options={}, dtype="float8")
    assert not (tmp_path / "bad").exists()


def test_folders_that_are_no_models_are_told_apart(folder, tmp_path):
    with pytest.raises(DataFileNotFoundError, match="/none'"):
        load_model(f"local-dir:{tmp_path / 'none'}")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataFileNotFoundError, match=r"config\.json .*/empty'"):
        load_model(f"local-dir:{tmp_path / 'empty'}")
    config = json.loads((folder / "config.json").read_text())
    for change, message in (
        ({"brainbench_model": 9}, "format 9, expected 1"),
        ({"options": []}, "lacks the name 'architecture' or the mapping 'options'"),
        ({"options": {"clases": 7}}, "did you mean 'classes'"),
        ({"options": {"classes": 8}}, "do not fit the model"),
        ({"architecture": "resnet81"}, "Unknown model 'resnet81'"),
    ):
        (folder / "config.json").write_text(json.dumps(config | change))
        with pytest.raises((DataError, UsageError), match=message):
            load_model(f"local-dir:{folder}")


def test_the_hub_is_asked_only_by_its_prefix(folder, monkeypatch):
    asked = []

    def download(repository, *, revision, allow_patterns):
        asked.append((repository, revision))
        return str(folder)

    monkeypatch.setitem(sys.modules, "huggingface_hub", types.SimpleNamespace(snapshot_download=download))
    assert load_model("hf-hub:someone/touch@v2").spec.outputs == 7
    assert asked == [("someone/touch", "v2")]
    for odd in ("touch", "someone/touch/" + 300 * "x", "someone/../touch"):
        with pytest.raises(UsageError, match=f"received 'hf-hub:{odd[:9]}"):
            find_folder(f"hf-hub:{odd}")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingDependencyError, match=r"\[hub\]"):
        load_model("hf-hub:someone/touch")


def test_a_score_carries_what_the_checkpoint_says(folder):
    from brainbench.scoring.model_responses import resolve_model

    config = json.loads((folder / "config.json").read_text())
    found = {"top1": 0.5, "top5": 0.9, "interval": {"low": 0.4, "high": 0.6}, "data": "abc", "collapsed": False}
    (folder / "config.json").write_text(
        json.dumps(config | {"evaluation": found, "twin": {"name": NAME, "seed": 4}, "seed": 4})
    )
    card = resolve_model(f"local-dir:{folder}").card
    assert (card.objective, card.top1, card.accuracy_interval.high, card.twin, card.seed) == ("ae", 0.5, 0.6, NAME, 4)
    assert resolve_model(NAME).card.objective == "untrained"
    for name in ("evaluation", "twin", "baselines"):
        (folder / "config.json").write_text(json.dumps(config | {name: "damaged"}))
        with pytest.raises(DataError, match=r"config\.json' is not a readable configuration"):
            resolve_model(f"local-dir:{folder}")


def test_weights_of_another_version_are_refused(folder, tmp_path):
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"version": 7}))
    with pytest.raises(DataError, match=r"version 7 .* train anew"):
        load_model(f"local-dir:{folder}")
    # Checkpoints made before there were versions state none: theirs is the first, which S4 and GPT no longer compute.
    model = load_model("s4-small+gpt", classes=7)
    older = save_checkpoint(tmp_path / "older", model, architecture="s4-small+gpt", options={"classes": 7})
    stated = json.loads((older / "config.json").read_text())
    del stated["version"]
    (older / "config.json").write_text(json.dumps(stated))
    with pytest.raises(DataError, match=r"version 1 .* train anew"):
        load_model(f"local-dir:{older}")
