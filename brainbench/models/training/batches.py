"""The sources of sweeps for training."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import torch

from brainbench.core.errors import UsageError


class Batches(Protocol):
    """One epoch of (sweeps [B, T, S·C, H, W] in SI, labels [B]) per iteration, resumable between any two batches.

    Iterating goes on where the last iteration or the loaded state stopped and ends with the epoch. The state names
    the next batch. With several processes each holds every number-th sweep of the whole batches, from its rank on.
    """

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield what is left of the epoch."""
        ...

    def __len__(self) -> int:
        """Count the batches of a whole epoch."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return where the iteration stands, in plain values."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state`` was taken."""
        ...


class ArrayBatches:
    """Batches of sweeps in memory, in an order drawn anew in every epoch.

    Args:
        sweeps: [N, T, S·C, H, W] in SI.
        labels: [N] classes as integers.
        batch_size: Sweeps per batch of all processes.
        shuffle: Draw the order from seed and epoch; else as given.
        seed: Of the order.
        part: (rank, number of processes).

    Raises:
        UsageError: sizes do not fit.
    """

    def __init__(
        self,
        sweeps: Any,
        labels: Any,
        *,
        batch_size: int = 256,
        shuffle: bool = True,
        seed: int = 0,
        part: tuple[int, int] = (0, 1),
    ) -> None:
        self.sweeps = torch.as_tensor(sweeps)
        self.labels = torch.as_tensor(labels).long()
        if self.sweeps.ndim != 5 or self.labels.shape != self.sweeps.shape[:1] or not len(self.labels):
            raise UsageError(
                "Training needs sweeps [sweep, time, channel, row, column] and one label each; received "
                f"{list(self.sweeps.shape)} and {list(self.labels.shape)}."
            )
        if batch_size < 1 or batch_size % part[1] or not 0 <= part[0] < part[1]:
            raise UsageError(
                f"A batch must divide evenly among the processes; received batch_size {batch_size} and part {part}."
            )
        self.batch_size, self.shuffle, self.seed, self.part = batch_size, shuffle, seed, part
        self.epoch = 0
        self._batch = 0

    def __len__(self) -> int:
        """Count the batches of an epoch."""
        # Every process gets equally many sweeps (the rest is left out), or one would wait for the others for ever.
        return math.ceil(len(self.labels) // self.part[1] / (self.batch_size // self.part[1]))

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield the batches of the epoch that are still to come."""
        if self._batch >= len(self):
            self.epoch, self._batch = self.epoch + 1, 0
        rank, parts = self.part
        count, size = len(self.labels) // parts * parts, self.batch_size // parts
        order = torch.arange(len(self.labels))
        if self.shuffle:
            # The order depends on seed and epoch alone, so going on in mid-epoch needs no state of a generator.
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.epoch)
            order = torch.randperm(len(self.labels), generator=generator)
        # Every number-th sweep of one shuffled order: processes together see the batches that one process would.
        mine = order[:count][rank::parts]
        while self._batch < len(self):
            chosen = mine[self._batch * size : (self._batch + 1) * size]
            self._batch += 1
            yield self.sweeps[chosen], self.labels[chosen]
        self.epoch, self._batch = self.epoch + 1, 0

    def state_dict(self) -> dict[str, Any]:
        """Return where the iteration stands."""
        return {"seed": self.seed, "batch_size": self.batch_size, "epoch": self.epoch, "batch": self._batch}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where another iteration over the same sweeps stood.

        Raises:
            UsageError: it had another seed or batch size.
        """
        if (state["seed"], state["batch_size"]) != (self.seed, self.batch_size):
            raise UsageError(
                f"The saved state has seed {state['seed']} and batch size {state['batch_size']}; here they are "
                f"{self.seed} and {self.batch_size}."
            )
        self.epoch, self._batch = int(state["epoch"]), int(state["batch"])


class Data(Protocol):
    """A labelled data set with splits, as training needs it."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes; labels are indices into them."""
        ...

    def batches(
        self,
        split: str,
        *,
        batch_size: int,
        shuffle: bool,
        seed: int,
        part: tuple[int, int],
        device: torch.device,
    ) -> Batches | None:
        """Return the batches of ``train``, ``validation`` or ``test``; None if there is no such split.

        ``batch_size`` counts the sweeps of all processes; ``part`` is (rank, number of processes).
        """
        ...


class ArrayData:
    """A data set in memory.

    Args:
        classes: Names of the classes.
        **splits: ``train``, ``validation`` and ``test`` as (sweeps [N, T, S·C, H, W] in SI, labels [N]).
    """

    def __init__(self, classes: tuple[str, ...], **splits: tuple[Any, Any]) -> None:
        self.classes = tuple(classes)
        self.splits = splits

    def batches(
        self,
        split: str,
        *,
        batch_size: int,
        shuffle: bool,
        seed: int,
        part: tuple[int, int],
        device: torch.device,
    ) -> ArrayBatches | None:
        """Return a split's batches, None if there is no such split; they are moved by whoever reads them."""
        del device
        if split not in self.splits:
            return None
        sweeps, labels = self.splits[split]
        return ArrayBatches(sweeps, labels, batch_size=batch_size, shuffle=shuffle, seed=seed, part=part)
