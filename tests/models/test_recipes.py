from __future__ import annotations

import re
from collections import Counter

import pytest

from brainbench.core.errors import UsageError
from brainbench.models.recipes import (
    OBJECTIVES,
    OPTIMIZERS,
    SCHEDULES,
    Architecture,
    find_recipe,
    list_recipes,
    recipe_for,
)
from brainbench.models.registry import describe_model, list_models
from brainbench.models.zoo import architectures


def test_a_name_is_taken_apart_and_put_together_unchanged():
    assert [str(item) for item in architectures()] == [name for name in list_models() if Architecture.parse(name)]
    for item in architectures():
        assert Architecture.parse(str(item)) == item
        for tag in OBJECTIVES:
            assert Architecture.parse(f"{item}.{tag}").untrained == str(item)


@pytest.mark.parametrize(
    "name",
    ["", "zhuang-", "zhuang+", "zhuang.", "zhuang--ln", "a-ln-ln", "a-small-gru", "a-small-ln", "a+b+c.d.e", "Ä b\n.c"],
)
def test_no_name_is_changed_by_parsing_so_that_only_what_exists_is_found(name):
    assert str(Architecture.parse(name)) == name


def test_the_parts_have_names():
    parts = Architecture.parse("zhuang-intersection-ln-small+gpt.simclr")
    assert (parts.encoder, parts.cell, parts.attender, parts.tag) == ("zhuang", "intersection", "gpt", "simclr")
    assert parts.layer_norm
    assert parts.small
    assert parts.memory_encoder == "zhuang-intersection-ln"
    assert str(parts.full) == "zhuang-intersection-ln+gpt"
    assert parts.untrained == "zhuang-intersection-ln-small+gpt"


@pytest.mark.parametrize("path", ["a.py", "folder/zhuang", "local-dir:zhuang", "C:\\zhuang"])
def test_a_path_is_no_name(path):
    with pytest.raises(UsageError, match=re.escape(repr(path)) + r" .*path/to/file\.py"):
        Architecture.parse(path)


def test_there_are_as_many_recipes_as_published():
    counts = Counter(Architecture.parse(name).tag for name in list_recipes())
    assert counts == {"supervised": 20, "simclr": 12, "simsiam": 12, "simsiam-warmup": 12, "ae": 12}
    supervised = Counter(Architecture.parse(name).attender for name in list_recipes("*.supervised"))
    assert supervised == {None: 10, "gpt": 7, "mamba": 3}


@pytest.mark.parametrize("name", list_recipes())
def test_a_recipe_can_be_built_and_run(name):
    recipe = find_recipe(name)
    assert recipe.architecture in list_models()
    assert recipe.objective in OBJECTIVES
    assert recipe.setting in recipe.search
    assert len(set(recipe.search)) == len(recipe.search)
    for setting in recipe.search:
        assert setting.optimizer in OPTIMIZERS
        assert setting.schedule in SCHEDULES
        assert 1e-4 <= setting.learning_rate <= 1e-1
    assert describe_model(recipe.architecture).parameters > 3e6


@pytest.mark.parametrize(
    ("name", "points", "optimizers", "batch"),
    [
        ("resnet18.supervised", 3, {"sgd"}, 256),
        ("zhuang.supervised", 6, {"sgd"}, 256),
        ("zhuang-gru.supervised", 12, {"sgd", "adam", "adamw"}, 256),
        ("zhuang-lstm-ln.supervised", 4, {"adamw"}, 256),
        ("s4+gpt.supervised", 7, {"sgd", "adamw"}, 256),
        ("zhuang+mamba.simclr", 4, {"lars"}, 256),
        ("resnet18+gpt.simsiam-warmup", 4, {"sgd"}, 1024),
        ("zhuang-intersection-ln.ae", 4, {"sgd"}, 256),
    ],
)
def test_search_spaces_follow_the_tables(name, points, optimizers, batch):
    recipe = find_recipe(name)
    assert len(recipe.search) == points
    assert {setting.optimizer for setting in recipe.search} == optimizers
    assert (recipe.batch_size, recipe.epochs) == (batch, 100)
    warm = {setting.warmup_epochs for setting in recipe.search if setting.schedule == "cosine"}
    assert warm == ({10} if "gpt.supervised" in name or "simclr" in name or "warmup" in name else set())


def test_a_small_model_is_trained_like_the_full_one_and_others_like_their_relatives():
    small = recipe_for("zhuang-intersection-ln-small", "simclr")
    assert small.search == find_recipe("zhuang-intersection-ln.simclr").search
    assert small.name == "zhuang-intersection-ln-small.simclr"
    assert recipe_for("s4", "supervised").source.startswith("as zhuang.supervised of")
    assert recipe_for("zhuang-feedforward+gpt", "ae").search == find_recipe("zhuang+gpt.ae").search


def test_an_unknown_recipe_names_the_nearest():
    with pytest.raises(UsageError, match=r"did you mean 'zhuang-lstm\.simclr'"):
        find_recipe("zhuang-lstn.simclr")
    with pytest.raises(UsageError, match=r"'simclear'.*'simclr'"):
        recipe_for("zhuang", "simclear")
