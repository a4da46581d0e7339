import json

import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.models.training.config import TrainingConfig, read_options


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


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"epoch": 3}, "Unknown training option 'epoch'; did you mean 'epochs'"),
        ({"epochs": 0}, "epochs must be at least 1; received 0"),
        ({"epochs": 1.5}, r"'epochs' is a int; received 1\.5"),
        ({"learning_rate": -1.0}, "learning rate must be positive"),
        ({"precision": "fp16"}, "Unknown precision 'fp16'"),
        ({"augmentation": "tactile"}, "Unknown augmentation 'tactile'"),
        ({"objective": "simclr"}, ""),
    ],
)
def test_values_are_checked(values, message):
    if not message:
        assert TrainingConfig.from_mapping({"model": "zhuang", **values}).objective == "simclr"
        return
    with pytest.raises(UsageError, match=message):
        TrainingConfig.from_mapping({"model": "zhuang", **values})


def test_a_configuration_names_its_model():
    with pytest.raises(UsageError, match="needs the option 'model'"):
        TrainingConfig.from_mapping({"epochs": 1})
    with pytest.raises(UsageError, match="Unknown objective 'ae-warmup'"):
        TrainingConfig.published("zhuang", "ae-warmup")


def test_options_are_read_from_toml_and_json(tmp_path):
    (tmp_path / "a.toml").write_text('epochs = 4\naugmentation = "none"\n')
    (tmp_path / "a.json").write_text(json.dumps({"epochs": 4, "augmentation": "none"}))
    assert (
        read_options(tmp_path / "a.toml") == read_options(tmp_path / "a.json") == {"epochs": 4, "augmentation": "none"}
    )
    (tmp_path / "b.toml").write_text("epochs = \n")
    with pytest.raises(DataError, match="not valid TOML"):
        read_options(tmp_path / "b.toml")
    with pytest.raises(DataFileNotFoundError):
        read_options(tmp_path / "none.toml")
    (tmp_path / "c.json").write_text("[1]")
    with pytest.raises(DataError, match="holds a list"):
        read_options(tmp_path / "c.json")
