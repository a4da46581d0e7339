"""The sources of sweeps for training, and the processes that share them (what torchrun says)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import nn

from brainbench.core.devices import torch_device
from brainbench.core.errors import UsageError


@dataclass(frozen=True)
class BatchOptions:
    """Division of a split into batches."""

    batch_size: int = 256
    """Sweeps per batch of all processes."""
    shuffle: bool = True
    """Draw the order from seed and epoch; else as given."""
    seed: int = 0
    part: tuple[int, int] = (0, 1)
    """(rank, number of processes)."""
    device: torch.device | str = "cpu"
    """Where the batches are used; they may come from elsewhere."""


class Batches(Protocol):
    """One epoch of (sweeps [B, T, S·C, H, W] in SI, labels [B]) per iteration, resumable between any two batches.

    Iterating goes on where the last iteration or the loaded state stopped and ends with the epoch; the length counts a
    whole epoch. With several processes each holds every number-th sweep of the whole batches, from its rank on.
    """

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]: ...

    def __len__(self) -> int: ...

    def state_dict(self) -> dict[str, Any]:
        """Return where the iteration stands, in plain values: the next batch."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state`` was taken."""
        ...


class Data(Protocol):
    """A labelled data set with splits, as training needs it."""

    classes: tuple[str, ...]
    """Names of the classes; labels are indices into them."""
    summary: Mapping[str, Any]
    """Facts for the card of what is trained: ``hash``, ``left_out``, and the sweeps of ``train``, ``validation`` and
    ``test``; empty where they are unknown."""

    def batches(self, split: str, options: BatchOptions) -> Batches | None:
        """Return the batches of ``train``, ``validation`` or ``test``; None if there is no such split."""
        ...


@dataclass(frozen=True)
class Processes:
    """This process among those of the run."""

    rank: int
    count: int
    device: torch.device

    @property
    def part(self) -> tuple[int, int]:
        """(rank, number): which sweeps of a batch are this process's."""
        return self.rank, self.count

    @property
    def first(self) -> bool:
        """True in the process that writes files and shows progress."""
        return self.rank == 0

    def average(self, vector: torch.Tensor) -> None:
        """Replace a vector by its mean over processes.

        With equal shares of a batch, the mean of the gradients is that of the whole batch's mean loss.
        """
        torch.distributed.all_reduce(vector)
        vector.div_(self.count)

    def prepare(self, module: nn.Module) -> nn.Module:
        """Return the module on its device, with batch norms that pool over processes."""
        if self.count > 1 and any(isinstance(m, nn.modules.batchnorm._BatchNorm) for m in module.modules()):
            if self.device.type != "cuda":
                raise UsageError(
                    "Several processes on the CPU would each normalise over their own part of a batch; train a "
                    "network with batch norms in one process, or on CUDA."
                )
            module = nn.SyncBatchNorm.convert_sync_batchnorm(module)
        return module.to(self.device)

    def mean(self, value: float) -> float:
        """Return the mean of a number over processes."""
        if self.count == 1:
            return value
        total = torch.tensor([value], dtype=torch.float64, device=self.device)
        # Every process must come here equally often, or the others wait for ever.
        self.average(total)
        return float(total)

    def any(self, *flags: bool) -> tuple[bool, ...]:
        """Return for each flag whether it is up in any process."""
        if self.count == 1:
            return flags
        total = torch.tensor(flags, dtype=torch.int32, device=self.device)
        torch.distributed.all_reduce(total, op=torch.distributed.ReduceOp.MAX)
        return tuple(bool(value) for value in total.tolist())

    def wait(self) -> None:
        """Wait until all processes have come here."""
        if self.count > 1:
            # NCCL guesses a device, and warns, unless it is told.
            ids = [self.device.index] if self.device.type == "cuda" else None
            torch.distributed.barrier(device_ids=ids)


@contextmanager
def processes(device: str | None = None) -> Iterator[Processes]:
    """Join the processes that torchrun started, or be the only one; without a device's name CUDA when there is one."""
    where = torch_device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    count, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    if where.type == "cuda":
        if where.index is None:
            where = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(where)
    if count == 1:
        yield Processes(0, 1, where)
        return
    if where.type == "cuda":
        torch.distributed.init_process_group("nccl", device_id=where)
    else:
        torch.distributed.init_process_group("gloo")
    try:
        yield Processes(rank, count, where)
    finally:
        torch.distributed.destroy_process_group()
