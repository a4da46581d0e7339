"""Kernels of the rod backend: few of them, compiled once, and told of when they are."""

import os
import threading

import pytest
import torch

from brainbench.core import devices as _device
from brainbench.core.errors import UsageError
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.compilation import load_kernels
from brainbench.stimuli.engines.rod.engine import RodEngine
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


def test_a_warp_without_a_compiler_for_processors_says_what_to_do(monkeypatch):
    wp = _device.warp()
    monkeypatch.setattr(wp, "is_cpu_available", lambda: False)
    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    for name in ("cpu", "auto"):
        with pytest.raises(UsageError, match=r"warp-lang .*'mujoco'"):
            _device.pick_device(name)


@pytest.mark.parametrize("name", ["cuda:9", "cuda:1", "cuda:x", "cuda:", "cudax", "gpu"])
def test_a_device_that_is_not_there_is_told_in_one_sentence(monkeypatch, name):
    monkeypatch.setattr(_device.warp(), "is_cuda_available", lambda: True)
    monkeypatch.setattr(_device.warp(), "get_cuda_device_count", lambda: 1)
    with pytest.raises(UsageError, match=f"'{name}'"):
        _device.pick_device(name)


def test_the_automatic_device_is_the_processor_wherever_that_works():
    assert _device.pick_device("auto").is_cpu


def test_devices_of_torch_are_taken_and_other_objects_refused():
    assert _device.pick_device(torch.device("cpu")).is_cpu
    for wrong in (3, torch.device("meta")):
        with pytest.raises(UsageError, match=f"A device is .*'{wrong}'"):
            _device.pick_device(wrong)


def test_only_the_line_about_the_missing_driver_is_kept_back(capfd):
    with _device._without_driver_warning():
        os.write(2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution ...\n")
        os.write(2, b"something else\n")
    os.write(2, b"later\n")
    assert capfd.readouterr().err == "something else\nlater\n"
