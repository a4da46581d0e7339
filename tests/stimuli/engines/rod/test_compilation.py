"""Kernels of the rod backend: few of them, compiled once, and told of when they are."""

import threading

import pytest

from brainbench.core import devices as _device
from brainbench.core.errors import UsageError
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.engines.rod.launch import load_kernels
from brainbench.stimuli.engines.rod.limits import MESHES, NOTHING, PRIMITIVES

FINE = Fidelity(links=10, time_step=1e-3)


def test_on_a_processor_one_kernel_serves_whatever_there_is_to_touch():
    wp, device = _device.warp(), _device.pick_device("cpu")
    made = {id(load_kernels(device, wp.float32, 12, needs)) for needs in (NOTHING, PRIMITIVES, MESHES)}
    assert len(made) == 1
    assert id(load_kernels(device, wp.float32, 12)) in made


def test_threads_that_ask_at_once_share_a_kernel():
    wp, device, found = _device.warp(), _device.pick_device("cpu"), []
    threads = [threading.Thread(target=lambda: found.append(load_kernels(device, wp.float32, 12))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    assert len(set(map(id, found))) == 1


def test_compiling_is_told_once_per_size_and_not_at_all_for_kept_kernels(monkeypatch, tmp_path):
    told = []
    engine = RodEngine()
    engine.prepare([0.01, 0.02], FINE)
    engine.prepare([0.01, 0.02], FINE, progress=lambda *said: told.append(said))
    assert told == []
    # Warp's cache is elsewhere now, while what is loaded stays loaded: nothing has to be compiled for this test.
    monkeypatch.setattr(_device.warp().config, "kernel_cache_dir", str(tmp_path))
    engine.prepare([0.01, 0.02], FINE, progress=lambda *said: told.append(said))
    assert [said[:2] for said in told] == [(0, 1), (1, 1)]
    assert "12 links (once; it is kept)" in told[0][2]


def test_an_engine_is_made_ready_for_what_can_be_simulated_only():
    with pytest.raises(UsageError, match="at most 100"):
        RodEngine().prepare([0.5], Fidelity(links=10, links_per_mm=1.0))
