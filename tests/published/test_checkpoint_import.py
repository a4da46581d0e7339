"""The networks of the study, filled by the reference's rule, against what the authors' own code gave for them."""

from __future__ import annotations

import json
import sys
import types

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.models.activations import extract
from brainbench.models.encoders import S4Encoder
from brainbench.models.network import Normaliser
from brainbench.models.ops.state_space import StateSpace
from brainbench.models.recipes import Architecture
from brainbench.models.registry import describe_model, load_model
from brainbench.models.zoo import build
from brainbench.published.checkpoint_import import (
    Settings,
    build_published,
    import_checkpoint,
    import_to_cache,
    matched_entries,
    published_names,
    read_settings,
    read_weights,
    recognise,
    stored_readout,
)
from tests.factories.published_files import lightning_state
from tests.factories.training_sweeps import random_sweeps

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
    with pytest.raises(DataError, match="not a readable YAML text"):
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


@pytest.mark.slow
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


QUICK = ("s4+gpt/linear-last", "resnet18/mlp3-all", "zhuang+mamba/linear-last")
_CELLS = ("", "-gru_ln", "-ugrnn", "-inter_ln", "-gru", "-lstm", "-ugrnn_ln", "-inter", "-lstm_ln")
REST = (
    *(f"zhuang{cell}/mlp3-last" for cell in _CELLS),
    *(f"{name}/linear-last" for name in ("zhuang", "zhuang+gpt", "zhuang-inter_ln+gpt", "s4+mamba")),
    *(f"resnet18+{attender}/linear-last" for attender in ("gpt", "mamba")),
)
ALL = [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in REST)]
CLOSE = 1e-5
"""Share of the largest value that single precision leaves open in the authors' own outputs."""
AMPLIFIED = 4e-5
"""The same after Mamba, which amplifies the last bits; in double precision we differ from theirs as much."""


def _network(published, name):
    settings = Settings(cell="intersection" if "inter" in name else "lstm")
    state = published.state(name)
    model, _ = build_published(state, recognise(state, settings))
    if isinstance(model.encoder, S4Encoder):
        _round_kernels_as_they_do(model.encoder, state)
    return model.eval()


def _round_kernels_as_they_do(encoder, state):
    """Kernels of length 22 from the stored C in single precision (Gu et al. 2022, algorithm 1), as the authors' code.

    Single precision costs it 2e-5 to 4e-5 of the largest value, which ours, in double, does not lose; what follows
    would be compared to that error.
    """
    for index, block in enumerate(encoder.blocks):
        begin = f"model.encoder.s4_layers.{index}.layer.kernel."
        entry = {name.removeprefix(begin): value for name, value in state.items() if name.startswith(begin)}
        p, b, c = (torch.view_as_complex(entry[name][0]) for name in "PBC")
        step = torch.exp(entry["inv_dt"])
        poles = torch.complex(-torch.exp(entry["A_real"]), -entry["A_imag"]) * step
        omega = torch.tensor(np.exp(-2j * np.pi / 22), dtype=torch.complex64) ** torch.arange(12)
        z = 2 * (1 - omega) / (1 + omega)

        def cauchy(v, z=z, poles=poles, step=step):
            every, at = torch.cat((v, v.conj()), 1), torch.cat((poles, poles.conj()), 1)
            return (every[..., None] / (z - at[..., None])).sum(1) * step

        spectrum = cauchy(b * c) - cauchy(p * c) * cauchy(b * p.conj()) / (1 + cauchy(p * p.conj()))
        kernel = torch.fft.irfft(spectrum * 2 / (1 + omega), n=22).double()
        _agrees(kernel, block.memory.kernel(22).numpy(), 5e-5)
        block.memory.kernel = lambda length, kernel=kernel: kernel


def _agrees(ours, theirs, share, largest=None):
    error = np.abs(np.asarray(ours) - theirs).max() / (largest or np.abs(theirs).max())
    assert error <= share, f"{error:.1e} of the largest value"


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize("name", ALL)
@torch.no_grad()
def test_a_network_gives_the_authors_outputs(published, name):
    model, theirs = _network(published, name), published.outputs[name]
    share = AMPLIFIED if "mamba" in name else CLOSE
    _agrees(model(published.stimulus(2)), theirs["logits"], share)
    x = model.normaliser(published.stimulus(2))
    _agrees(model.encoder(x)[..., :16], theirs["encoder_out"], CLOSE)
    if "encoder_out_full_unroll" in theirs:
        _agrees(model.encoder(x, unroll="full")[..., :16], theirs["encoder_out_full_unroll"], CLOSE)
    six = published.stimulus(6)
    _agrees(model(six), theirs["logits6"], share)
    read = extract(model, six, readout="published")
    assert {f"scored/{layer}" for layer in read} == {what for what in theirs if what.startswith("scored/")}
    nodes = dict(model.encoder.activations(model.normaliser(six))) if name.startswith("zhuang") else {}
    for layer, values in read.items():
        within = share if layer.startswith(("att_mamba", "dec")) else CLOSE
        scored = values.mean(1)
        count, mean, spread = theirs[f"scored_stats/{layer}"]
        assert scored.shape == (6, count)
        _agrees(scored[:, :8], theirs[f"scored/{layer}"], within, np.abs(scored).max())
        assert scored.std() == pytest.approx(spread, rel=1e-4)
        assert scored.mean() == pytest.approx(mean, abs=within * float(np.abs(scored).max()))
        whole = nodes[layer].flatten(2).mean((0, 2)) if layer in nodes else values.mean()
        assert np.abs(np.asarray(whole) - theirs[f"mean/{layer}"]).max() <= within * np.abs(values).max()


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize(("name", "share"), [("resnet18/mlp3-all", 1e-5), ("resnet18+mamba/linear-last", 3e-4)])
@torch.no_grad()
def test_batch_statistics_give_what_the_authors_activation_script_saw(published, name, share):
    # The last bit of the stimulus moves Mamba's answer by 1e-4 here.
    model = _network(published, name).train()
    _agrees(model(published.stimulus(6)), published.outputs[name]["logits6_train_mode"], share)


@torch.no_grad()
def test_the_stored_readout_is_undone():
    memory = StateSpace(6, pairs=4)
    stored = stored_readout(memory.transition(), memory.readout, 22, undo=False)
    assert not torch.allclose(stored.float(), memory.readout, atol=1e-2)
    again = stored_readout(memory.transition(), stored, 22, undo=True)
    torch.testing.assert_close(again.float(), memory.readout)


@torch.no_grad()
def test_the_transition_is_the_recurrences():
    memory = StateSpace(5, pairs=3).double()
    x, system = torch.randn(1, 5, 3, 2, dtype=torch.float64), memory.system()
    _, after = memory.step(torch.zeros(1, 5, dtype=torch.float64), x, system)
    state = torch.view_as_complex(x)[0]
    expected = (memory.transition() @ torch.cat((state, state.conj()), 1)[..., None])[:, :3, 0]
    torch.testing.assert_close(torch.view_as_complex(after)[0], expected)


@pytest.mark.parametrize("name", ["s4", "resnet18-small+mamba", "zhuang-lstm-ln-small+gpt"])
def test_every_entry_of_ours_has_a_name_of_its_own(name):
    from brainbench.published.checkpoint_import import published_names

    for decoder in ("linear", "mlp", "all-steps"):
        model = load_model(name, decoder=decoder)
        names = published_names(model)
        assert set(names) == {key for key in model.state_dict() if not key.startswith("normaliser.")}
        assert len(set(names.values())) == len(names)


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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
