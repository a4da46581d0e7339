from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import save_file

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.models.architecture import Architecture
from brainbench.models.zoo import build
from brainbench.published.checkpoint_files import Settings, read_settings, read_weights, recognise
from brainbench.published.checkpoint_import import matched_entries, published_names

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


READ_OUTS = {"linear-last": "linear", "mlp3-last": "mlp", "mlp3-all": "all-steps"}
OTHERS = ("loss.", "attn.bias", "l_kernel")


def _entries(names):
    return {name: torch.empty(shape, device="meta") for name, shape, _ in names}


@pytest.mark.shared
def test_every_network_of_the_study_is_recognised_and_every_entry_accounted_for(published):
    assert len(published.networks) == 74
    for name, network in published.networks.items():
        own, _, last = name.partition("/")
        cell = "intersection" if "inter" in own else "lstm"
        state = _entries(network["state_dict"])
        found = recognise(state, Settings(cell))
        assert found.architecture == own.replace("inter", "intersection").replace("_ln", "-ln")
        assert found.decoder == READ_OUTS.get(last)
        assert found.objective == (last if last not in READ_OUTS else "supervised" if "mlp3" in last else None)
        with torch.device("meta"):
            model = build(Architecture.parse(found.architecture), decoder=found.decoder or "linear")
        used = matched_entries(state, model, found)
        assert all(any(mark in left for mark in OTHERS) for left in set(state) - set(used))
        buffers = {theirs for ours, theirs in published_names(model).items() if ours in dict(model.named_buffers())}
        count = sum(value.numel() for entry, value in used.items() if entry not in buffers)
        assert count == network["model_parameters"]
        # SimSiam stores its head twice, under loss. and loss.neck.; running averages are no parameters.
        averages = ("running_mean", "running_var", "num_batches_tracked")
        head = {left for left in state if left.startswith("loss.") and not left.endswith(averages)}
        head = {left for left in head if left.replace("loss.neck.", "loss.") not in head - {left}}
        assert sum(state[left].numel() for left in head) == network["loss_parameters"]


@pytest.mark.shared
def test_an_lstm_and_an_intersection_rnn_without_norm_need_a_word(published):
    state = _entries(published.networks["zhuang-lstm+gpt/linear-last"]["state_dict"])
    with pytest.raises(UsageError, match="--config"):
        recognise(state)
    assert recognise(state, architecture="zhuang-lstm+gpt.simclr").architecture == "zhuang-lstm+gpt"
    assert recognise(state, Settings("intersection")).architecture == "zhuang-intersection+gpt"


def test_other_networks_are_refused():
    with pytest.raises(DataError, match=r"layer1\.0\.conv1\.weight"):
        recognise({"layer1.0.conv1.weight": torch.zeros(1)})
    with pytest.raises(DataError, match=r"model\.attender\.s4_layers"):
        recognise({"model.encoder.s4_layers.0.D": torch.zeros(1), "model.attender.s4_layers.0.D": torch.zeros(1)})
