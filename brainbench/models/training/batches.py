"""The sources of sweeps for training."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch


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
