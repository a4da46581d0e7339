from __future__ import annotations

import logging
import re

import pytest
import torch

from brainbench.core.errors import DataError, UsageError
from brainbench.core.runs.folder import claim
from brainbench.models.registry import load_model
from brainbench.models.training.batches import reverse_time
from brainbench.models.training.config import TrainingConfig, best_run, config_warnings, sweep_runs
from brainbench.models.training.trainer import train
from tests.factories.training_sweeps import sweeps, tiny


def test_a_published_configuration_follows_its_recipe():
    config = TrainingConfig.published("zhuang-intersection-ln+gpt", "supervised")
    assert (config.optimizer, config.schedule, config.learning_rate) == ("adamw", "cosine", 1e-4)
    assert (config.warmup_epochs, config.epochs, config.batch_size) == (10, 100, 256)
    assert TrainingConfig.published("resnet18").decoder == "all-steps"
    assert TrainingConfig.published("zhuang", "simsiam").batch_size == 1024
    assert TrainingConfig.published("zhuang", "simsiam").warmup_epochs == 0
    assert TrainingConfig.published("zhuang", "simsiam-warmup").warmup_epochs == 10


def test_changes_win():
    assert TrainingConfig.published("zhuang", "ae", epochs=3, learning_rate=None).epochs == 3


def test_options_of_a_mapping_are_checked_by_name_and_kind():
    assert TrainingConfig.from_mapping({"model": "zhuang", "objective": "simclr"}).objective == "simclr"
    with pytest.raises(UsageError, match="Unknown training option 'epoch'; did you mean 'epochs'"):
        TrainingConfig.from_mapping({"model": "zhuang", "epoch": 3})
    with pytest.raises(UsageError, match="model of a training must be a name; received 3"):
        TrainingConfig.from_mapping({"model": 3})


def test_a_configuration_names_its_model():
    with pytest.raises(UsageError, match="option 'model'"):
        TrainingConfig.from_mapping({"epochs": 1})
    with pytest.raises(UsageError, match=r"'ae-warmup'.*'ae'"):
        TrainingConfig.published("zhuang", "ae-warmup")


def _warnings(name, objective, **changes):
    return config_warnings(TrainingConfig.published(name, objective, **changes), load_model(name))


def test_published_recipes_of_networks_with_memory_raise_no_warning():
    assert _warnings("zhuang-intersection-ln-small", "simclr") == []
    assert _warnings("resnet18-small+gpt", "simclr") == []
    assert _warnings("resnet18-small", "supervised", augmentation="none") == []


def test_equal_views_raise_a_warning():
    (warning,) = _warnings("zhuang-intersection-ln-small", "simclr", augmentation="none")
    assert "views of a sweep" in warning
    assert "Choose an augmentation" in warning
    assert _warnings("zhuang-intersection-ln-small", "simclr", augmentation="none", masking=0.75) == []


def test_a_network_without_memory_raises_a_warning_where_time_may_run_backwards():
    (warning,) = _warnings("resnet18-small", "simclr")
    assert re.search("resnet18-small .*memory.*last step", warning)
    assert _warnings("resnet18-small", "simclr", augmentation="image") == []


def test_played_backwards_sweeps_that_begin_in_silence_look_all_alike_to_a_network_without_memory():
    x, _ = sweeps(6, 1)
    x[:, 0] = 0.0  # no whisker touches at first
    for name, alike in (("resnet18-small", True), ("resnet18-small+gpt", False)):
        with torch.no_grad():
            features = load_model(name).eval().encode(reverse_time(x), last=True)
        assert torch.allclose(features, features[:1].expand_as(features), rtol=1e-4, atol=1e-6) == alike


def test_a_run_says_its_warnings_and_goes_on(tmp_path, caplog):
    options = {"epochs": 1, "batch_size": 8, "probe_epochs": 0, "precision": "float32", "learning_rate": 1e-3}
    config = TrainingConfig.published("resnet18-small", "simclr", optimizer="adamw", **options)
    with caplog.at_level(logging.WARNING):
        assert train(config, tiny(), out=tmp_path, device="cpu").status == "finished"
    assert "has no memory" in caplog.text


@pytest.mark.parametrize(("objective", "mixed"), [("simclr", True), ("supervised", False)])
def test_validation_of_a_contrastive_run_mixes_the_classes(objective, mixed, tmp_path, monkeypatch):
    data, asked = tiny(), []
    batches = data.batches

    def spy(split, options):
        asked.append((split, options.shuffle))
        return batches(split, options)

    monkeypatch.setattr(data, "batches", spy)
    options = {"epochs": 1, "batch_size": 8, "probe_epochs": 0, "precision": "float32", "learning_rate": 1e-3}
    train(
        TrainingConfig.published("zhuang-small", objective, optimizer="adamw", **options),
        data,
        out=tmp_path,
        device="cpu",
    )
    assert ("validation", mixed) in asked


def test_a_run_of_an_older_version_of_its_architecture_is_another_run(tmp_path):
    identity = TrainingConfig("s4-small").identity
    older = {name: value for name, value in identity.items() if name != "version"}
    claim(tmp_path / "run.json", older, lambda: older, stated=dict)
    with pytest.raises(UsageError, match=r"version None \(now 2\)"):
        claim(tmp_path / "run.json", identity, lambda: identity, stated=dict)
    assert "version" not in TrainingConfig("zhuang-small").identity


def _config(**changes):
    options = {"epochs": 1, "batch_size": 12, "precision": "float32", "augmentation": "none", **changes}
    return TrainingConfig.published("zhuang-small", "supervised", **options)


def test_a_sweep_has_a_run_for_every_point_of_the_search_space(tmp_path):
    runs = sweep_runs(_config(), tmp_path)
    assert len(runs) == len({folder for _, folder in runs}) == 6
    assert runs[0][1].name == "sgd-step-0.1-seed0"
    assert {config.epochs for config, _ in runs} == {1}
    shares = [sweep_runs(_config(), tmp_path, job=(number, 4)) for number in range(4)]
    assert sorted(folder for share in shares for _, folder in share) == sorted(folder for _, folder in runs)
    with pytest.raises(UsageError, match="0 ≤ number < count"):
        sweep_runs(_config(), tmp_path, job=(4, 4))
    warm = sweep_runs(TrainingConfig.published("zhuang", "simsiam"), tmp_path, warmup=True)
    assert {config.warmup_epochs for config, _ in warm} == {10}


@pytest.mark.slow
def test_the_best_run_is_chosen_by_validation(tmp_path):
    with pytest.raises(DataError, match=rf"run .*{tmp_path.name}'"):
        best_run(tmp_path)
    for config, folder in sweep_runs(_config(), tmp_path)[:2]:
        train(config, tiny(), out=folder, device="cpu")
    winner, scores = best_run(tmp_path)
    assert len(scores) == 2
    assert scores[winner.name] == max(scores.values())
