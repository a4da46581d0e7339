import json
import sys
import types

import pytest
import torch

from brainbench.core.errors import DataError, UsageError
from brainbench.models.normaliser import Normaliser
from brainbench.models.published.importing import import_checkpoint, import_to_cache
from brainbench.models.registry import describe_model, load_model
from tests.factories.published_files import lightning_state
from tests.factories.training_sweeps import random_sweeps


@pytest.fixture(scope="module")
def original():
    model = load_model("s4", seed=5, classes=9)
    model.normaliser = Normaliser.physical(force=1e-3)
    return model


@pytest.fixture(scope="module")
def state(original):
    head = {"loss.neck.fc0.weight": torch.zeros(2048, 512), "loss.neck.bn0.bias": torch.zeros(2048)}
    return lightning_state(original, **head)


@pytest.fixture
def file(tmp_path, state):
    path = tmp_path / "run" / "val_best.ckpt"
    path.parent.mkdir()
    torch.save({"state_dict": state, "epoch": 6, "global_step": 50}, path)
    return path


@torch.no_grad()
def test_a_file_in_the_authors_layout_becomes_a_model(file, tmp_path, original):
    made = import_checkpoint(file, out=tmp_path / "made")
    assert (made.architecture, made.decoder, made.objective) == ("s4", "linear", "simclr")
    assert made.parameters == sum(parameter.numel() for parameter in original.parameters())
    assert made.not_imported == {"self-supervised head": 2, "attention masks and kernel lengths": 4}
    model, x = load_model(made.name), random_sweeps(2, 22)
    torch.testing.assert_close(model(x), original(x), atol=1e-4, rtol=1e-4)
    state = model.init_state(2)
    for t in range(22):
        streamed, state = model.step(x[:, t], state)
    torch.testing.assert_close(streamed, original(x), atol=1e-4, rtol=1e-4)
    config = json.loads((made.folder / "config.json").read_text())
    assert config["origin"] == {"file": "val_best.ckpt", "sha256": made.sha256, "epoch": 6, "step": 50}
    assert config["not_imported"]["self-supervised head"] == ["loss.neck.fc0.weight", "loss.neck.bn0.bias"]
    card = (made.folder / "README.md").read_text(encoding="utf-8")
    for stated in (made.sha256, "simclr", "6 epochs, 50 steps", "untrained twin | unknown"):
        assert stated in card
    assert describe_model(made.name).trained["twin"] is None


def test_a_first_stage_file_has_no_decoder(file, tmp_path):
    content = torch.load(file, weights_only=True)
    content["state_dict"] = {name: v for name, v in content["state_dict"].items() if ".decoder.mlp" not in name}
    torch.save(content, file)
    made = import_checkpoint(file, out=tmp_path / "made")
    assert made.decoder is None
    assert made.parameters == 3_434_496
    assert "not in the file" in (made.folder / "README.md").read_text(encoding="utf-8")
    assert load_model(made.name).spec.outputs == 117


def test_weights_of_another_width_are_refused(tmp_path):
    model = load_model("s4-small")
    torch.save(lightning_state(model), tmp_path / "x.pt")
    with pytest.raises(DataError, match=r"embed\.weight' has shape \[96, 1050\], expected \[512, 1050\]"):
        import_checkpoint(tmp_path / "x.pt", out=tmp_path / "made")
    assert not (tmp_path / "made").exists()
    assert (
        import_checkpoint(tmp_path / "x.pt", architecture="s4-small", out=tmp_path / "made").architecture == "s4-small"
    )


def test_an_architecture_that_does_not_exist_is_refused(file, tmp_path):
    with pytest.raises(UsageError, match=r"'s5'.* 's4'"):
        import_checkpoint(file, architecture="s5", out=tmp_path / "made")
    with pytest.raises(DataError, match="missing"):
        import_checkpoint(file, architecture="resnet18", out=tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_an_entry_that_nobody_knows_is_refused(file, tmp_path):
    content = torch.load(file, weights_only=True)
    content["state_dict"]["model.encoder.extra.weight"] = torch.zeros(3)
    torch.save(content, file)
    with pytest.raises(DataError, match=r"unexpected 'model\.encoder\.extra\.weight'"):
        import_checkpoint(file, out=tmp_path / "made")


@torch.no_grad()
def test_a_folder_with_one_such_file_is_a_model(file, original):
    x = random_sweeps(1, 5)
    name = f"local-dir:{file.parent}"
    torch.testing.assert_close(load_model(name)(x), original(x), atol=1e-4, rtol=1e-4)
    assert describe_model(name).trained["objective"] == "simclr"
    for other in ("last.ckpt", "lin_ft_linear/val_best.ckpt"):
        (file.parent / other).parent.mkdir(exist_ok=True)
        (file.parent / other).write_bytes(b"")
    torch.testing.assert_close(load_model(name)(x), original(x), atol=1e-4, rtol=1e-4)
    file.rename(file.with_name("first.ckpt"))
    with pytest.raises(UsageError, match=r"'first\.ckpt', 'last\.ckpt'"):
        load_model(name)


def test_a_damaged_import_in_the_cache_is_made_again(file, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "cache"))
    weights = import_to_cache(file) / "model.safetensors"
    whole, before = weights.read_bytes(), weights.stat().st_mtime_ns
    assert import_to_cache(file) == weights.parent
    assert weights.stat().st_mtime_ns == before
    weights.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    import_to_cache(file)
    assert "made again" in caplog.text
    assert weights.read_bytes() == whole


@torch.no_grad()
def test_a_repository_of_such_files_is_a_model(file, original, monkeypatch):
    asked = []

    def download(repository, *, revision, allow_patterns):
        asked.append((repository, revision, *allow_patterns))
        return str(file.parents[1])

    monkeypatch.setitem(sys.modules, "huggingface_hub", types.SimpleNamespace(snapshot_download=download))
    x = random_sweeps(1, 5)
    model = load_model("hf-hub:NeuroAgentsLab/tactile-whisking/run@v1")
    torch.testing.assert_close(model(x), original(x), atol=1e-4, rtol=1e-4)
    assert asked[1] == ("NeuroAgentsLab/tactile-whisking", "v1", "run/*.ckpt", "run/config.yaml")
    assert load_model("hf-hub:NeuroAgentsLab/tactile-whisking").spec.outputs == 9
