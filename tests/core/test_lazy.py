import subprocess
import sys

import pytest

import brainbench
from brainbench.core.lazy import LazyModule


def test_the_public_names_resolve():
    for name in brainbench.__all__:
        assert getattr(brainbench, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'scoer'"):
        _ = brainbench.scoer


def test_a_lazy_module_is_imported_at_its_first_use():
    code = "import sys; from brainbench.core.lazy import LazyModule; wave = LazyModule('wave')"
    code += "; before = 'wave' in sys.modules; wave.open; print(before, 'wave' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "False True\n"


def test_a_lazy_module_follows_what_replaces_a_name_of_it(monkeypatch):
    import wave

    stand_in = LazyModule("wave")
    monkeypatch.setattr(wave, "open", len)
    assert stand_in.open is len
    with pytest.raises(AttributeError, match="no attribute 'opem'"):
        _ = stand_in.opem
