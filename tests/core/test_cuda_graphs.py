"""What can be told of CUDA graphs on a processor: when work is recorded, and what happens where it cannot be."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import pytest
import torch

from brainbench.core.cuda_graphs import CudaGraphStep, record_step
from brainbench.core.errors import UsageError


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
    again = record_step(lambda: done.append(1), torch.device("cpu"), warm_up=2)
    again()
    assert len(done) == 3
