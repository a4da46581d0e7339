"""Random sweeps in SI, and labelled data sets in memory; classes differ in which whiskers are loaded."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch

from brainbench.models.training.batches import BatchOptions


class ArrayBatches:
    """Batches of sweeps in memory [N, T, S·C, H, W] in SI with integer labels [N], in an order drawn in every epoch."""

    def __init__(self, sweeps: Any, labels: Any, options: BatchOptions) -> None:
        self.sweeps, self.labels, self.options = torch.as_tensor(sweeps), torch.as_tensor(labels).long(), options
        self.epoch = self._batch = 0

    def _rows(self) -> tuple[torch.Tensor, ...]:
        """Return the rows of this epoch's batches.

        Every process gets every number-th sweep of one order, and all equally many (the rest is left out): together
        they see the batches that one process would, and none waits for the others for ever.
        """
        count, (rank, parts) = len(self.labels), self.options.part
        # The order depends on seed and epoch alone, so going on in mid-epoch needs no state of a generator.
        generator = torch.Generator().manual_seed(self.options.seed * 1_000_003 + self.epoch)
        order = torch.randperm(count, generator=generator) if self.options.shuffle else torch.arange(count)
        return order[: count // parts * parts][rank::parts].split(self.options.batch_size // parts)

    def __len__(self) -> int:
        return len(self._rows())

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        if self._batch >= len(self):
            self.epoch, self._batch = self.epoch + 1, 0
        for rows in self._rows()[self._batch :]:
            self._batch += 1
            yield self.sweeps[rows], self.labels[rows]
        self.epoch, self._batch = self.epoch + 1, 0

    def state_dict(self) -> dict[str, Any]:
        """Return where the iteration stands."""
        seed, size = self.options.seed, self.options.batch_size
        return {"seed": seed, "batch_size": size, "epoch": self.epoch, "batch": self._batch}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where another iteration over the same sweeps stood."""
        assert (state["seed"], state["batch_size"]) == (self.options.seed, self.options.batch_size)
        self.epoch, self._batch = int(state["epoch"]), int(state["batch"])


class ArrayData:
    """A data set in memory: names of the classes, and the splits ``train``, ``validation`` and ``test``.

    A split is (sweeps [N, T, S·C, H, W] in SI, labels [N]).
    """

    def __init__(self, classes: tuple[str, ...], **splits: tuple[Any, Any]) -> None:
        self.classes, self.splits = tuple(classes), splits
        self.summary: Mapping[str, Any] = {}

    def batches(self, split: str, options: BatchOptions) -> ArrayBatches | None:
        """Return a split's batches, None if there is no such split; they are moved by whoever reads them."""
        return ArrayBatches(*self.splits[split], options) if split in self.splits else None


CLASSES = ("front", "middle", "back")
SCALE = torch.tensor(([1e-4] * 3 + [1e-6] * 3) * 5)[:, None, None]
"""Force [N] and moment [N·m] of light touch, per channel of five sub-steps."""


def random_sweeps(batch, steps):
    """Return [batch, steps, 30, 5, 7] of normal numbers from the global random state, in SI."""
    return torch.randn(batch, steps, 30, 5, 7) * SCALE


def sweeps(count, seed, steps=8):
    generator = torch.Generator().manual_seed(seed)
    labels = torch.arange(count) % 3
    x = 0.2 * torch.randn(count, steps, 30, 5, 7, generator=generator)
    for index, label in enumerate(labels):
        x[index, :, :, label : label + 2] += 2.0
    return x * SCALE, labels


def tiny(**counts):
    counts = {"train": 24, "validation": 9, "test": 9} | counts
    return ArrayData(CLASSES, **{split: sweeps(n, i) for i, (split, n) in enumerate(counts.items()) if n})
