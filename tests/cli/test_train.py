import json
import os
import shutil
from pathlib import Path

import h5py
import pytest

from brainbench.datasets.whisking.dataset import Shard, WhiskingDataset
from brainbench.models.training import config, trainer
from brainbench.models.training.batches import Augmentation
from tests.factories.sweep_batches import small_set


@pytest.fixture(scope="module")
def folder():
    return str(small_set())


def _options(folder, out):
    return ("--data", folder, "--out", str(out), "--epochs", "2", "--batch-size", "8", "--device", "cpu")


@pytest.mark.slow
def test_a_model_is_trained_scored_by_its_folder_and_exported(run, folder, tmp_path):
    trained = run("train", "s4-small", *_options(folder, tmp_path / "run"), "--augmentation", "none")
    assert trained.status == 0, trained.err
    assert "finished" in trained.out
    assert {"raw", "random", "twin"} <= set(trained.out.split())
    assert f"brainbench score local-dir:{tmp_path / 'run' / 'best'}" in trained.out
    shown = json.loads(run("models", "show", f"local-dir:{tmp_path / 'run' / 'best'}", "--json").out)
    assert shown["trained"]["classes"] == ["brick", "cone"]
    assert "s4-small with seed 0, drawn here" in shown["twin"]
    data, manifest = shown["trained"]["data"], json.loads(Path(folder, "manifest.json").read_text())
    used = sum(data[name] for name in ("train", "validation", "test"))
    assert (data["hash"], used + data["left_out"]) == (manifest["content_hash"], manifest["sweeps"])
    assert f"{data['train']:,} sweeps to train" in (tmp_path / "run" / "best" / "README.md").read_text()
    file = tmp_path / "s4.pt2"
    exported = run(
        "export", f"local-dir:{tmp_path / 'run' / 'best'}", "--format", "torch", "--out", str(file), "--json"
    )
    assert exported.status == 0, exported.err
    assert json.loads(exported.out)["difference"] < 1e-4
    contract = json.loads((tmp_path / "s4.pt2.json").read_text())
    assert contract["outputs"]["features"] == ["batch", 96]
    assert contract["sample_rate"] == pytest.approx(20)  # five frames of these data, 10 ms apart


def test_of_a_search_the_best_run_is_named_to_be_scored(run, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(config, "best_run", lambda out: (out / "other", {"other": 1.0}))
    found = run("train", "s4-small", *_options(folder, tmp_path), "--sweep", "1/8")
    assert found.status == 0, found.err
    assert f"local-dir:{tmp_path / 'other' / 'best'}" in found.out.replace("\n", "")


def test_physical_augmentation_keeps_to_the_whiskers_of_the_data(run, folder, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(WhiskingDataset, "axes", "follicle")
    monkeypatch.setattr(trainer, "Augmentation", lambda *values: made.append(Augmentation(*values)) or made[-1])
    assert run("train", "s4-small", *_options(folder, tmp_path / "run"), "--stop-after", "0").status == 0
    assert [(item.kind, item.cells, item.axes) for item in made] == [("physical", (16, 17, 22), "follicle")]


def test_a_stopped_run_goes_on_and_options_come_from_a_file(run, folder, tmp_path):
    file = tmp_path / "options.toml"
    file.write_text('augmentation = "none"\nmasking = 0.5\n')
    options = (*_options(folder, tmp_path / "run"), "--config", str(file))
    stopped = json.loads(run("train", "s4-small", *options, "--stop-after", "0", "--json").out)
    assert next(iter(stopped["runs"].values()))["status"] == "stopped"
    assert stopped["config"]["masking"] == 0.5
    for _ in range(8):
        done = json.loads(run("train", "s4-small", *options, "--json").out)
    assert next(iter(done["runs"].values()))["status"] == "finished"


def test_a_damaged_shard_is_named_before_training_and_only_changed_ones_are_read_again(
    run, folder, tmp_path, monkeypatch
):
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "cache"))
    data = shutil.copytree(folder, tmp_path / "data")
    read = []
    verify = Shard.verify
    monkeypatch.setattr(Shard, "verify", lambda shard: (read.append(shard.path.name), verify(shard)))
    options = (*_options(str(data), tmp_path / "run"), "--stop-after", "0")
    assert run("train", "s4-small", *options).status == 0
    names = sorted(path.name for path in data.glob("*.h5"))
    assert sorted(read) == names
    # One bit of the first force; size and time of the change stay as they were.
    shard = data / names[-1]
    state, content = shard.stat(), bytearray(shard.read_bytes())
    with h5py.File(shard) as file:
        place = file["wrench"].id.get_offset()
    content[place] ^= 1
    shard.write_bytes(content)
    os.utime(shard, ns=(state.st_atime_ns, state.st_mtime_ns))
    read.clear()
    outcome = run("train", "s4-small", *options)
    assert (outcome.status, read) == (1, [shard.name])
    assert shard.name in outcome.err


def test_wrong_requests_are_answered_in_one_line(run, folder, tmp_path):
    outcome = run("train", "s4-small", "--data", folder, "--objective", "simclear")
    assert outcome.status == 2
    assert "did you mean 'simclr'" in outcome.err
    outcome = run("train", "s4-small", "--data", str(tmp_path / "none"))
    assert outcome.status == 2
    outcome = run("train", "s4-small", "--data", folder, "--sweep", "2:4")
    assert "NUMBER/COUNT" in outcome.err
