"""Random numbers that depend on a seed alone and disturb nobody."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from brainbench.core.errors import UsageError


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Run a block with PyTorch's CPU generator at ``seed``; its state is put back afterwards.

    Raises:
        UsageError: the seed is not a whole number from 0 to 2**63 − 1.
    """
    # PyTorch keeps seeds as signed 64-bit numbers.
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise UsageError(f"A seed must be a whole number of 0 or more, below 2**63; received {seed!r}.")
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield
