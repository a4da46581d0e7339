"""The processes of a run: one alone needs nobody, and several on the CPU share no batch norm."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.models.training.batches import Processes, processes


def test_one_process_is_the_first_and_keeps_its_own_numbers(monkeypatch):
    for name in ("WORLD_SIZE", "RANK"):
        monkeypatch.delenv(name, raising=False)
    with processes("cpu") as alone:
        assert (alone.part, alone.first, alone.device) == ((0, 1), True, torch.device("cpu"))
        assert alone.mean(0.25) == 0.25
        assert alone.any(True, False) == (True, False)
        alone.wait()
    assert not torch.distributed.is_initialized()


def test_batch_norms_are_refused_where_processes_cannot_pool_them():
    normed, plain = nn.Sequential(nn.Linear(3, 3), nn.BatchNorm1d(3)), nn.Linear(3, 3)
    second = Processes(1, 2, torch.device("cpu"))
    assert not second.first
    assert second.prepare(plain) is plain
    with pytest.raises(UsageError, match="batch norms in one process"):
        second.prepare(normed)
    assert Processes(0, 1, torch.device("cpu")).prepare(normed) is normed


def test_shares_of_a_batch_average_to_the_whole(monkeypatch):
    # Stands in for the sum over processes: the other one holds three times as much.
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda vector: vector.mul_(4))
    share = Processes(0, 2, torch.device("cpu"))
    gradient = torch.tensor([1.0, -2.0])
    share.average(gradient)
    assert gradient.tolist() == [2.0, -4.0]
    assert share.mean(0.5) == 1.0
