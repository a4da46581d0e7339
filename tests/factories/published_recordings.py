"""Small files in the layout of the published recordings: rates in slots, zeros elsewhere, NaN padding."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def make_zero_filled(
    lengths: Sequence[int], units: int = 6, *, seed: int = 0, order: Sequence[Sequence[int]] = ()
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return one animal's array [max trials, 6, units of all sessions], and each session's slots [R].

    Every session shows six stimuli of fixed mean rates in random order; slots follow their first appearance, or the
    sequence of stimuli that ``order`` gives for each session.
    """
    rng = np.random.default_rng(seed)
    array = np.full((max(lengths), 6, units * len(lengths)), np.nan)
    slots = []
    for index, length in enumerate(lengths):
        shown = np.array(order[index]) if order else rng.permutation(np.resize(np.arange(6), length))
        seen = list(dict.fromkeys(shown.tolist()))
        own = np.array([seen.index(stimulus) for stimulus in shown])
        tuning = rng.uniform(2, 30, size=(6, units))
        block = np.zeros((length, 6, units))
        block[np.arange(length), own] = rng.poisson(tuning[shown]) + 0.5
        array[:length, :, index * units : (index + 1) * units] = block
        slots.append(own)
    return array, slots


def write_published(path: Path, *, stray: bool = True, **animals: np.ndarray) -> Path:
    """Write arrays as the authors do; ``stray`` as numpy before 2.2 does."""
    more = {"allow_pickle": np.array(True)} if stray else {}
    arrays = {name.replace("_", "-"): array for name, array in animals.items()}
    with path.open("wb") as stream:
        np.savez(stream, **arrays)
    if more:
        # numpy from 2.2 on takes the name for its keyword, so the entry is added by hand.
        import zipfile

        with zipfile.ZipFile(path, "a") as archive, archive.open("allow_pickle.npy", "w") as entry:
            np.lib.format.write_array(entry, more["allow_pickle"])
    return path
