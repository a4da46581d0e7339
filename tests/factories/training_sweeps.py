"""Random sweeps in SI, and a tiny labelled data set: three classes that differ in which whiskers are loaded."""

import torch

from tests.factories.array_data import ArrayData

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
