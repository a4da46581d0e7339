"""Random numbers that depend on a seed alone and disturb nobody."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from brainbench.errors import UsageError


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Run a block with PyTorch's CPU generator at ``seed``; its state is put back afterwards.

    Raises:
        UsageError: the seed is not a whole number of 0 or more.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise UsageError(f"A seed must be a whole number of 0 or more; received {seed!r}.")
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield
