"""Random numbers that depend on a seed alone and disturb nobody."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from brainbench.core.reading.ranges import check_number


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Run a block with PyTorch's CPU generator at ``seed``; its state is put back afterwards."""
    # PyTorch keeps seeds as signed 64-bit numbers.
    check_number("seed", seed, least=0, below=2**63, whole=True)
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield
