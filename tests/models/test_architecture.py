import re

import pytest

from brainbench.core.errors import UsageError
from brainbench.models.architecture import OBJECTIVES, Architecture
from brainbench.models.registry import list_models
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
