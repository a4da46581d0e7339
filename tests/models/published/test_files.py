import json

import pytest
import torch
from safetensors.torch import save_file

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.models.published.files import Settings, read_settings, read_weights

STATE = {"model.encoder.embed.weight": torch.ones(2, 3)}


class Unknown:
    """An object that only pickle could bring back."""


def test_a_lightning_file_a_bare_state_and_safetensors_hold_the_same(tmp_path):
    torch.save({"state_dict": STATE, "epoch": 4, "global_step": 90, "callbacks": {}}, tmp_path / "a.ckpt")
    torch.save(STATE, tmp_path / "b.pt")
    save_file(STATE, tmp_path / "c.safetensors")
    found = [read_weights(tmp_path / name) for name in ("a.ckpt", "b.pt", "c.safetensors")]
    assert all(torch.equal(item.state["model.encoder.embed.weight"], torch.ones(2, 3)) for item in found)
    assert [(item.epoch, item.step) for item in found] == [(4, 90), (None, None), (None, None)]
    assert {len(item.sha256) for item in found} == {64}


def test_bare_networks_and_graphs_get_their_prefix(tmp_path):
    for given, expected in (
        ("encoder.TG.conv1._pre_memory.conv.bias", "model.encoder.TG.conv1._pre_memory.conv.bias"),
        ("TG.conv1._pre_memory.conv.bias", "model.encoder.TG.conv1._pre_memory.conv.bias"),
        ("conv1._pre_memory.conv.bias", "model.encoder.TG.conv1._pre_memory.conv.bias"),
    ):
        torch.save({given: torch.zeros(2)}, tmp_path / "x.pt")
        assert list(read_weights(tmp_path / "x.pt").state) == [expected]


def test_a_file_that_needs_pickle_is_refused(tmp_path):
    torch.save({"state_dict": STATE, "hyper_parameters": Unknown()}, tmp_path / "x.ckpt")
    with pytest.raises(DataError, match="pickle"):
        read_weights(tmp_path / "x.ckpt")


@pytest.mark.parametrize("name", ["x.ckpt", "x.safetensors"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_file_that_is_cut_short_is_refused(tmp_path, name, share):
    path = tmp_path / name
    big = {"model.encoder.embed.weight": torch.randn(60, 70)}
    save_file(big, path) if path.suffix == ".safetensors" else torch.save(big, path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(DataError, match="cut short"):
        read_weights(path)


def test_what_holds_no_finite_weights_is_refused(tmp_path):
    torch.save({"state_dict": {"epoch": 3}}, tmp_path / "x.ckpt")
    with pytest.raises(DataError, match="holds no weights"):
        read_weights(tmp_path / "x.ckpt")
    torch.save({"state_dict": {"a": torch.tensor([1.0, float("nan")])}}, tmp_path / "x.ckpt")
    with pytest.raises(DataError, match=r"'a'.*not finite"):
        read_weights(tmp_path / "x.ckpt")
    with pytest.raises(DataFileNotFoundError, match=r"gone\.ckpt"):
        read_weights(tmp_path / "gone.ckpt")


@pytest.mark.parametrize(
    ("stem", "cell"),
    [
        ("modern", "time-decay"),
        ("modern_gru", "gru"),
        ("modern_lstm_ln", "lstm-ln"),
        ("modern_intersection", "intersection"),
        ("modern_ln", "time-decay-ln"),
        ("modern_lsmt", None),
        ("classic", None),
    ],
)
def test_settings_name_the_cell_and_the_objective(tmp_path, stem, cell):
    path = tmp_path / "config.json"
    values = {"model": {"encoder": {"model_config_file": f"model_configs/rnn_fdb_converted_{stem}.json"}}}
    path.write_text(json.dumps(values | {"train": {"ssl": "SimSiamLoss"}}))
    assert read_settings(path) == Settings(cell, "simsiam")


def test_settings_are_yaml_too(tmp_path):
    pytest.importorskip("yaml")
    path = tmp_path / "config.yaml"
    path.write_text("train:\n  ssl: AutoEncoderLoss\n")
    assert read_settings(path) == Settings(None, "ae")
    path.write_text("a: [1\n")
    with pytest.raises(DataError, match="not valid YAML"):
        read_settings(path)
    path.write_text("learning_rate: 0.1\n")
    with pytest.raises(DataError, match="learning_rate"):
        read_settings(path)
    path.write_text("model: {encoder: {model_config_file: rnn_fdb_converted_modern_lsmt.json}}\n")
    with pytest.raises(DataError, match="says nothing of a network"):
        read_settings(path)
    with pytest.raises(DataFileNotFoundError, match=r"none\.yaml"):
        read_settings(tmp_path / "none.yaml")
