import sys

import pytest

import brainbench
from brainbench.core.lazy import lazy_module


def test_the_public_names_resolve():
    for name in brainbench.__all__:
        assert getattr(brainbench, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'scoer'"):
        _ = brainbench.scoer


def test_a_module_is_imported_when_something_of_it_is_asked_for(tmp_path, monkeypatch):
    (tmp_path / "slow_module.py").write_text("number = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    module = lazy_module("slow_module")
    assert "slow_module" not in sys.modules
    assert module.number == 3
    with pytest.raises(AttributeError, match="nothing"):
        _ = module.nothing
