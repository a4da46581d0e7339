import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.search_space import best_run, sweep_runs
from brainbench.models.training.trainer import train
from tests.factories.training_sweeps import tiny


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


def test_the_best_run_is_chosen_by_validation(tmp_path):
    with pytest.raises(DataError, match=rf"run .*{tmp_path.name}'"):
        best_run(tmp_path)
    for config, folder in sweep_runs(_config(), tmp_path)[:2]:
        train(config, tiny(), out=folder, device="cpu")
    winner, scores = best_run(tmp_path)
    assert len(scores) == 2
    assert scores[winner.name] == max(scores.values())
