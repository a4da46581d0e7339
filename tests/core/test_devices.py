"""Devices are picked by name, and what is not there is told; work is recorded where a device can do that."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from typing import Any

import pytest
import torch

from brainbench.core import devices as _device
from brainbench.core.devices import CudaGraphStep, record_step
from brainbench.core.errors import UsageError
from brainbench.core.files import CACHE_VARIABLE


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


def test_kernels_are_kept_in_our_cache_where_the_home_folder_is_read_only(monkeypatch, tmp_path):
    config = _device.warp().config
    (tmp_path / "file").touch()
    for name, value in {"WARP_CACHE_PATH": tmp_path / "file" / "kernels", CACHE_VARIABLE: tmp_path / "cache"}.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(config, "kernel_cache_dir", before := config.kernel_cache_dir)
    _device._start.__wrapped__()
    assert config.kernel_cache_dir == str(tmp_path / "cache" / "kernels") != before


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


class _Broken:
    """A recorder that is not let record: recordings, and the one that heals, end as CUDA's would."""

    recordings = 0

    def __call__(self, work: Callable[[], Any]) -> tuple[Any, Any]:
        del work
        self.recordings += 1
        try:
            raise RuntimeError("Cannot copy between CPU and CUDA tensors during CUDA graph capture")
        finally:
            raise RuntimeError("operation failed due to a previous error during capture")


class _Fake:
    """A recorder whose graph does the work again into the tensor of the recording."""

    def __call__(self, work: Callable[[], Any]) -> tuple[Any, Any]:
        self.work, self.result = work, work()
        return self, self.result

    def replay(self) -> None:
        self.result.copy_(self.work())


def test_work_that_cannot_be_recorded_says_so_once_and_runs_as_it_is(caplog: pytest.LogCaptureFixture) -> None:
    generator, recorder = torch.Generator().manual_seed(1), _Broken()
    step = CudaGraphStep(lambda: torch.rand(2, generator=generator), recorder, subject="It", generators=[generator])
    with caplog.at_level(logging.WARNING):
        drawn = [step() for _ in range(5)]
    expected = torch.rand(5, 2, generator=torch.Generator().manual_seed(1))
    assert torch.equal(torch.stack(drawn), expected)
    assert recorder.recordings == 2
    assert not step.recorded
    said = [r.getMessage() for r in caplog.records if "launch by launch" in r.getMessage()]
    assert len(said) == 1
    assert "Cannot copy between CPU and CUDA" in said[0]


def test_a_recording_that_is_asked_for_and_fails_is_an_error_that_tells_what_to_do() -> None:
    step = CudaGraphStep(lambda: None, _Broken(), subject="It", advice="Use graphs=False.", required=True, warm_up=0)
    with pytest.raises(UsageError, match=r"Cannot copy.*graphs=False"):
        step()


@pytest.mark.parametrize(("kept", "same"), [((), False), (None, True)])
def test_results_of_a_replay_are_copies_unless_nothing_is_to_be_copied(kept: Any, same: bool) -> None:
    x = torch.zeros(2)
    step = CudaGraphStep(lambda y: y + x, _Fake(), subject="It", warm_up=1, retained=kept)
    results = []
    for value in range(4):
        x.fill_(value)
        results.append(step(x))
    assert step.recorded
    assert torch.equal(results[3], torch.full((2,), 6.0))
    assert (results[2] is results[3]) == same
    assert torch.equal(results[2], results[3]) == same


def test_on_the_cpu_work_is_repeated_as_it_is() -> None:
    done: list[int] = []
    again = record_step(lambda: done.append(1), torch.device("cpu"))
    again()
    assert len(done) == _device.WARM_UP + 1
