"""Devices are picked by name, and what is not there is told."""

import os

import pytest
import torch

from brainbench.core import devices as _device
from brainbench.core.errors import UsageError


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
