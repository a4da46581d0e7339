from __future__ import annotations

import json
import shutil
from pathlib import Path

import torch

from brainbench import models
from brainbench.models import registry
from brainbench.models.registry import load_model
from tests.factories.published_files import lightning_state

WEIGHTS = Path(models.__path__[0]) / "weights"


def test_a_card_says_what_the_weights_are(run):
    def shown(name):
        return " ".join(run("models", "show", name).out.split())

    assert "weights trained: simclr" in shown("zhuang-small.simclr")
    assert "weights untrained" in shown("zhuang-small")
    plain = json.loads(run("models", "show", "zhuang-small", "--json").out)
    assert plain["trained_as"] == ["zhuang-small.simclr", "zhuang-small.supervised"]
    assert "trained as " + ", ".join(plain["trained_as"]) in shown("zhuang-small")
    assert "brainbench train zhuang-gru --objective simclr" in shown("zhuang-gru.simclr")


def test_an_accuracy_names_its_sweeps_where_they_chose_the_weights(run, tmp_path):
    folder = shutil.copytree(WEIGHTS / "zhuang-small.simclr", tmp_path / "weights")
    config = json.loads((folder / "config.json").read_text())
    for split, words in (
        (None, "sweeps that were held out"),
        ("validation", "validation sweeps, which chose the weights"),
    ):
        (folder / "config.json").write_text(json.dumps(config | ({"evaluated_split": split} if split else {})))
        assert words in " ".join(run("models", "show", f"local-dir:{folder}").out.split())


def test_models_are_listed_with_size_cost_and_published_objectives(run):
    listed = run("models", "list", "resnet18*")
    assert listed.status == 0
    assert "18,086,517" in listed.out
    records = json.loads(run("models", "list", "s4*", "--json").out)
    assert {item["name"]: item["recipes"] for item in records}["s4+gpt"] == [
        "supervised",
        "simclr",
        "simsiam",
        "simsiam-warmup",
        "ae",
    ]


def test_recipes_are_listed_with_their_settings(run):
    listed = run("models", "recipes", "zhuang-gru.*")
    assert listed.status == 0
    assert "lars, cosine" in listed.out
    assert len(json.loads(run("models", "recipes", "--json").out)) == 68


def test_a_recipe_is_shown_with_its_architecture(run):
    shown = json.loads(run("models", "show", "zhuang-ugrnn.simsiam-warmup", "--json").out)
    assert shown["parameters"] == 30_688_416 + 60_021
    assert shown["recipe"]["batch_size"] == 1024
    assert "NeurIPS" in run("models", "show", "zhuang.ae").out


def test_an_unknown_model_is_answered_in_one_line(run):
    outcome = run("models", "show", "resnet81")
    assert outcome.status == 2
    assert "did you mean 'resnet18'" in outcome.err


def test_published_weights_are_imported_by_name(run, tmp_path):
    torch.save(lightning_state(load_model("zhuang-gru-ln-small")), tmp_path / "x.ckpt")
    given = ("models", "import", str(tmp_path / "x.ckpt"), "--out", str(tmp_path / "made"))
    refused = run(*given)
    assert refused.status != 0
    assert "expected [96, 30, 2, 2]" in refused.err
    made = json.loads(run(*given, "--architecture", "zhuang-gru-ln-small", "--json").out)
    assert made["parameters"] == sum(p.numel() for p in load_model(made["name"]).parameters())
    told = run(*given, "--architecture", "zhuang-gru-ln-small").out
    assert f"brainbench score local-dir:{tmp_path}" in " ".join(told.split())


def test_the_group_alone_lists_what_is_trained_and_names_stay_whole(run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    listed = run("models")
    assert listed.status == 0
    rows = {line.split()[0]: line.split()[1] for line in listed.out.splitlines()[1:] if "  " in line}
    assert rows["zhuang-intersection-ln-small.supervised"] == "trained"
    assert rows["zhuang-intersection-ln-small+mamba"] == "untrained"
    assert rows["zhuang-intersection-ln+gpt.simsiam-warmup"] == "needs"


def test_a_suggestion_keeps_the_tag(run):
    assert "'zhuang-intersection-ln-small.simclr'?" in run("models", "show", "zhuang-intersecton-ln-small.simclr").err


def test_a_model_of_ones_own_gets_a_name_and_loses_it(run, files, tmp_path, monkeypatch):
    monkeypatch.setenv("BRAINBENCH_CONFIG", str(tmp_path / "settings"))
    monkeypatch.setattr(registry, "_loaded", set())
    monkeypatch.setattr(registry, "_records", dict(registry._records))
    assert run("models", "add", files["model"], "--name", "mine").status == 0
    monkeypatch.setattr(registry, "_loaded", set())  # as the next command finds it
    assert "your code" in run("models", "list", "mine").out
    asked = ("--conditions", "trials:texture", "--stimuli", files["arrays"], "--out", files["out"])
    assert run("score", "mine", "--recordings", files["recordings"], *asked).status == 0
    assert run("models", "add", files["model"], "--name", "mine").status == 2
    assert run("models", "remove", "mine").status == 0
    assert "'mine'" in run("models", "remove", "mine").err
